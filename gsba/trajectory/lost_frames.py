"""Rows of a trajectory by which a SLAM says that it lost a frame: exact repeats of a pose.

No tracked pose equals another one, or the identity, to the last digit. A SLAM that lost a frame
writes its last pose again, or the identity. Odometry of a vehicle that stands repeats its pose as
well, and a new map begins at the identity: the motion behind the repeats tells these apart.
"""

import logging

import numpy as np

from gsba.geometry import rotation_angle
from gsba.types import Trajectory

_log = logging.getLogger(__name__)

_MIN_TURN_RAD = np.deg2rad(0.5)  # a smaller one is noise
_MIN_JUMP_PACES = 4.0  # median speeds: faster than any step of the walk itself


def without_lost_frames(trajectory: Trajectory) -> Trajectory:
    """A trajectory without rows that repeat a pose because the frame was lost.

    An identity is lost where it is repeated, at the end, and where the path goes on from where it
    was before: in motion and turn together, as a new map has a scale of its own.
    Another repeated pose is lost at the end, and where the step behind it makes up for the time in
    which it was repeated; where the path goes on at its usual pace, the camera stood.

    Args:
        trajectory: N entries; at least the first of all equal poses remains.
    """
    poses, times = trajectory.world_T_rigs, trajectory.timestamps
    speeds = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / np.diff(times)
    if not (speeds > 0).any():
        return trajectory
    pace = float(np.median(speeds[speeds > 0]))
    same = (poses[1:] == poses[:-1]).all(axis=(1, 2))
    begins = np.flatnonzero(np.concatenate([[True], ~same]))
    ends = np.append(begins[1:], len(poses)) - 1
    lost = np.zeros(len(poses), bool)
    for first, last in zip(begins.tolist(), ends.tolist(), strict=True):
        if (poses[first] == np.eye(4)).all():
            lost[first : last + 1] = _lost_identity(trajectory, first, last, pace)
        elif last > first:
            lost[first + 1 : last + 1] = _lost_repeat(trajectory, first, last, pace)
    if not lost.any() or np.count_nonzero(~lost) < 2:
        return trajectory
    _log.warning(
        "%d of %d rows of the trajectory have no pose, as of lost frames (they repeat the identity "
        "or the pose before; the first is of time %.6f): left out",
        lost.sum(),
        len(lost),
        times[lost][0],
    )
    return Trajectory(times[~lost], poses[~lost])


def _speed(trajectory: Trajectory, before: int, after: int) -> float:
    """Mean speed from one entry to another, units per second."""
    step = np.diff(trajectory.world_T_rigs[[before, after], :3, 3], axis=0)
    duration = np.diff(trajectory.timestamps[[before, after]])[0]
    return max(float(np.linalg.norm(step) / duration), 1e-300)


def _turn(trajectory: Trajectory, before: int, after: int) -> float:
    """Mean angular velocity from one entry to another, radians per second."""
    first, second = trajectory.world_T_rigs[[before, after], :3, :3]
    duration = np.diff(trajectory.timestamps[[before, after]])[0]
    return max(float(rotation_angle(first.T @ second)), _MIN_TURN_RAD) / float(duration)


def _lost_identity(trajectory: Trajectory, first: int, last: int, pace: float) -> np.ndarray:
    """Entries (n,) bool from `first` to `last`, all the identity, that are of lost frames."""
    rows = np.ones(last - first + 1, bool)
    if last + 1 == len(trajectory.timestamps):
        return rows
    # Of equal rows, the last one may be the first frame of a map.
    rows[-1] = _speed(trajectory, last, last + 1) > _MIN_JUMP_PACES * pace
    if first > 0:
        moved = _speed(trajectory, first - 1, last + 1) / _speed(trajectory, last, last + 1)
        turned = _turn(trajectory, first - 1, last + 1) / _turn(trajectory, last, last + 1)
        rows[-1] |= moved * turned < 1
    return rows


def _lost_repeat(trajectory: Trajectory, first: int, last: int, pace: float) -> bool:
    """True if a pose is repeated from `first` to `last` as frames were lost."""
    if last + 1 == len(trajectory.timestamps):
        return True
    steady, sudden = (_speed(trajectory, row, last + 1) for row in (first, last))
    return steady * sudden > pace**2  # the steady one is nearer to the pace
