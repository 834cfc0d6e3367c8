"""Motion of a hand-held camera during the readout of a frame: path between frames, and gait."""

import numpy as np

from gsba.geometry import pose
from gsba.types import Trajectory

STEPS_HZ = 1.9  # steps per second; the body sways once in two steps
KNOTS = 17  # poses during a readout; motion between them is linear
# Amplitude of the camera's swing at each step (vertical, pitch) and over two steps (lateral).
SWING_UNITS = (0.010, 0.018, 0.010)  # along the rig's x, y, z
SWING_DEG = (1.2, 1.0, 1.2)  # about the rig's x, y, z
_SWING_RATES = 2 * np.pi * STEPS_HZ * np.array([0.5, 1.0, 0.5, 1.0, 0.5, 0.5])  # rad/s


def poses_during(truth: Trajectory, readout_s: float, seed: int) -> np.ndarray:
    """Poses of the rig from the first to the last row of each frame.

    The path is smooth, and the frames' poses are those in the middle of the readout. The gait is
    added with a random phase, relative to its value in the middle of the readout.

    Args:
        truth: F poses, at least 3.
        readout_s: readout time from the first row to the last one, seconds.
        seed: seed of the phase.

    Returns:
        (F, KNOTS, 4, 4) float64, evenly spaced in time; (F, 1, 4, 4) for a readout time of 0.
    """
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    if readout_s == 0:
        return truth.world_T_rigs[:, None]
    after = readout_s * np.linspace(-0.5, 0.5, KNOTS)
    times = truth.timestamps[:, None] + after
    between = CubicSpline(truth.timestamps, truth.world_T_rigs[:, :3, 3])
    orientations = Rotation.from_matrix(truth.world_T_rigs[:, :3, :3])
    turned = RotationSpline(truth.timestamps, orientations)(times.ravel())
    phases = np.random.default_rng([seed, 2]).uniform(0, 2 * np.pi, 6)
    swing = np.concatenate([SWING_UNITS, np.radians(SWING_DEG)])
    at = swing * np.sin(times[..., None] * _SWING_RATES + phases)
    at -= swing * np.sin(truth.timestamps[:, None, None] * _SWING_RATES + phases)
    rotations = turned * Rotation.from_rotvec(at[..., 3:].reshape(-1, 3))
    moved = turned.apply(at[..., :3].reshape(-1, 3)).reshape(*times.shape, 3)
    positions = between(times) + moved
    return pose(rotations.as_matrix().reshape(*times.shape, 3, 3), positions)
