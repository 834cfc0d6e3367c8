"""Odometry on disk: the trajectory, its keyframes, and what happened."""

from pathlib import Path

import numpy as np

from gsba.disk import write_json
from gsba.log import GsbaError
from gsba.odometry.walk import Odometry
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory


def write_odometry(found: Odometry, walk: Path, keyframes: Path, report: Path) -> None:
    """Write the poses of all frames and of the keyframes as TUM files, and the report as JSON."""
    for path in (walk, keyframes, report):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_tum(keyframes, found.trajectory(keyframes=True))
    write_json(report, found.report())
    write_tum(walk, found.trajectory())


def write_chosen(found: Odometry, rows: np.ndarray, path: Path) -> None:
    """Write the poses of chosen frames (N,) as a TUM file, by whose times they are extracted.

    A file that holds them already is left as it is: what was extracted by it stays valid.
    """
    chosen = Trajectory(found.timestamps[rows], found.world_T_rigs[rows])
    if path.is_file() and _holds(path, chosen):
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    write_tum(path, chosen)


def _holds(path: Path, trajectory: Trajectory) -> bool:
    """Whether a file has a trajectory's times and, as far as they are written, its poses."""
    try:
        written = read_trajectory(path)
    except GsbaError:
        return False
    return np.array_equal(written.timestamps, trajectory.timestamps) and np.allclose(
        written.world_T_rigs, trajectory.world_T_rigs, rtol=0, atol=1e-12
    )
