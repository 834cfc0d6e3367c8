"""Two trajectories of one run: frames between keyframes follow these by their relative motion."""

import numpy as np

from gsba.geometry import inverse, pose
from gsba.log import GsbaError
from gsba.types import Trajectory

_MAX_TIME_DIFFERENCE_S = 1e-3  # largest time difference of entries of one frame


def follow_keyframes(frames: Trajectory, keyframes: Trajectory) -> Trajectory:
    """Frame poses corrected by the keyframes around them.

    After a loop closure a SLAM corrects its keyframes, but not the frames between them. Each frame
    is moved with the keyframe before it and with the one after it by their relative motion in the
    frame trajectory, and is interpolated between both results in time; beyond the ends there is
    only one.

    Args:
        keyframes: K poses of the same run, in the same world and on the same clock.

    Returns:
        Poses at all times of both trajectories.

    Raises:
        GsbaError: fewer than two keyframes are frames of the trajectory.
    """
    nearest = np.searchsorted(frames.timestamps, keyframes.timestamps)
    nearest = np.clip(nearest, 1, len(frames.timestamps) - 1)
    gaps = np.abs(frames.timestamps[[nearest - 1, nearest]] - keyframes.timestamps)
    nearest = nearest - (gaps[0] < gaps[1])
    shared = gaps.min(axis=0) < _MAX_TIME_DIFFERENCE_S
    if shared.sum() < 2:
        raise GsbaError(
            f"only {shared.sum()} of {len(shared)} keyframes have the time of a frame of the "
            "trajectory: give both files of one run"
        )
    at, leading = nearest[shared], keyframes.world_T_rigs[shared]
    moves = leading @ inverse(frames.world_T_rigs[at])  # correction of the world at each keyframe
    after = np.searchsorted(at, np.arange(len(frames.timestamps)), side="right")
    before, after = np.clip(after - 1, 0, None), np.clip(after, 0, len(at) - 1)
    times = frames.timestamps
    span = np.maximum(times[at[after]] - times[at[before]], 1e-12)
    share = np.clip((times - times[at[before]]) / span, 0, 1)
    first, second = moves[before] @ frames.world_T_rigs, moves[after] @ frames.world_T_rigs
    followed = _interpolated(first, second, share)
    times = np.concatenate([times, keyframes.timestamps[~shared]])
    poses = np.concatenate([followed, keyframes.world_T_rigs[~shared]])
    order = np.argsort(times)
    return Trajectory(times[order], poses[order])


def _interpolated(first: np.ndarray, second: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) interpolated from the first to the second by shares (N,)."""
    from scipy.spatial.transform import Rotation

    turn = np.swapaxes(first[:, :3, :3], 1, 2) @ second[:, :3, :3]
    part = Rotation.from_rotvec(share[:, None] * Rotation.from_matrix(turn).as_rotvec())
    positions = (1 - share[:, None]) * first[:, :3, 3] + share[:, None] * second[:, :3, 3]
    return pose(first[:, :3, :3] @ part.as_matrix(), positions)
