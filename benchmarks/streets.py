"""Covered lanes of an old town, each walked once, with exact poses: a walk that covers ground.

    python -m benchmarks.streets WALK -n 5000 [-w 512] [--lanes 8]

Lanes bend at their crossings, so that a frame sees a block or two; every front has a picture of its
own. The walk takes all lanes of one direction, to and fro, then those of the other: places are met
again at the crossings. WALK is what `benchmarks.laps` reads.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from gsba.demo import textures
from gsba.demo.mesh import DOWN, MeshBuilder
from gsba.demo.pictures import picture
from gsba.demo.raycast import Scene
from gsba.demo.render import render_erp
from gsba.demo.walk import held_by_hand, write_frames
from gsba.trajectory import write_tum
from gsba.types import Trajectory

STEP_M = 0.6  # from frame to frame
HALF_WIDTH_M = 2.5  # of a lane
HEIGHT_M = 4.5
EYE_M = 1.6
TEXELS = 28.0  # a metre: finer than a pixel of 1024 px at the nearest wall
TILE_M = 8.0  # of floor and ceiling
BEND = 0.16  # of the distance of crossings: standard deviation of their places


def crossings(num_frames: int, lanes: int, seed: int) -> np.ndarray:
    """(lanes, lanes, 2) places x, z of crossings, for a walk of about so many frames."""
    rng = np.random.default_rng([seed, 1])
    grid = np.stack(np.meshgrid(np.arange(lanes), np.arange(lanes), indexing="ij"), axis=-1)
    places = grid + BEND * rng.normal(size=grid.shape).clip(-1.5, 1.5)
    return places * (1.01 * num_frames * STEP_M / _length(_rounded(way(places)))[-1])


def way(places: np.ndarray) -> np.ndarray:
    """(N, 2) crossings in the order of the walk: lanes of one direction to and fro, then others."""
    lanes = len(places)
    there = [places[k][:: 1 if k % 2 == 0 else -1] for k in range(lanes)]
    back = places[:, ::-1] if lanes % 2 else places  # the first one starts where `there` ends
    across = [back[:: -1 if k % 2 == 0 else 1, k] for k in range(lanes)]
    path = np.concatenate([*there, *across])
    return path[np.r_[True, np.linalg.norm(np.diff(path, axis=0), axis=1) > 1e-9]]


def walked(path: np.ndarray, num_frames: int, seed: int) -> Trajectory:
    """Poses STEP_M apart along lanes, facing ahead, corners cut."""
    fine = _rounded(path)
    length = _length(fine)
    stops = STEP_M * np.arange(num_frames)
    at = np.stack([np.interp(stops, length, fine[:, k]) for k in range(2)], axis=1)
    ahead = np.stack([np.interp(stops + 1.5, length, fine[:, k]) for k in range(2)], axis=1) - at
    yaw = np.unwrap(np.arctan2(ahead[:, 0], ahead[:, 1]))
    positions = np.stack([at[:, 0], np.full(num_frames, -EYE_M), at[:, 1]], axis=1)
    return held_by_hand(positions, yaw, np.random.default_rng(seed))


def _rounded(path: np.ndarray) -> np.ndarray:
    """Dense points (N, 2) of a way through crossings (K, 2), corners cut."""
    knots = np.linspace(0, len(path) - 1, 60 * len(path))
    dense = np.stack([np.interp(knots, np.arange(len(path)), path[:, k]) for k in range(2)], axis=1)
    return gaussian_filter1d(dense, 5.0, axis=0, mode="nearest")


def _length(points: np.ndarray) -> np.ndarray:
    """Length (N,) of the way up to each of its points (N, 2)."""
    return np.r_[0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]


def built(places: np.ndarray, seed: int) -> Scene:
    """Fronts along all lanes, floor and ceiling."""
    rng = np.random.default_rng([seed, 2])
    mesh = MeshBuilder(seed)
    lanes = len(places)
    apart = np.ptp(places[:, :, 0]) / (lanes - 1)
    outer = np.empty((lanes + 2, lanes + 2, 2))
    outer[1:-1, 1:-1] = places
    outer[0, 1:-1], outer[-1, 1:-1] = places[0] - [apart, 0], places[-1] + [apart, 0]
    outer[:, 0], outer[:, -1] = outer[:, 1] - [0, apart], outer[:, -2] + [0, apart]
    for i in range(lanes + 1):
        for j in range(lanes + 1):
            corners = outer[[i, i + 1, i + 1, i], [j, j, j + 1, j + 1]]
            _block(mesh, rng, _inset(corners))
    floor = mesh.texture(textures.terrazzo(rng, 1500, 1500), TEXELS)
    ceiling = mesh.texture(textures.mosaic(rng, 1500, 1500, (150, 140, 120)), TEXELS)
    low, high = places.min(axis=(0, 1)) - apart, places.max(axis=(0, 1)) + apart
    for x in np.arange(low[0], high[0], TILE_M):
        for z in np.arange(low[1], high[1], TILE_M):
            tile = (x, x + TILE_M), (z, z + TILE_M)
            mesh.level(*tile, 0.0, floor, up=True)
            mesh.level(*tile, -HEIGHT_M, ceiling, up=False)
    return mesh.build()


def _inset(corners: np.ndarray) -> np.ndarray:
    """Corners (4, 2) of a block, half a lane inside of its lanes' middles."""
    edges = np.roll(corners, -1, axis=0) - corners
    edges /= np.linalg.norm(edges, axis=1, keepdims=True)
    inwards = np.column_stack([-edges[:, 1], edges[:, 0]])
    found = []
    for k in range(4):
        sides = inwards[[k - 1, k]]
        found.append(corners[k] + np.linalg.solve(sides, np.full(2, HALF_WIDTH_M)))
    return np.array(found)


