"""Rendered walks of a camera with lenses in a ring, all level: stitched at infinity, and raw."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from one_gallery import gallery
from pixels import pixel_centres
from scipy.spatial.transform import Rotation

from gsba.camera.fisheye import Rig, facing, lens_names, projection_of, rotation_of
from gsba.camera.projections import RadialProjection
from gsba.camera.sphere import erp_directions, erp_from_bearings
from gsba.demo.degrade import degrade
from gsba.demo.render import render_erp
from gsba.demo.walk import walk_poses
from gsba.geometry import pose
from gsba.trajectory.files import write_tum
from gsba.types import Fisheye

NUM_FRAMES, WIDTH, SIZE = 16, 768, 448
RADIUS = 0.025  # of the ring, units
_HALF_FOV = np.deg2rad(100.0)
_BEND = (-0.025, 0.0018, 0.0, 0.0)
_LENS = Fisheye(SIZE, SIZE, 0.30457 * SIZE, (SIZE / 2, SIZE / 2), _BEND, (0.0, 0.0, 0.0))


def ring(num: int) -> Rig:
    """Lenses that look outwards, evenly spaced, the front one along the rig's z."""
    rotations = [(0.0, 2 * np.pi * lens / num, 0.0) for lens in range(num)]
    return tuple(replace(_LENS, rotation=rotation) for rotation in rotations)


def distance(num: int) -> float:
    """Between neighbouring lenses' centres, units."""
    return 2 * RADIUS * float(np.sin(np.pi / num))


def write_calibration(
    path: Path, rig: Rig, axes: np.ndarray, own: RadialProjection | None = None, model: str = ""
) -> None:
    """A calibration file of lenses whose centres lie along axes (L, 3); `own` is their projection
    if it is another, named `model`."""
    lenses = {
        name: {
            "width": lens.width,
            "height": lens.height,
            "f": lens.focal if own is None else own.focal,
            "cx": lens.principal[0],
            "cy": lens.principal[1],
            "k": list(lens.radial if own is None else own.radial),
            "rig_T_lens": pose(rotation_of(lens), RADIUS * axis).tolist(),
        }
        for name, lens, axis in zip(lens_names(len(rig)), rig, axes, strict=True)
    }
    named = {"model": model} if model else {}
    path.write_text(json.dumps({"unit": "m", "lenses": lenses, **named}))


def render(folder: Path, num: int, own: RadialProjection | None = None, model: str = "") -> None:
    """Write `images/` (stitched), `raw/` (a folder of each lens), calibration, truth and coarse
    trajectories of three seeds."""
    truth, scene, rig = (walk_poses("rectangle", "forward", NUM_FRAMES, 0), gallery(), ring(num))
    axes, names = np.array([rotation_of(lens)[:, 2] for lens in rig]), lens_names(num)
    faced = facing(erp_directions(WIDTH), axes)
    maps = [_maps(lens, own or projection_of(lens)) for lens in rig]
    for part in ("images", *(f"raw/{name}" for name in names)):
        (folder / part).mkdir(parents=True)
    for f, world_T_rig in enumerate(truth.world_T_rigs):
        joined = np.zeros((WIDTH // 2, WIDTH, 3), np.uint8)
        for lens, (name, (places, dark)) in enumerate(zip(names, maps, strict=True)):
            at = world_T_rig.copy()
            at[:3, 3] += RADIUS * world_T_rig[:3, :3] @ axes[lens]
            seen = render_erp(scene, at, 1024, 512).clip(0, 255).astype(np.uint8)
            picture = cv2.remap(seen, places[0], places[1], cv2.INTER_CUBIC, borderMode=3)
            picture[dark] = 0
            cv2.imwrite(str(folder / f"raw/{name}/{f:04d}.png"), picture[..., ::-1])
            seen = render_erp(scene, at, WIDTH, WIDTH // 2).clip(0, 255).astype(np.uint8)
            joined[faced == lens] = seen[faced == lens]
        cv2.imwrite(str(folder / f"images/{f:04d}.png"), joined[..., ::-1])
    rows = [f"{f:04d},{time!r}" for f, time in enumerate(truth.timestamps.tolist())]
    for part in ("images", "raw"):
        (folder / part / "timestamps.csv").write_text("\n".join(rows))
    write_tum(folder / "truth.tum", truth)
    for seed in range(3):
        write_tum(folder / f"slam{seed}.tum", degrade(truth, seed))
    write_calibration(folder / "calibration.json", rig, axes, own, model)


def turned_off(rig: Rig) -> Rig:
    """A calibration that is somewhat wrong: focal lengths, principal points, rotations."""
    found = []
    for number, lens in enumerate(rig):
        sign = 1.0 - 2 * (number % 2)
        rotation = Rotation.from_rotvec([0.008 * sign, -0.01, 0.006 * sign])
        turn = (
            Rotation.from_rotvec(lens.rotation)
            if number == 0
            else rotation * Rotation.from_rotvec(lens.rotation)
        )
        a, b, c = turn.as_rotvec().tolist()
        x, y = lens.principal
        found.append(
            replace(
                lens,
                focal=(1 - 0.02 * sign) * lens.focal,
                principal=(x + 1, y - sign),
                rotation=(a, b, c),
            )
        )
    return tuple(found)


def _maps(lens: Fisheye, own: RadialProjection) -> tuple[np.ndarray, np.ndarray]:
    """OpenCV pixels (2, h, w) in a panorama of 1024 pixels; True (h, w) beyond the circle."""
    pixels = pixel_centres(SIZE, SIZE)
    directions = own.unproject(pixels) @ rotation_of(lens).T
    maps = np.moveaxis(erp_from_bearings(directions, 1024, 512) - 0.5, -1, 0).astype(np.float32)
    return maps, directions @ rotation_of(lens)[:, 2] < np.cos(_HALF_FOV)
