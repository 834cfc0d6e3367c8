"""The pose of one frame from bearings of known points (resection), robust to outliers."""

from dataclasses import dataclass

import gtsam
import numpy as np

from factors import tangent_basis
from factors.compiled import kernel_and_part
from gsba.matching.absolute_pose import is_significant

_kernel, _part = kernel_and_part()
_CONVERGED = 1e-6  # radians, and parts of the median distance
_ANNEALED = (8.0, 4.0, 2.0, 1.0)  # factors on the scale of the loss in the first steps
_GATE = 3.5  # standard deviations of an inlier
_MIN_WITNESSES = 20  # least number of witnesses: fewer may be of one moving object


@dataclass(frozen=True, slots=True)
class Resection:
    """A pose, and the evidence for it."""

    world_T_rig: np.ndarray  # (4, 4) float64, map units
    inliers: np.ndarray  # (N,) bool
    noise: float  # radians, standard deviation of the inliers per axis
    covariance: np.ndarray  # (6, 6) float64, tangent [rotation rad, translation], map units
    significant: bool  # True if chance does not explain the inliers, and they determine the
    # position


def resect(
    points_world: np.ndarray, bearings_rig: np.ndarray, start: np.ndarray, sigma: float
) -> Resection:
    """Minimise the Geman-McClure loss of the angles between unit bearings (N, 3), rig frame, of
    noise sigma, radians per axis, and points (N, 3), map units, over the pose (4, 4)."""
    pose, information, residuals, distances = _fitted(points_world, bearings_rig, start, sigma)
    squares = np.sum(residuals**2, axis=1)
    inliers = squares < (_GATE * sigma) ** 2
    noise = sigma
    if inliers.any():
        noise = float(np.sqrt(np.median(squares[inliers]) / 1.386))
    distance = float(np.median(distances)) if len(distances) else 1.0
    covariance = max(noise, 0.3 * sigma) ** 2 * np.linalg.pinv(information, hermitian=True)
    # false matches lie anywhere within 6 degrees of their prediction
    chance = (_GATE * sigma / np.deg2rad(6.0)) ** 2
    significant = is_significant(bearings_rig, inliers, chance, least=_MIN_WITNESSES)
    spread = np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])
    significant &= bool(spread < 0.05 * distance)  # of the position, in median distances of points
    return Resection(pose, inliers, noise, covariance, significant)