def _block(mesh: MeshBuilder, rng: np.random.Generator, corners: np.ndarray) -> None:
    """Fronts around a block: pictures beside each other, some standing out a little."""
    middle = corners.mean(axis=0)
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along = (end - start) / np.linalg.norm(end - start)
        outwards = np.array([along[1], -along[0]])
        outwards *= np.sign(outwards @ ((start + end) / 2 - middle))
        at, length = 0.0, float(np.linalg.norm(end - start))
        while at < length - 1e-6:
            wide = float(rng.uniform(2.5, 5.5))
            wide = length - at if length - at - wide < 2.0 else wide
            texels = int(TEXELS * HEIGHT_M), int(TEXELS * wide)
            image = mesh.texture(picture(rng, *texels, int(rng.integers(5))))
            out = float(rng.uniform(0, 0.3))
            place = start + (at + wide / 2) * along + out * outwards
            center = np.array([place[0], -HEIGHT_M / 2, place[1]])
            facing = np.array([outwards[0], 0.0, outwards[1]])
            mesh.panel(center, facing, (wide, HEIGHT_M), image)
            across = np.cross(DOWN, facing)
            for sign in (-1, 1):  # their sides, as deep as they can stand out
                edge = center + sign * across * wide / 2 - (out / 2) * facing
                mesh.panel(edge, sign * across, (max(out, 1e-3), HEIGHT_M), image)
            at += wide


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("-n", "--frames", type=int, default=5000)
    parser.add_argument("-w", "--width", type=int, default=512)
    parser.add_argument("--lanes", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    places = crossings(options.frames, options.lanes, options.seed)
    truth = walked(way(places), options.frames, options.seed)
    scene = built(places, options.seed)
    (options.out / "images").mkdir(parents=True, exist_ok=True)
    write_tum(options.out / "groundtruth.tum", truth)
    size = options.width, options.width // 2
    pictures = (render_erp(scene, pose, *size) for pose in truth.world_T_rigs)
    write_frames(options.out, truth, pictures, options.seed)


if __name__ == "__main__":
    main()
