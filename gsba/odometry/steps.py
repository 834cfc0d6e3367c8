"""Steps from keyframe to keyframe: the parent of each keyframe, and covariances."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factors import tangent_basis
from gsba.bundle import triangulate
from gsba.config import TriangulateSettings
from gsba.odometry.resection import linearised
from gsba.odometry.window import WindowObservations

_REACH = 12  # keyframes before one among which its parent is searched
_CORRELATED = 13.0  # factor on the variance of independent features: those of a surface have
# correlated errors
_MODEL = 0.0003, 0.001, 0.002  # standard deviations of model errors (two lens centres, rolling
# shutter): rotation, translation in median distances, log scale
_SIGMA = np.deg2rad(0.15)  # radians per axis, of bearings
_GATE = 4.0  # largest residual of a feature, standard deviations
_UNKNOWN = np.deg2rad(2.0), 0.1, 0.05  # standard deviations of a step without common points:
# rotation, translation in median distances, log scale


@dataclass(frozen=True, slots=True)
class MeasuredSteps:
    """The step to each keyframe from its parent."""

    parents: np.ndarray  # (K,) int64, keyframe it was tracked from; -1 = the first of its map
    covariances: np.ndarray  # (K, 7, 7) float64, tangent [rotation, translation, log scale] on the
    # right, units of the keyframe


def measure_steps(
    features: Sequence[tuple[np.ndarray, np.ndarray]],
    world_T_keys: np.ndarray,
    maps: np.ndarray,
    distances: np.ndarray,
) -> MeasuredSteps:
    """Covariances of steps between keyframes, from common features; scale included.

    Rotation and translation: information of the directions to points that the parent observes too.
    Scale: a point propagates it as accurately as the triangulation angle between its first keyframe
    and this one permits.

    Args:
        features: ids (N,) and bearings (N, 3), rig frame, of each keyframe; maps share no id.
        world_T_keys: (K, 4, 4) poses, each in the world of its map.
        maps: (K,) map of each keyframe.
        distances: (K,) median distances of points, map units.
    """
    num = len(features)
    parents, covariances = np.full(num, -1), np.zeros((num, 7, 7))
    points, first_seen = _points(features, world_T_keys)
    for k in range(num):
        ids, bearings = features[k]
        before = [j for j in range(max(k - _REACH, 0), k) if maps[j] == maps[k]]
        if not before:
            continue
        counts = [np.isin(ids, features[j][0], assume_unique=True).sum() for j in before]
        parents[k] = before[len(before) - 1 - int(np.argmax(counts[::-1]))]
        shared = np.isin(ids, features[parents[k]][0], assume_unique=True)
        rows = np.flatnonzero(shared & np.isfinite(points[ids, 0]))
        origins = world_T_keys[first_seen[ids[rows]], :3, 3]
        given = points[ids[rows]], bearings[rows].astype(float), world_T_keys[k], origins
        covariances[k] = _covariance(*given, float(distances[k]))
    return MeasuredSteps(parents, covariances)


def _points(
    features: Sequence[tuple[np.ndarray, np.ndarray]], world_T_keys: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """By id, the point (3,) of each feature, NaN = unknown, and its first keyframe."""
    seen = WindowObservations.of(features)
    sigmas = np.full(len(seen.ids), _SIGMA)
    bearings, settings = seen.bearings_rig.astype(float), TriangulateSettings()
    found = triangulate(seen.tracks(), bearings, sigmas, world_T_keys, _GATE, settings)
    first_rows = np.unique(found.tracks.points, return_index=True)[1]
    known = seen.features_of(found)
    most = int(seen.ids.max(initial=-1)) + 1
    points, first_seen = np.full((most, 3), np.nan), np.zeros(most, np.int64)
    points[known] = found.points_world
    first_seen[known] = found.tracks.frames[first_rows]
    return points, first_seen


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