def _fitted(
    points_world: np.ndarray, bearings_rig: np.ndarray, start: np.ndarray, sigma: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pose (4, 4), its information (6, 6) at unit variance, residuals (N, 2), distances (N,)."""
    num = len(bearings_rig)
    world_T_rig = start.copy()
    residuals, distances = np.empty((num, 2)), np.empty(num)
    if not num:
        return world_T_rig, np.zeros((6, 6)), residuals, distances
    bases = tangent_basis(bearings_rig)
    information, gradient = np.empty((6, 6)), np.empty(6)
    observed = points_world, bases, bearings_rig
    for step in range(12):  # Gauss-Newton steps
        scale = 3 * sigma * _ANNEALED[min(step, len(_ANNEALED) - 1)]
        found = residuals, distances, information, gradient
        _normal_equations(*observed, world_T_rig, scale, *found)
        distance = float(np.median(distances))
        damping = 1e-9 * np.diag([1.0] * 3 + [distance**-2] * 3) * num
        tangent = -np.linalg.solve(information + damping, gradient)
        limit = 0.5 * distance / max(float(np.linalg.norm(tangent[3:])), 1e-12)
        world_T_rig = gtsam.Pose3(world_T_rig).retract(tangent * min(1.0, limit)).matrix()
        small = max(np.abs(tangent[:3]).max(), np.abs(tangent[3:]).max() / distance) < _CONVERGED
        if small and step >= len(_ANNEALED):
            break
    before = information.copy()
    _normal_equations(*observed, world_T_rig, scale, residuals, distances, information, gradient)
    return world_T_rig, before, residuals, distances


def linearised(
    points_world: np.ndarray, bases: np.ndarray, bearings_rig: np.ndarray, world_T_rig: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals (N, 2), Jacobians (N, 2, 6) by the pose, and distances (N,) of the points, as for
    `resect`; bases: (N, 2, 3) `tangent_basis` of the bearings.

    The residual is the unit direction to the point on the bearing's tangent plane; points behind
    count as a radian off. The tangent [rotation, translation] is applied on the right.
    """
    num = len(bearings_rig)
    residuals, jacobians, distances = np.empty((num, 2)), np.empty((num, 2, 6)), np.empty(num)
    _linearise(points_world, bases, bearings_rig, world_T_rig, residuals, jacobians, distances)
    return residuals, jacobians, distances


@_part
def _linearise_one(points, bases, bearings, world_T_rig, i, residual, jacobian):
    """Residual (2,) and Jacobian (2, 6) of observation i, and the distance of its point."""
    dx = points[i, 0] - world_T_rig[0, 3]
    dy = points[i, 1] - world_T_rig[1, 3]
    dz = points[i, 2] - world_T_rig[2, 3]
    # Offset of the point in the rig frame
    x = world_T_rig[0, 0] * dx + world_T_rig[1, 0] * dy + world_T_rig[2, 0] * dz
    y = world_T_rig[0, 1] * dx + world_T_rig[1, 1] * dy + world_T_rig[2, 1] * dz
    z = world_T_rig[0, 2] * dx + world_T_rig[1, 2] * dy + world_T_rig[2, 2] * dz
    distance = max(np.sqrt(x * x + y * y + z * z), 1e-12)
    u, v, w = x / distance, y / distance, z / distance
    if u * bearings[i, 0] + v * bearings[i, 1] + w * bearings[i, 2] <= 0:
        residual[0], residual[1] = 1.0, 0.0
        for k in range(6):
            jacobian[0, k] = jacobian[1, k] = 0.0
        return distance
    for n in range(2):
        a, b, c = bases[i, n, 0], bases[i, n, 1], bases[i, n, 2]
        off = a * u + b * v + c * w
        residual[n] = off
        # d(direction)/d(offset) = (I - d d^T) / distance; d(offset) = offset x rotation -
        # translation.
        a, b, c = (a - off * u) / distance, (b - off * v) / distance, (c - off * w) / distance
        jacobian[n, 0] = b * z - c * y
        jacobian[n, 1] = c * x - a * z
        jacobian[n, 2] = a * y - b * x
        jacobian[n, 3], jacobian[n, 4], jacobian[n, 5] = -a, -b, -c
    return distance


@_kernel
def _linearise(points, bases, bearings, world_T_rig, residuals, jacobians, distances):
    """See `linearised`."""
    for i in range(len(bearings)):
        distances[i] = _linearise_one(
            points, bases, bearings, world_T_rig, i, residuals[i], jacobians[i]
        )


@_kernel
def _normal_equations(
    points, bases, bearings, world_T_rig, scale, residuals, distances, information, gradient
):
    """J^T W J (6, 6) and J^T W r (6,) under Geman-McClure weights; residuals and distances."""
    jacobian = np.empty((2, 6))
    for k in range(6):
        gradient[k] = 0.0
        for m in range(6):
            information[k, m] = 0.0
    for i in range(len(bearings)):
        distances[i] = _linearise_one(
            points, bases, bearings, world_T_rig, i, residuals[i], jacobian
        )
        a, b = residuals[i, 0], residuals[i, 1]
        weight = (scale * scale / (scale * scale + a * a + b * b)) ** 2
        for k in range(6):
            gradient[k] += weight * (jacobian[0, k] * a + jacobian[1, k] * b)
            for m in range(k + 1):
                products = jacobian[0, k] * jacobian[0, m] + jacobian[1, k] * jacobian[1, m]
                information[k, m] += weight * products
    for k in range(6):
        for m in range(k):
            information[m, k] = information[k, m]
