"""Keys and values of pose variables, and the factors that hold a map's extent."""

import gtsam
import numpy as np

from gsba.geometry import furthest

X = gtsam.symbol_shorthand.X


def values_of(world_T_rigs: np.ndarray, others: gtsam.Values | None = None) -> gtsam.Values:
    """Poses (F, 4, 4) under their keys, and other variables; None = there are none."""
    values = gtsam.Values() if others is None else gtsam.Values(others)
    for f, world_T_rig in enumerate(world_T_rigs):
        values.insert(X(f), gtsam.Pose3(world_T_rig))
    return values


def poses_of(values: gtsam.Values, num_frames: int) -> np.ndarray:
    """Poses (F, 4, 4) of the first keys."""
    return np.array([values.atPose3(X(f)).matrix() for f in range(num_frames)])


def pose_noise(rotation: float, translation: float) -> gtsam.noiseModel.Diagonal:
    """Independent noise of a pose's tangent, the same along all axes: standard deviations of the
    rotation, radians, and of the translation, map units."""
    return gtsam.noiseModel.Diagonal.Sigmas(np.array([rotation] * 3 + [translation] * 3))


def fixed_scale(
    world_T_rigs: np.ndarray, components: np.ndarray | None = None, sigma: float = 1e-6
) -> gtsam.NonlinearFactorGraph:
    """A tight factor on the distance from the first frame to the one furthest from it, of sigma,
    part of it. Each map of components (F,), None = there is one, gets such a factor, and those
    behind the first frame's a fixed pose besides."""
    held = gtsam.NonlinearFactorGraph()
    if components is None:
        components = np.zeros(len(world_T_rigs), np.int32)
    for component in np.unique(components):
        rows = np.flatnonzero(components == component)
        first = int(rows[0])
        far, distance = furthest(world_T_rigs[rows, :3, 3])
        if distance > 0:
            noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma * distance)
            held.add(gtsam.RangeFactorPose3(X(first), X(int(rows[far])), distance, noise))
        if first > 0:
            fixed = gtsam.Pose3(world_T_rigs[first])
            noise = pose_noise(sigma, sigma * max(distance, 1e-12))
            held.add(gtsam.PriorFactorPose3(X(first), fixed, noise))
    return held
