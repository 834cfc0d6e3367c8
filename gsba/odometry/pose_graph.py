"""The pose graph of keyframes over Sim(3), as monocular poses drift in scale (Strasdat, Montiel and
Davison, RSS 2010): the rig's pose, and the length of its local unit in the world."""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from gsba.bundle.pose_variables import X
from gsba.geometry import adjoint, inverse, pose
from gsba.similarity import Sim3

_HELD = 1e-5  # standard deviation of the fixed first keyframe of a map, all parts of its tangent
_HELD_LOG_DISTANCE = 1e-5  # of the distance to the furthest keyframe, in the gauge of covariances
_FREE_LOG_SCALE = 1.0  # of the first keyframe's scale in that gauge
_POSE_ROTATION = 0.007  # standard deviations of each frame's own errors: radians, and units of the
_ERROR_RATE = 1e-9  # probability of rejecting a true loop, low because drift is partly systematic
# while covariances are of random errors


@dataclass(frozen=True, slots=True)
class Constraint:
    """Relative similarity of two keyframes, with its covariance."""

    first: int  # row of a keyframe
    second: int  # row of the other
    first_T_second: Sim3  # maps the second rig, with its unit, into the first
    covariance: np.ndarray  # (7, 7) float64, tangent [rotation, translation, log scale], on the
    # right, units of the second keyframe


@dataclass(frozen=True, slots=True)
class ClosedGraph:
    """Keyframes after loops were closed."""

    world_T_keys: np.ndarray  # (K, 4, 4) float64
    scales: np.ndarray  # (K,) float64, present length of a unit of each keyframe's odometry
    kept: np.ndarray  # (L,) bool, loops that the path can close


def close_loops(
    world_T_keys: np.ndarray, steps: Sequence[Constraint], loops: Sequence[Constraint]
) -> ClosedGraph:
    """Deform the path so that its loops close, without loops that contradict its steps.

    Loops are added one after another, those of the shortest time first: drift is least there. A
    loop is rejected if closing it costs more than the noise of the steps explains.

    Args:
        world_T_keys: (K, 4, 4) poses of one map; the first is fixed.
        steps: steps to all keyframes but the first.
    """
    from scipy.stats import chi2

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, world_T_key in enumerate(world_T_keys):
        values.insert(X(k), similarity3(Sim3.of(1.0, world_T_key)))
    held = gtsam.noiseModel.Isotropic.Sigma(7, _HELD)
    graph.add(gtsam.PriorFactorSimilarity3(X(0), values.atSimilarity3(X(0)), held))
    for one in steps:
        graph.add(factor_of(one))
    kept, cost, most = np.zeros(len(loops), bool), graph.error(values), chi2.isf(_ERROR_RATE, 7)
    for n in np.argsort([one.second - one.first for one in loops], kind="stable"):
        tried = gtsam.NonlinearFactorGraph(graph)
        tried.add(factor_of(loops[n]))
        bent = gtsam.LevenbergMarquardtOptimizer(tried, values).optimize()
        if 2 * (tried.error(bent) - cost) < most:
            graph, values, cost, kept[n] = tried, bent, tried.error(bent), True
    found = [values.atSimilarity3(X(k)) for k in range(len(world_T_keys))]
    scales = np.array([one.scale() for one in found])
    positions = scales[:, None] * np.array([one.translation() for one in found])
    rotations = np.array([one.rotation().matrix() for one in found])
    return ClosedGraph(pose(rotations, positions), scales, kept)


def factor_of(one: Constraint) -> gtsam.BetweenFactorSimilarity3:
    """GTSAM's factor of a constraint, on the keys X(first) and X(second)."""
    noise = gtsam.noiseModel.Gaussian.Covariance(one.covariance)
    between = similarity3(one.first_T_second)
    return gtsam.BetweenFactorSimilarity3(X(one.first), X(one.second), between, noise)


def similarity3(similarity: Sim3) -> gtsam.Similarity3:
    """GTSAM's similarity s (R x + t)."""
    rotation = gtsam.Rot3(similarity.rotation)
    return gtsam.Similarity3(rotation, similarity.translation / similarity.scale, similarity.scale)


def covariances_of(
    world_T_keys: np.ndarray, scales: np.ndarray, constraints: Sequence[Constraint]
) -> np.ndarray:
    """Marginal covariances (K, 6, 6) of poses, tangent [rotation, translation], map units.

    The gauge is that of refined maps: the first pose and its distance to the furthest are fixed.

    Args:
        world_T_keys: (K, 4, 4) poses of one map.
        scales: (K,) scales of the keyframes, see `ClosedGraph`.
        constraints: steps and loops that connect all keyframes.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, (world_T_key, scale) in enumerate(zip(world_T_keys, scales, strict=True)):
        values.insert(X(k), similarity3(Sim3.of(float(scale), world_T_key)))
    away = np.linalg.norm(world_T_keys[:, :3, 3] - world_T_keys[0, :3, 3], axis=1)
    far = int(np.argmax(away))
    moving = away[far] > 0
    sigmas = np.array([_HELD] * 6 + [_FREE_LOG_SCALE if moving else _HELD])
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    graph.add(gtsam.PriorFactorSimilarity3(X(0), values.atSimilarity3(X(0)), noise))
    if moving:
        graph.add(_fixed_distance(far, world_T_keys[[0, far]], float(scales[far])))
    for one in constraints:
        graph.add(factor_of(one))
    marginals = gtsam.Marginals(graph, values)
    found = np.empty((len(world_T_keys), 6, 6))
    for k, scale in enumerate(scales):
        units = np.array([1.0] * 3 + [scale] * 3)
        found[k] = marginals.marginalCovariance(X(k))[:6, :6] * np.outer(units, units)
    return found


def carried_covariances(
    covariances: np.ndarray, key_T_rigs: np.ndarray, distances: np.ndarray
) -> np.ndarray:
    """Covariances (F, 6, 6) of frames, from those of their keyframes.

    The keyframe's errors are increased by each pose's own: lenses have two centres, and rows are
    read one after another.

    Args:
        covariances: (F, 6, 6) those of each frame's keyframe, see `covariances_of`.
        key_T_rigs: (F, 4, 4) poses of frames in their keyframes, map units.
        distances: (F,) median distance of points, map units.
    """
    into_rigs = adjoint(inverse(key_T_rigs))
    own = np.zeros_like(into_rigs)
    turn, step = np.arange(3), np.arange(3, 6)
    own[:, turn, turn] = _POSE_ROTATION**2
    own[:, step, step] = np.square(0.005 * distances)[:, None]  # median distance
    return into_rigs @ covariances @ np.swapaxes(into_rigs, 1, 2) + own


def _fixed_distance(far: int, world_T_ends: np.ndarray, scale: float) -> gtsam.CustomFactor:
    """Fixes the logarithm of a keyframe's distance from the first one, which is fixed itself."""
    offset = world_T_ends[1, :3, 3] - world_T_ends[0, :3, 3]
    direction = offset / np.linalg.norm(offset)
    # A tangent moves the position by scale * rotation @ translation.
    gradient = scale * direction @ world_T_ends[1, :3, :3] / np.linalg.norm(offset)
    jacobian = np.concatenate([np.zeros(3), gradient, [0.0]])[None]

    def error(_factor: gtsam.CustomFactor, _values: gtsam.Values, jacobians) -> np.ndarray:
        if jacobians is not None:
            jacobians[0] = jacobian
        return np.zeros(1)

    noise = gtsam.noiseModel.Isotropic.Sigma(1, _HELD_LOG_DISTANCE)
    return gtsam.CustomFactor(noise, [X(far)], error)
