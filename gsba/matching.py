"""Descriptor matching guided by a predicted relative pose.

A point seen along `a` in frame 0 must lie, in frame 1, on the great circle through the rotated
`a` and the epipole, displaced away from the direction of motion. Candidates outside that band are
never compared: this is the speed, and the defence against repeated structure.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock
from typing import NamedTuple

import numba
import numpy as np

from gsba.config import MatchingSettings
from gsba.geometry import inverse
from gsba.log import track
from gsba.rig import RIG_R_FACE, owner_faces
from gsba.types import Features, Matches

_CELLS = 8  # cells along a face's side
_ZERO = np.float32(0)
_kernel = numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz", "arcp"})


@dataclass(frozen=True, slots=True)
class Gate:
    """How far a match may stray from a predicted relative pose."""

    rotation_rad: float  # uncertainty of the relative rotation, and of keypoints
    direction: float  # tangent of the uncertainty of the translation direction
    max_parallax_rad: float  # largest angle between both bearings in one orientation
    point_rad: float = 0.0  # uncertainty of the bearing of a point of known depth


@dataclass(frozen=True, slots=True)
class Searchable:
    """Features of a frame sorted into cells of the sphere."""

    bearings: np.ndarray  # (K, 3) float32, rig frame, sorted by cell
    descriptors: np.ndarray  # (K, D) float32, unit length
    keypoints: np.ndarray  # (K,) int32, index of the keypoint standing for each row
    starts: np.ndarray  # (C + 1,) int32, rows of each cell
    centres: np.ndarray  # (C, 3) float32, unit
    radii: np.ndarray  # (C,) float32, largest chord from a centre to a member


class _Limits(NamedTuple):
    """A gate and the thresholds on descriptors as the compiled search takes them."""

    rotation: np.float32  # radians
    direction: np.float32  # tangent
    chord: np.float32  # largest distance of both bearings on the unit sphere
    point: np.float32  # radians
    similarity: np.float32  # least
    ratio: np.float32  # largest


def searchable(features: Features) -> Searchable:
    """Sort features into cells; keypoints at one place (several orientations) become one."""
    bearings, faces = features.bearings_rig, owner_faces(features.bearings_rig)
    local = np.einsum("kji,kj->ki", RIG_R_FACE[faces], bearings)
    angles = np.arctan2(local[:, :2], local[:, 2:]) / (np.pi / 2) + 0.5
    cell_uv = np.clip((angles * _CELLS).astype(int), 0, _CELLS - 1)
    cells = (faces.astype(int) * _CELLS + cell_uv[:, 1]) * _CELLS + cell_uv[:, 0]
    order = np.argsort(cells, kind="stable")
    starts = np.searchsorted(cells[order], np.arange(6 * _CELLS * _CELLS + 1)).astype(np.int32)
    _, first, inverse = np.unique(
        np.column_stack([features.faces, features.pixels]),
        axis=0,
        return_index=True,
        return_inverse=True,
    )
    sums = np.zeros((len(starts) - 1, 3))
    np.add.at(sums, cells, bearings)
    centres = sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
    radii = np.zeros(len(centres))
    np.maximum.at(radii, cells, np.linalg.norm(bearings - centres[cells], axis=1))
    descriptors = features.descriptors[order].astype(np.float32)
    descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-12)
    return Searchable(
        bearings[order].astype(np.float32),
        descriptors,
        first[inverse.ravel()][order].astype(np.int32),
        starts,
        centres.astype(np.float32),
        radii.astype(np.float32),
    )


def match_pair(
    first: Searchable,
    second: Searchable,
    f0_T_f1: np.ndarray,
    gate: Gate,
    settings: MatchingSettings,
    points_f0: np.ndarray | None = None,
) -> np.ndarray:
    """Mutual, distinctive nearest neighbours within the gate.

    Args:
        first, second: features of both frames.
        f0_T_f1: (4, 4) predicted pose of frame 1 in frame 0; its translation's length is unused.
        gate: allowed deviation from the prediction.
        points_f0: (K, 3) scene points of frame 0's keypoints in its rig frame, NaN where unknown.
            Given, only keypoints with a point are matched, close to where it must appear.

    Returns:
        (m, 2) int32 keypoint indices in frame 0 and frame 1, sorted, unique.
    """
    rotation = f0_T_f1[:3, :3].astype(np.float32)
    translation = f0_T_f1[:3, 3]
    length = np.linalg.norm(translation)
    direction = (translation / max(length, 1e-12)).astype(np.float32)
    if points_f0 is None:
        targets = np.full((len(first.keypoints), 3), np.nan, np.float32)
    else:
        offsets = points_f0[first.keypoints] - translation
        targets = offsets / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-12)
    best, similarity = _search(
        first.bearings,
        targets.astype(np.float32),
        points_f0 is not None,
        first.descriptors,
        second.bearings @ rotation.T,
        second.descriptors,
        second.starts,
        second.centres @ rotation.T,
        second.radii,
        tuple(direction),
        _Limits(
            np.float32(gate.rotation_rad),
            np.float32(gate.direction if length > 1e-12 else 1e3),
            np.float32(2 * np.sin(min(gate.max_parallax_rad, np.pi) / 2)),
            np.float32(gate.point_rad),
            np.float32(settings.min_similarity),
            np.float32(settings.max_ratio),
        ),
    )
    rows = np.flatnonzero(best >= 0)
    pairs = np.column_stack([first.keypoints[rows], second.keypoints[best[rows]]])
    return _one_to_one(pairs, similarity[rows])


def _one_to_one(pairs: np.ndarray, similarity: np.ndarray) -> np.ndarray:
    """Keep the best match of every keypoint that took part under several orientations."""
    order = np.argsort(-similarity, kind="stable")
    pairs = pairs[order]
    for column in (0, 1):
        _, keep = np.unique(pairs[:, column], return_index=True)
        pairs = pairs[np.sort(keep)]
    return pairs[np.argsort(pairs[:, 0])].astype(np.int32)


@_kernel
def _search(
    bearings0,
    targets,
    only_targets,
    descriptors0,
    bearings1,
    descriptors1,
    starts,
    centres,
    radii,
    direction,
    limits,
):
    """Best row of frame 1 for every row of frame 0, or -1; all vectors in frame 0's axes."""
    n0, n1, dim = len(bearings0), len(bearings1), descriptors0.shape[1]
    best0, best1 = np.full(n0, -1, np.int32), np.full(n1, -1, np.int32)
    top0, next0 = np.full(n0, -1, np.float32), np.full(n0, -1, np.float32)
    top1, next1 = np.full(n1, -1, np.float32), np.full(n1, -1, np.float32)
    for i in range(n0):
        if only_targets and np.isnan(targets[i, 0]):
            continue
        bearing = bearings0[i, 0], bearings0[i, 1], bearings0[i, 2]
        target = targets[i, 0], targets[i, 1], targets[i, 2]
        normal, cosine, slack = _great_circle(bearing, direction, limits.rotation)
        for cell in range(len(radii)):
            if starts[cell] == starts[cell + 1]:
                continue
            ball = centres[cell, 0], centres[cell, 1], centres[cell, 2]
            radius = radii[cell]
            if only_targets and _distance(target, ball) > limits.point + radius:
                continue
            if not _in_band(ball, radius, bearing, normal, direction, cosine + slack, limits):
                continue
            for j in range(starts[cell], starts[cell + 1]):
                ball = bearings1[j, 0], bearings1[j, 1], bearings1[j, 2]
                if only_targets and _distance(target, ball) > limits.point:
                    continue
                if not _in_band(ball, _ZERO, bearing, normal, direction, cosine + slack, limits):
                    continue
                dot = _ZERO
                for d in range(dim):
                    dot += descriptors0[i, d] * descriptors1[j, d]
                if dot > next0[i]:  # asked here, as calls that pass arrays are dear
                    _offer(best0, top0, next0, i, j, dot, bearings1)
                if dot > next1[j]:
                    _offer(best1, top1, next1, j, i, dot, bearings0)
    for i in range(n0):
        j = best0[i]
        if j >= 0 and not (
            best1[j] == i and _distinctive(top0[i], max(next0[i], next1[j]), limits)
        ):
            best0[i] = -1
    return best0, top0


