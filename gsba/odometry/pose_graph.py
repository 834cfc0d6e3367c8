"""The pose graph of keyframes over Sim(3), as monocular poses drift in scale (Strasdat, Montiel and
Davison, RSS 2010): the rig's pose, and the length of its local unit in the world."""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from factors import tangent_basis
from gsba.bundle import triangulate
from gsba.bundle.pose_variables import X
from gsba.geometry import adjoint, furthest, inverse, pose
from gsba.odometry.resection import linearised
from gsba.odometry.window import GATE, WindowObservations
from gsba.similarity import Sim3

_HELD = 1e-5  # standard deviation of the fixed first keyframe of a map, all parts of its tangent


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
    """Deform the path (K, 4, 4) of one map, its first pose fixed, so that its loops close, without
    loops that contradict its steps, which lead to all keyframes but the first.

    Loops are added one after another, those of the shortest time first: drift is least there. A
    loop is rejected if closing it costs more than the noise of the steps explains.
    """
    from scipy.stats import chi2

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, world_T_key in enumerate(world_T_keys):
        values.insert(X(k), similarity3(Sim3.of(1.0, world_T_key)))
    held = gtsam.noiseModel.Isotropic.Sigma(7, _HELD)
    graph.add(gtsam.PriorFactorSimilarity3(X(0), values.atSimilarity3(X(0)), held))
    for one in steps:
        graph.add(factor_of(one))
    # 1e-9: probability of rejecting a true loop, low because drift is partly systematic while
    # covariances are of random errors
    kept, cost, most = np.zeros(len(loops), bool), graph.error(values), chi2.isf(1e-9, 7)
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
    """Marginal covariances (K, 6, 6) of the poses of one map, tangent [rotation, translation], map
    units, by steps and loops that connect all keyframes; for scales see `ClosedGraph`.

    The gauge is that of refined maps: the first pose and its distance to the furthest are fixed.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, (world_T_key, scale) in enumerate(zip(world_T_keys, scales, strict=True)):
        values.insert(X(k), similarity3(Sim3.of(float(scale), world_T_key)))
    far, distance = furthest(world_T_keys[:, :3, 3])
    sigmas = np.array([_HELD] * 6 + [1.0 if distance > 0 else _HELD])
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    graph.add(gtsam.PriorFactorSimilarity3(X(0), values.atSimilarity3(X(0)), noise))
    if distance > 0:
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
    """Covariances (F, 6, 6) of frames at poses (F, 4, 4) in their keyframes, map units, from those
    of their keyframes, see `covariances_of`; distances: (F,) median, of points, map units.

    The keyframe's errors are increased by each pose's own: lenses have two centres, and rows are
    read one after another.
    """
    into_rigs = adjoint(inverse(key_T_rigs))
    own = np.zeros_like(into_rigs)
    turn, step = np.arange(3), np.arange(3, 6)
    own[:, turn, turn] = 0.007**2  # radians
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

    noise = gtsam.noiseModel.Isotropic.Sigma(1, 1e-5)
    return gtsam.CustomFactor(noise, [X(far)], error)


_REACH = 12  # keyframes before one among which its parent is searched
_CORRELATED = 13.0  # factor on the variance of independent features: those of a surface have
# correlated errors
_MODEL = 0.0003, 0.001, 0.002  # standard deviations of model errors (two lens centres, rolling
# shutter): rotation, translation in median distances, log scale
_SIGMA = np.deg2rad(0.15)  # radians per axis, of bearings
_UNKNOWN = np.deg2rad(2.0), 0.1, 0.05  # standard deviations of a step without common points:
# rotation, translation in median distances, log scale


def measure_steps(
    features: Sequence[tuple[np.ndarray, np.ndarray]],
    world_T_keys: np.ndarray,
    maps: np.ndarray,
    distances: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Keyframe (K,) int64 that each was tracked from, -1 = the first of its map that sees
    features, and covariances (K, 7, 7) of the steps between both, from common features, as of a
    `Constraint`.

    Rotation and translation: information of the directions to points that the parent observes too.
    Scale: a point propagates it as accurately as the triangulation angle between its first keyframe
    and this one permits.

    Args:
        features: ids (N,) and bearings (N, 3), rig frame, of each keyframe; maps share no id.
        world_T_keys, maps: (K, 4, 4) poses, each in the world of its map, and (K,) these maps.
        distances: (K,) median distances of points, map units.
    """
    num = len(features)
    parents, covariances = np.full(num, -1), np.zeros((num, 7, 7))
    seen = WindowObservations.of(features)
    sigmas = np.full(len(seen.ids), _SIGMA)
    rays = seen.bearings_rig.astype(float)
    found = triangulate(seen.tracks(), rays, sigmas, world_T_keys, GATE)
    first_rows = np.unique(found.tracks.points, return_index=True)[1]
    known = seen.features_of(found)
    most = int(seen.ids.max(initial=-1)) + 1
    points, first_seen = np.full((most, 3), np.nan), np.zeros(most, np.int64)
    points[known] = found.points_world
    first_seen[known] = found.tracks.frames[first_rows]
    for k in range(num):
        ids, bearings = features[k]
        before = [
            j for j in range(max(k - _REACH, 0), k) if maps[j] == maps[k] and len(features[j][0])
        ]
        if not before:
            continue
        counts = [np.isin(ids, features[j][0], assume_unique=True).sum() for j in before]
        parents[k] = before[len(before) - 1 - int(np.argmax(counts[::-1]))]
        shared = np.isin(ids, features[parents[k]][0], assume_unique=True)
        rows = np.flatnonzero(shared & np.isfinite(points[ids, 0]))
        origins = world_T_keys[first_seen[ids[rows]], :3, 3]
        given = points[ids[rows]], bearings[rows].astype(float), world_T_keys[k], origins
        covariances[k] = _covariance(*given, float(distances[k]))
    return parents, covariances


def _covariance(
    points: np.ndarray,
    bearings: np.ndarray,
    world_T_key: np.ndarray,
    origins: np.ndarray,
    distance: float,
) -> np.ndarray:
    """Covariance (7, 7) of a step to a keyframe; `origins` (N, 3): where points were seen first."""
    unknown, model = (
        np.diag(np.square([rotation] * 3 + [translation * distance] * 3 + [log_scale]))
        for rotation, translation, log_scale in (_UNKNOWN, _MODEL)
    )
    if len(points) < 8:  # least number of common features with points that measure a step
        return unknown
    _, jacobians, _ = linearised(points, tangent_basis(bearings), bearings, world_T_key)
    jacobian = jacobians.reshape(-1, 6)
    information = np.zeros((7, 7))
    information[:6, :6] = jacobian.T @ jacobian
    one, other = points - origins, points - world_T_key[:3, 3]
    sines = np.linalg.norm(np.cross(one, other), axis=1)
    sines /= np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
    information[6, 6] = 0.5 * float(np.sum(sines**2))
    information /= _CORRELATED * _SIGMA**2
    return np.linalg.inv(information + np.linalg.inv(unknown)) + model
