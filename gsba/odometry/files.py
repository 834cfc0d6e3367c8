"""Odometry on disk: the trajectory, its keyframes, the status of each frame, and the report."""

import csv
from pathlib import Path

import numpy as np

from gsba.disk import atomic_write, write_json
from gsba.geometry import quaternion_from_rotation
from gsba.log import GsbaError
from gsba.odometry.tracker_state import FrameStatus
from gsba.odometry.walk import Odometry
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory

_AXES = ("rx", "ry", "rz", "tx", "ty", "tz")  # of a pose covariance


def write_odometry(found: Odometry, walk: Path, keyframes: Path, poses: Path, report: Path) -> None:
    """Write the poses of all frames and of the keyframes as TUM files, status and covariance of
    each pose as CSV, and the report as JSON."""
    for path in (walk, keyframes, poses, report):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_tum(keyframes, found.trajectory(keyframes=True))
    write_json(report, found.report())
    _write_poses(poses, found)
    write_tum(walk, found.trajectory())


def _write_poses(path: Path, found: Odometry) -> None:
    """Status, map, pose and upper triangle of the covariance [rotation, translation] of frames."""
    upper, covariances = np.triu_indices(6), found.covariances
    if covariances is None:
        covariances = np.full((len(found), 6, 6), np.nan)
    numbers = np.hstack(
        [
            found.world_T_rigs[:, :3, 3],
            quaternion_from_rotation(found.world_T_rigs[:, :3, :3]),
            covariances[:, *upper],
        ]
    )
    names = [f"cov_{_AXES[i]}_{_AXES[j]}" for i, j in zip(*upper, strict=True)]
    header = ["timestamp", "status", "keyframe", "map", "tx", "ty", "tz", "qw", "qx", "qy", "qz"]
    maps, posed = found.maps_in_turn(), found.posed()

    def write(temporary: Path) -> None:
        with temporary.open("w", newline="", encoding="utf-8") as file:
            table = csv.writer(file)
            table.writerow(header + names)
            for f, timestamp in enumerate(found.timestamps):
                status = FrameStatus(found.statuses[f]) if posed[f] else FrameStatus.LOST
                row = [repr(float(timestamp)), status.name.lower(), int(found.keyframes[f])]
                values = [f"{v:.9g}" if np.isfinite(v) else "" for v in numbers[f]]
                known = [int(maps[f]), *values] if posed[f] else [""] * (1 + len(values))
                table.writerow(row + known)

    atomic_write(path, write)


def write_chosen(found: Odometry, rows: np.ndarray, path: Path) -> None:
    """Write the poses of chosen frames (N,) as a TUM file, whose times select them for extraction.

    A file that holds them already is not rewritten: frames extracted by it stay valid.
    """
    chosen = Trajectory(found.timestamps[rows], found.world_T_rigs[rows])
    if path.is_file() and _holds(path, chosen):
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    write_tum(path, chosen)


def _holds(path: Path, trajectory: Trajectory) -> bool:
    """True if a file has a trajectory's times and poses, to the precision of the file."""
    try:
        written = read_trajectory(path)
    except GsbaError:
        return False
    return np.array_equal(written.timestamps, trajectory.timestamps) and np.allclose(
        written.world_T_rigs, trajectory.world_T_rigs, rtol=0, atol=1e-12
    )