@_kernel
def _great_circle(bearing, direction, rotation_tolerance):
    """Normal of the plane of a bearing and the motion, cosine between them, and its slack."""
    (ax, ay, az), (tx, ty, tz) = bearing, direction
    nx, ny, nz = ty * az - tz * ay, tz * ax - tx * az, tx * ay - ty * ax
    sine = np.sqrt(nx * nx + ny * ny + nz * nz)
    if sine > 1e-6:
        nx, ny, nz = nx / sine, ny / sine, nz / sine
    slack = rotation_tolerance * (sine + rotation_tolerance)
    return (nx, ny, nz), tx * ax + ty * ay + tz * az, slack


@_kernel
def _in_band(ball, radius, bearing, normal, direction, max_cosine, limits):
    """Whether a bearing within `radius` of the centre of a ball can be of the same point.

    It lies on the great circle, no further than parallax goes, and is not displaced towards the
    direction of motion: that is where points behind both frames are seen.
    """
    chord = _distance(bearing, ball)
    if chord - radius > limits.chord + limits.rotation:
        return False
    band = limits.direction * (chord + radius)
    if abs(_dot(normal, ball)) - radius > limits.rotation + band:
        return False
    return _dot(direction, ball) - radius <= max_cosine + band


@_kernel
def _offer(best, top, second, row, candidate, similarity, bearings):
    """Note a candidate that beats a row's second best, which must lie elsewhere than the best."""
    elsewhere = best[row] < 0 or not _one_place(bearings, best[row], candidate)
    if similarity > top[row]:
        if elsewhere:
            second[row] = top[row]
        best[row], top[row] = candidate, similarity
    elif elsewhere:
        second[row] = similarity


