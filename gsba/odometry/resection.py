"""The pose of one frame from bearings of known points (resection), robust to false ones."""

from dataclasses import dataclass

import numpy as np

from factors import tangent_basis
from gsba.camera.rig import witnesses
from gsba.significance import least_agreeing

_STEPS = 12  # Gauss-Newton
_CONVERGED = 1e-6  # radians, and parts of the median distance
_ANNEALED = (8.0, 4.0, 2.0, 1.0)  # scale of the loss in the first steps, times the last
_GATE = 3.5  # standard deviations of an inlier
_SAMPLE = 3  # bearings that determine a pose
_CELLS = 16  # along a cube face's side: all features within one cell, 6 degrees, are one witness
_MIN_WITNESSES = 20  # that agree: fewer may be of one thing that moves on its own
_MAX_FALSE_ALARMS = 1e-6  # poses that chance explains as well as the one believed
_CHANCE_SPAN = np.deg2rad(6.0)  # false matches lie anywhere within this of where they were expected
_MAX_POSITION_SIGMA = 0.05  # of the position, in median distances of the points


@dataclass(frozen=True, slots=True)
class Resection:
    """A pose, and what speaks for it."""

    world_T_rig: np.ndarray  # (4, 4) float64, map units
    inliers: np.ndarray  # (N,) bool
    noise: float  # radians, standard deviation of the inliers per axis
    covariance: np.ndarray  # (6, 6) float64, tangent [rotation rad, translation], map units
    significant: bool  # chance does not explain the inliers, and they fix the position


def resect(
    points_world: np.ndarray, bearings_rig: np.ndarray, start: np.ndarray, sigma: float
) -> Resection:
    """Minimise the Geman-McClure loss of the angles between bearings and points over the pose.

    Args:
        points_world: (N, 3) map units.
        bearings_rig: (N, 3) unit, rig frame.
        start: (4, 4) world_T_rig to begin at.
        sigma: radians, standard deviation of bearings per axis.
    """
    pose, distance = start.copy(), 1.0
    bases = tangent_basis(bearings_rig) if len(bearings_rig) else np.zeros((0, 2, 3))
    information = np.zeros((6, 6))
    for step in range(_STEPS):
        scale = 3 * sigma * _ANNEALED[min(step, len(_ANNEALED) - 1)]
        residuals, jacobians, distances = linearised(points_world, bases, bearings_rig, pose)
        if not len(residuals):
            break
        squares = np.sum(residuals**2, axis=1)
        weights = (scale**2 / (scale**2 + squares)) ** 2
        distance = float(np.median(distances))
        jacobian = jacobians.reshape(-1, 6)
        weighted = jacobian * np.repeat(weights, 2)[:, None]
        information = weighted.T @ jacobian
        damping = 1e-9 * np.diag([1.0] * 3 + [distance**-2] * 3) * len(weights)
        tangent = -np.linalg.solve(information + damping, weighted.T @ residuals.ravel())
        limit = 0.5 * distance / max(float(np.linalg.norm(tangent[3:])), 1e-12)
        pose = retracted(pose, tangent * min(1.0, limit))
        small = max(np.abs(tangent[:3]).max(), np.abs(tangent[3:]).max() / distance) < _CONVERGED
        if small and step >= len(_ANNEALED):
            break
    residuals, _, distances = linearised(points_world, bases, bearings_rig, pose)
    squares = np.sum(residuals**2, axis=1)
    inliers = squares < (_GATE * sigma) ** 2
    noise = sigma
    if inliers.any():
        noise = float(np.sqrt(np.median(squares[inliers]) / 1.386))
    covariance = max(noise, 0.3 * sigma) ** 2 * np.linalg.pinv(information, hermitian=True)
    significant = _significant(bearings_rig, inliers, sigma)
    spread = np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])
    significant &= spread < _MAX_POSITION_SIGMA * distance
    return Resection(pose, inliers, noise, covariance, bool(significant))


def linearised(
    points_world: np.ndarray, bases: np.ndarray, bearings_rig: np.ndarray, world_T_rig: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals (N, 2), Jacobians (N, 2, 6) by the pose, and distances (N,) of the points.

    The residual is the unit direction to the point on the bearing's tangent plane; points behind
    count as a radian off. The tangent [rotation, translation] is applied on the right.

    Args:
        bases: (N, 2, 3) `tangent_basis` of the bearings.
        points_world, bearings_rig, world_T_rig: as for `resect`.
    """
    rotation = world_T_rig[:3, :3]
    offsets = (points_world - world_T_rig[:3, 3]) @ rotation
    distances = np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)
    directions = offsets / distances[:, None]
    residuals = np.einsum("nij,nj->ni", bases, directions)
    behind = np.einsum("ni,ni->n", directions, bearings_rig) <= 0
    residuals[behind] = [1.0, 0.0]
    # d(direction)/d(offset) = (I - d d^T) / distance; d(offset) = offset x rotation - translation.
    across = (bases - residuals[:, :, None] * directions[:, None, :]) / distances[:, None, None]
    jacobians = np.empty((len(offsets), 2, 6))
    jacobians[:, :, :3] = np.cross(across, offsets[:, None, :])
    jacobians[:, :, 3:] = -across
    jacobians[behind] = 0.0
    return residuals, jacobians, distances


def retracted(world_T_rig: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """A pose (4, 4) moved by a tangent (6,) [rotation, translation] on its right (GTSAM's)."""
    import gtsam

    return gtsam.Pose3(world_T_rig).retract(tangent).matrix()


def _significant(bearings: np.ndarray, inliers: np.ndarray, sigma: float) -> bool:
    """Whether chance does not explain the inliers among features that are independent."""
    num = witnesses(bearings, _CELLS) if len(bearings) else 0
    agreeing = witnesses(bearings[inliers], _CELLS) if inliers.any() else 0
    chance = min((_GATE * sigma / _CHANCE_SPAN) ** 2, 0.5)
    per_witness = 1 - (1 - chance) ** (len(bearings) / max(num, 1))
    needed = least_agreeing(num, per_witness, _SAMPLE, _MAX_FALSE_ALARMS)
    return agreeing >= max(needed, _MIN_WITNESSES)
