"""A walk in a world of its own, and where it is on the earth."""

from pathlib import Path

import export_scene as scene
import numpy as np
from plain_records import frames_of, observing
from scipy.spatial.transform import Rotation

from gsba.geometry import pose
from gsba.placement.gps import local_from_geodetic
from gsba.placement.placement import Placement
from gsba.similarity import Sim3
from gsba.types import FrameSet, PictureFormat, Reconstruction

ORIGIN = np.array([48.137, 11.575, 520.0])


def frame_set(num: int = scene.NUM_FRAMES) -> FrameSet:
    names = [f"frame_{f:04d}" for f in range(num)]
    paths = [(Path(name),) for name in names]
    return frames_of(PictureFormat("erp", 512, 256), paths, np.arange(num) * 0.5, names)


def walk_result(num: int = 40, straight: bool = False) -> Reconstruction:
    """A walk in a world turned, scaled and shifted at random against level metres."""
    rng = np.random.default_rng(3)
    t = np.linspace(0, 1, num)
    path = np.column_stack([30 * t, 8 * np.sin(7 * t) * (not straight), 1.5 + 0.2 * np.cos(9 * t)])
    if straight:
        path[:, 2] = 1.5
    poses = pose(Rotation.from_rotvec(rng.normal(0, 0.3, (num, 3))).as_matrix(), path)
    base = scene.reconstruction()
    keep = base.observation_frames < 0
    world = observing(
        base,
        keep,
        world_T_rigs=poses,
        pose_covariances=np.tile(np.diag([1.0, 2, 3, 4, 5, 6]) * 1e-6, (num, 1, 1)),
        pose_statuses=np.zeros(num, np.uint8),
    )
    turn = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    return Placement(Sim3(0.21, turn, np.array([3.0, -2.0, 5.0]))).apply(world)


def write_fixes(path: Path, times: np.ndarray, geodetic: np.ndarray) -> Path:
    """A table of fixes (N, 3), latitude, longitude and altitude, at these times (N,)."""
    rows = np.column_stack([times, geodetic]).tolist()
    lines = [f"{t!r},{lat:.12f},{lon:.12f},{alt:.6f}" for t, lat, lon, alt in rows]
    path.write_text("\n".join(["timestamp,lat,lon,alt", *lines]) + "\n")
    return path


def level_metres(result: Reconstruction) -> np.ndarray:
    """True level metres of the frames of `walk_result`: the inverse of what was done there."""
    turn = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    return (result.world_T_rigs[:, :3, 3] - [3.0, -2.0, 5.0]) @ turn / 0.21


def geodetic_of(local: np.ndarray) -> np.ndarray:
    """Latitude, longitude, altitude of metres east, north, up: Newton on the forward formula."""
    found = np.tile(ORIGIN, (len(local), 1))
    for _ in range(6):
        off = local - local_from_geodetic(found, ORIGIN)
        metres = 111_320.0
        found += np.column_stack(
            [off[:, 1] / metres, off[:, 0] / metres / np.cos(np.deg2rad(ORIGIN[0])), off[:, 2]]
        )
    return found