@_kernel
def _distinctive(similarity, second, limits):
    """Ratio test on descriptor distances: half their squares are 1 - similarity."""
    ratio = limits.ratio * limits.ratio
    return similarity >= limits.similarity and 1 - similarity <= ratio * (1 - second)


@_kernel
def _one_place(bearings, a, b):
    """Whether two rows are one feature found twice: closer than 0.18 degrees."""
    x = bearings[a, 0] - bearings[b, 0]
    y = bearings[a, 1] - bearings[b, 1]
    z = bearings[a, 2] - bearings[b, 2]
    return x * x + y * y + z * z <= 1e-5


@_kernel
def _distance(a, b):
    return np.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@_kernel
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


class SearchableFrames:
    """Searchable features of frames, read when asked for; the latest used stay in memory."""

    def __init__(self, load: Callable[[int], Features], capacity: int = 48) -> None:
        self._get = lru_cache(capacity)(lambda frame: searchable(load(frame)))
        self._lock = Lock()

    def __getitem__(self, frame: int) -> Searchable:
        with self._lock:
            return self._get(int(frame))


def run(
    pairs: np.ndarray,
    world_T_rigs: np.ndarray,
    gates: Sequence[Gate],
    frames: SearchableFrames,
    settings: MatchingSettings,
    num_threads: int,
    points_rig: Sequence[np.ndarray] | None = None,
) -> Matches:
    """Match frame pairs.

    Args:
        pairs: (P, 2) frame indices.
        world_T_rigs: (F, 4, 4) poses that predict the pairs' geometry.
        gates: (P) how far to trust the prediction.
        frames: features.
        settings: similarity and distinctiveness.
        num_threads: pairs matched at a time.
        points_rig: (F) arrays (K_f, 3), see `match_pair`; frame 0 of a pair must be known.
    """
    f0_T_f1s = inverse(world_T_rigs[pairs[:, 0]]) @ world_T_rigs[pairs[:, 1]]

    def match(p: int) -> np.ndarray:
        f0, f1 = pairs[p]
        points = None if points_rig is None else points_rig[f0]
        return match_pair(frames[f0], frames[f1], f0_T_f1s[p], gates[p], settings, points)

    with ThreadPoolExecutor(num_threads) as pool:
        rows = list(track(pool.map(match, range(len(pairs))), "matching", len(pairs)))
    return Matches(
        np.asarray(pairs, np.int32).reshape(-1, 2),
        np.cumsum([0, *map(len, rows)]),
        np.concatenate([np.zeros((0, 2), np.int32), *rows]),
    )
