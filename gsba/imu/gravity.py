"""The vertical from an accelerometer: it measures gravity at rest, and on average on the move."""

import numpy as np

from gsba.geometry import median_direction
from gsba.imu.alignment import Alignment, orientations
from gsba.imu.readings import Readings

_MEAN_SPAN_S = 1.05  # s over which a force is averaged: two steps, in which sways cancel out
_MIN_MEANS = 3  # least number of such means
_GRAVITY_M_S2 = 9.80665  # m/s^2, standard gravity
_MAX_RELATIVE_DEVIATION = 0.2  # largest relative deviation of a mean's length from gravity


def up_axis(
    readings: Readings, found: Alignment, timestamps: np.ndarray, world_R_rigs: np.ndarray
) -> np.ndarray | None:
    """Unit vector (3,) along the vertical in the world; None if forces do not determine it.

    Forces are rotated into the world by the pose of the frame before and the gyro since then, and
    averaged over two steps each. Longer accelerations are outliers: the result is the geometric
    median of the means.

    Args:
        found: alignment of the readings with the frames.
        timestamps: (F,) times of frames, seconds, on their own clock.
        world_R_rigs: (F, 3, 3) refined rotations.
    """
    if readings.forces is None:
        return None
    times = found.clock.times(timestamps)
    inside = (readings.timestamps >= times[0]) & (readings.timestamps <= times[-1])
    if not inside.any():
        return None
    at, forces = readings.timestamps[inside], readings.forces[inside] @ found.rig_R_imu.T
    before = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 1)
    turned = orientations(readings, found, np.concatenate([times, at]))
    of_frames, of_forces = turned[: len(times)], turned[len(times) :]
    worlds = world_R_rigs @ np.swapaxes(of_frames, 1, 2)
    up = np.einsum("nij,njk,nk->ni", worlds[before], of_forces, forces)
    part = ((at - at[0]) / _MEAN_SPAN_S).astype(int)
    counts = np.bincount(part)
    full = counts > 0.5 * np.median(counts[counts > 0])
    means = np.column_stack([np.bincount(part, column) for column in up.T])
    means = means[full] / counts[full, None]
    lengths = np.linalg.norm(means, axis=1)
    right = np.abs(lengths - _GRAVITY_M_S2) < _MAX_RELATIVE_DEVIATION * _GRAVITY_M_S2
    if right.sum() < _MIN_MEANS:
        return None
    return median_direction(means[right] / lengths[right, None])
