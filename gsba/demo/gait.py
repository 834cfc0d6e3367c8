"""How the hand moves while a frame is read: a walk between its frames, and the steps taken."""

import numpy as np

from gsba.geometry import pose
from gsba.types import Trajectory

STEPS_HZ = 1.9  # steps per second; the body sways once in two of them
KNOTS = 17  # poses over a readout; between them motion is straight
# Swing of the camera at each step (up and down, nodding) and over two of them (aside).
SWING_UNITS = (0.010, 0.018, 0.010)  # rig's x, y, z
SWING_DEG = (1.2, 1.0, 1.2)  # about them
_RATES = 2 * np.pi * STEPS_HZ * np.array([0.5, 1.0, 0.5, 1.0, 0.5, 0.5])  # rad/s, each swing


def poses_during(truth: Trajectory, readout_s: float, seed: int) -> np.ndarray:
    """Poses of the rig from the first to the last row of each frame.

    The walk goes smoothly through its frames, whose poses are those in the middle of the readout.
    Steps have a phase of their own by the seed. What they did up to that middle is in its pose.

    Args:
        truth: F poses, at least 3.
        readout_s: seconds from the first row to the last one.

    Returns:
        (F, KNOTS, 4, 4) float64, evenly spaced in time; (F, 1, 4, 4) where all is read at once.
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
    at = swing * np.sin(times[..., None] * _RATES + phases)
    at -= swing * np.sin(truth.timestamps[:, None, None] * _RATES + phases)
    rotations = turned * Rotation.from_rotvec(at[..., 3:].reshape(-1, 3))
    moved = turned.apply(at[..., :3].reshape(-1, 3)).reshape(*times.shape, 3)
    positions = between(times) + moved
    return pose(rotations.as_matrix().reshape(*times.shape, 3, 3), positions)
