"""Descriptor matching guided by a predicted relative pose.

A point seen along `a` in frame 0 must lie, in frame 1, on the great circle through the rotated
`a` and the epipole, displaced away from the direction of motion. Candidates outside that band are
never compared: this makes the search fast and guards against repeated structure.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from threading import Lock
from typing import Any, Protocol, TypeVar

import numpy as np

from factors.threads import Once
from gsba.camera.cameras import ONE_CAMERA, Cameras
from gsba.camera.lens import Lenses
from gsba.camera.rig import cells_of
from gsba.config import RefineSettings
from gsba.features.detection import ExtractorTraits, traits_of
from gsba.features.extraction import FrameFeatures
from gsba.geometry import inverse
from gsba.matching._search_kernels import HEAD, Cells, Limits, Rows, passes, search
from gsba.matching.pairs import by_place
from gsba.store.shards import Workers, blocks_of_frames
from gsba.types import Features, Keypoints, Matches
from gsba.types.records import slices

MAX_PARALLAX_RAD = np.deg2rad(60.0)  # between two rays of a point
T = TypeVar("T")
FAR_DRIFT = 0.05  # largest relative drift that a loop closure may correct
_CELLS_PER_SIDE = 8  # cells along a face's side


@dataclass(frozen=True, slots=True)
class Gate:
    """Largest deviation of a match from a predicted relative pose."""

    rotation_rad: float  # uncertainty of the relative rotation, and of keypoints
    direction: float  # tangent of the uncertainty of the translation direction
    max_parallax_rad: float  # largest angle between both bearings in one orientation
    point_rad: float = 0.0  # uncertainty of the bearing of a point of known depth
    lenses: Lenses = field(default_factory=Lenses)  # lenses of the frame whose known points are
    # searched

    @classmethod
    def anywhere(cls) -> "Gate":
        """A gate without any prediction: every match passes."""
        return cls(np.pi, 1e3, np.pi)

    @classmethod
    def around_points(cls, radius_rad: float) -> "Gate":
        """A gate around predicted points only."""
        return cls(np.pi, 1.0, np.pi, min(radius_rad, np.pi))

    @property
    def is_prediction(self) -> bool:
        """False if every rotation passes."""
        return self.rotation_rad < np.pi

    def chance(self, max_error_rad: float) -> float:
        """Probability that a false match within the gate lies within `max_error_rad` of the
        predicted epipolar plane; 0 = nothing is predicted."""
        if self.point_rad > 0:
            return min(4 * max_error_rad / (np.pi * self.point_rad), 1.0)  # area of a strip of a
            # disc
        return min(max_error_rad / self.rotation_rad, 1.0) if self.is_prediction else 0.0


# Assumed errors of a coarse trajectory's relative poses: 4 degrees, tangent of a direction's error.
PRIOR_GATE = Gate(np.deg2rad(4.0), 0.4, MAX_PARALLAX_RAD)


@dataclass(frozen=True, slots=True)
class Searchable:
    """Features of a frame, sorted into cells of the sphere."""

    bearings: np.ndarray  # (K, 3) float32, rig frame, sorted by cell
    descriptors: np.ndarray  # (K, D) float32, unit length, in the axes of a basis
    tails: np.ndarray  # (K,) float32, norm beyond the first HEAD axes
    keypoints: np.ndarray  # (K,) int32, index of the keypoint standing for each row
    starts: np.ndarray  # (C + 1,) int32, rows of each cell
    centres: np.ndarray  # (C, 3) float32, unit
    radii: np.ndarray  # (C,) float32, largest chord from a centre to a member


def principal_axes(descriptors: np.ndarray) -> np.ndarray:
    """Orthonormal axes (D, D) float32 as columns, in descending order of the descriptors'
    energy."""
    rows = descriptors.astype(np.float64)
    return np.linalg.eigh(rows.T @ rows)[1][:, ::-1].astype(np.float32)


def searchable(
    features: Features, axes: np.ndarray | None = None, strongest: int | None = None
) -> Searchable:
    """Sort features into cells, the strongest of each face or all; keypoints at one place (several
    orientations) become one. axes: (D, D) orthonormal columns, equal for all frames; similarities
    do not depend on them, but the search is fast if the first columns hold most of the descriptors'
    energy."""
    chosen = strongest_of(features, strongest)
    bearings = features.bearings_rig[chosen]
    cells = cells_of(bearings, _CELLS_PER_SIDE)
    order = np.argsort(cells, kind="stable")
    starts = np.searchsorted(
        cells[order], np.arange(6 * _CELLS_PER_SIDE * _CELLS_PER_SIDE + 1)
    ).astype(np.int32)
    places = features.pixels[chosen, 0] + 1j * features.pixels[chosen, 1]  # one number sorts fast
    places += 1e6 * features.faces[chosen]
    _, first, inverse = np.unique(places, return_index=True, return_inverse=True)
    sums = np.zeros((len(starts) - 1, 3))
    np.add.at(sums, cells, bearings)
    centres = sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
    radii = np.zeros(len(centres))
    np.maximum.at(radii, cells, np.linalg.norm(bearings - centres[cells], axis=1))
    descriptors = features.descriptors[chosen[order]].astype(np.float32)
    descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-12)
    if axes is not None:
        descriptors = descriptors @ axes
    return Searchable(
        bearings[order].astype(np.float32),
        descriptors,
        np.linalg.norm(descriptors[:, HEAD:], axis=1),
        chosen[first[inverse][order]].astype(np.int32),
        starts,
        centres.astype(np.float32),
        radii.astype(np.float32),
    )


def strongest_of(features: Features, per_face: int | None) -> np.ndarray:
    """Indices, ascending, of the strongest keypoints of each face; None = of all."""
    if per_face is None:
        return np.arange(len(features))
    ranks = np.arange(len(features)) - np.searchsorted(features.faces, features.faces)
    return np.flatnonzero(ranks < per_face)


def mutual_nearest(
    descriptors0: np.ndarray, descriptors1: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (M,) of some descriptors (K0, D) and of others (K1, D), each the most similar one of the
    other."""
    found, num = list[np.ndarray](), len(descriptors1)
    back, best = np.zeros(num, np.int64), np.full(num, -np.inf, np.float32)
    for rows in slices(len(descriptors0), 512):  # compared at once with all others
        likes = descriptors0[rows] @ descriptors1.T
        found.append(likes.argmax(axis=1))
        top = likes.argmax(axis=0)
        most = likes[top, np.arange(num)]
        back = np.where(most > best, rows.start + top, back)
        best = np.maximum(most, best)
    nearest = np.concatenate(found)
    rows0 = np.flatnonzero(back[nearest] == np.arange(len(nearest)))
    return rows0, nearest[rows0]


def match_pair(
    first: Searchable,
    second: Searchable,
    f0_T_f1: np.ndarray,
    gate: Gate,
    traits: ExtractorTraits,
    points_f0: np.ndarray | None = None,
) -> np.ndarray:
    """Mutual, distinctive nearest neighbours within the gate around f0_T_f1 (4, 4), whose
    translation's length is unused: (m, 2) int32 keypoint indices in either frame, sorted, unique.

    points_f0: (K, 3) scene points of frame 0's keypoints in its rig frame, NaN where unknown.
    Given, only keypoints with a point are matched, close to where it must appear.
    """
    rotation = f0_T_f1[:3, :3].astype(np.float32)
    direction, limits = _limits(f0_T_f1, gate, traits)
    best, similarity = search(
        Rows(first.bearings, first.descriptors, first.tails),
        Rows(second.bearings @ rotation.T, second.descriptors, second.tails),
        Cells(second.starts, second.centres @ rotation.T, second.radii),
        _targets(f0_T_f1, points_f0, first.keypoints, gate.lenses),
        points_f0 is not None,
        direction,
        limits,
    )
    rows = np.flatnonzero(best >= 0)
    pairs = np.column_stack([first.keypoints[rows], second.keypoints[best[rows]]])
    return one_to_one(pairs, similarity[rows])


def within_gate(
    pairs: np.ndarray,
    first: Features,
    second: Features,
    f0_T_f1: np.ndarray,
    gate: Gate,
    points_f0: np.ndarray | None = None,
) -> np.ndarray:
    """True (m,) for matches (m, 2) that `match_pair` would compare under the gate."""
    rotation = f0_T_f1[:3, :3].astype(np.float32)
    any_likeness = ExtractorTraits(min_similarity=-1, max_ratio=1)
    direction, limits = _limits(f0_T_f1, gate, any_likeness)
    return passes(
        first.bearings_rig[pairs[:, 0]].astype(np.float32),
        second.bearings_rig[pairs[:, 1]].astype(np.float32) @ rotation.T,
        _targets(f0_T_f1, points_f0, pairs[:, 0], gate.lenses),
        points_f0 is not None,
        direction,
        limits,
    )


def _limits(
    f0_T_f1: np.ndarray, gate: Gate, traits: ExtractorTraits
) -> tuple[tuple[np.float32, ...], Limits]:
    """Unit vector of the predicted motion, and a gate as the compiled search takes it."""
    length = np.linalg.norm(f0_T_f1[:3, 3])
    limits = Limits(
        np.float32(gate.rotation_rad),
        np.float32(gate.direction if length > 1e-12 else 1e3),
        np.float32(2 * np.sin(min(gate.max_parallax_rad, np.pi) / 2)),
        np.float32(gate.point_rad),
        np.float32(traits.min_similarity),
        np.float32(traits.max_ratio),
    )
    return tuple((f0_T_f1[:3, 3] / max(length, 1e-12)).astype(np.float32)), limits


def _targets(
    f0_T_f1: np.ndarray, points_f0: np.ndarray | None, keypoints: np.ndarray, lenses: Lenses
) -> np.ndarray:
    """Directions (n, 3) float32 from frame 1 of frame 0's points, in 0's axes; NaN = unknown."""
    if points_f0 is None:
        return np.full((len(keypoints), 3), np.nan, np.float32)
    offsets = points_f0[keypoints] - f0_T_f1[:3, 3]
    if lenses:
        rotation = f0_T_f1[:3, :3]
        seen = offsets @ rotation
        offsets = offsets - lenses.origins(seen, np.zeros(len(seen), int)) @ rotation.T
    lengths = np.linalg.norm(offsets, axis=1, keepdims=True)
    return (offsets / np.maximum(lengths, 1e-12)).astype(np.float32)


def one_to_one(pairs: np.ndarray, similarity: np.ndarray) -> np.ndarray:
    """Keep the best match of every keypoint that occurs under several orientations or faces."""
    pairs = pairs[np.argsort(-similarity, kind="stable")]
    pairs = pairs[np.sort(_first_of_each(pairs[:, 0]))]
    pairs = pairs[np.sort(_first_of_each(pairs[:, 1]))]
    return pairs[_first_of_each(pairs[:, 0])].astype(np.int32)


def _first_of_each(numbers: np.ndarray) -> np.ndarray:
    """First row of each number >= 0 that occurs, by ascending number."""
    rows = np.full(numbers.max(initial=-1) + 1, -1)
    rows[numbers[::-1]] = np.arange(len(numbers))[::-1]  # of several, the last one assigned stays
    return rows[rows >= 0]


class Points(Protocol):
    """Scene points of the keypoints of frames, see `match_pair`."""

    def __getitem__(self, frame: int, /) -> np.ndarray:
        """Points (K_f, 3) of one frame's keypoints in its rig frame, NaN where unknown."""
        ...


class Matcher(Protocol):
    """Finds corresponding keypoints of two frames whose relative pose is predicted.

    `guided` compares descriptors one by one; a learned matcher looks at all keypoints of two
    faces at once. Either way nothing outside the gate is returned.
    """

    def __call__(
        self,
        frames: "SearchableFrames",
        pair: tuple[int, int],
        f0_T_f1: np.ndarray,
        gate: Gate,
        traits: ExtractorTraits,
        points_f0: np.ndarray | None = None,
    ) -> np.ndarray:
        """Matches (m, 2) int32 of a pair of frames, sorted, one to one; see `match_pair`."""
        ...


class SearchableFrames:
    """Features of frames, prepared for matching, the strongest of a face or all; read on demand,
    the most recent ones, up to a capacity, are kept. For axes of descriptors see `searchable`; None
    = those of frame 0."""

    def __init__(
        self,
        load: Callable[[int], Features],
        strongest: int | None = None,
        capacity: int = 96,
        axes: np.ndarray | None = None,
    ) -> None:
        if axes is None:
            first = load(0).descriptors
            axes = principal_axes(first) if len(first) else np.eye(first.shape[1], dtype=np.float32)
        self._get = lru_cache(capacity)(
            lambda frame: Once(lambda: searchable(load(frame), axes, strongest))
        )
        self._features = lru_cache(max(capacity // 8, 2))(lambda frame: Once(lambda: load(frame)))
        self._load, self._axes, self._capacity = load, axes, capacity
        self._lock = Lock()
        self.strongest = strongest

    def __reduce__(self) -> tuple[type, tuple[object, ...]]:
        return SearchableFrames, (self._load, self.strongest, self._capacity, self._axes)

    def taken(self, frames: Iterable[int]) -> "SearchableFrames":
        """The features of some frames, with paths for other processes."""
        load = self._load
        if isinstance(load, FrameFeatures):
            load = load.taken(frames)
        return SearchableFrames(load, self.strongest, self._capacity, self._axes)

    def __getitem__(self, frame: int) -> Searchable:
        with self._lock:
            found = self._get(int(frame))
        return found()

    def features(self, frame: int) -> Features:
        """All features of a frame, as they were extracted."""
        with self._lock:
            found = self._features(int(frame))
        return found()


def guided(
    frames: SearchableFrames,
    pair: tuple[int, int],
    f0_T_f1: np.ndarray,
    gate: Gate,
    traits: ExtractorTraits,
    points_f0: np.ndarray | None = None,
) -> np.ndarray:
    """The Matcher that searches the gate for each descriptor's nearest: `match_pair`."""
    first, second = frames[pair[0]], frames[pair[1]]
    return match_pair(first, second, f0_T_f1, gate, traits, points_f0)


@dataclass(frozen=True, slots=True)
class MatchContext:
    """Features, settings and workers with which a run's frames are matched."""

    frames: SearchableFrames
    strongest: SearchableFrames  # with the strongest keypoints only
    keypoints: Keypoints  # of all frames
    settings: RefineSettings  # settings of pairs, matching and verification
    workers: Workers  # workers that match pairs
    matcher: Matcher = guided  # compares two frames
    cameras: Cameras = ONE_CAMERA  # cameras of the keypoints
    far_drift: float = FAR_DRIFT  # largest relative drift that a loop closure may correct

    def by_search(self) -> "MatchContext":
        """Guided search, whatever the run's matcher."""
        return replace(self, matcher=guided)

    def of_strongest(self) -> "MatchContext":
        """Guided search among the strongest keypoints, for pairs of which few show one place."""
        return replace(self.by_search(), frames=self.strongest)

    def match(
        self,
        pairs: np.ndarray,
        world_T_rigs: np.ndarray,
        gates: Sequence[Gate],
        points_rig: Points | None = None,
        *,
        strongest: bool = False,
        guided_only: bool = False,
    ) -> Matches:
        """Match frame pairs like `match`; `guided_only` replaces the matcher by guided search."""
        if self.cameras:
            gates = [
                replace(gate, lenses=self.cameras.at(int(f1)).of_frame(int(f1)))
                for gate, (_, f1) in zip(gates, pairs, strict=True)
            ]
        frames = self.strongest if strongest else self.frames
        how = traits_of(self.settings), self.workers
        matcher = guided if guided_only else self.matcher
        return match(pairs, world_T_rigs, gates, frames, *how, points_rig, matcher)


def match(
    pairs: np.ndarray,
    world_T_rigs: np.ndarray,
    gates: Sequence[Gate],
    frames: SearchableFrames,
    traits: ExtractorTraits,
    workers: Workers,
    points_rig: Points | None = None,
    matcher: Matcher = guided,
) -> Matches:
    """Match frame pairs.

    Args:
        pairs: (P, 2) frame indices.
        world_T_rigs: (F, 4, 4) poses that predict the pairs' geometry.
        gates: (P) uncertainty of each prediction.
        traits: of the descriptors, see `traits_of`.
        points_rig: points (K_f, 3) of each frame, see `match_pair`.
    """
    f0_T_f1s = inverse(world_T_rigs[pairs[:, 0]]) @ world_T_rigs[pairs[:, 1]]
    order, places = by_place(pairs, len(world_T_rigs))  # pairs that share frames follow one another
    chosen = [gates[p] for p in order]
    geometry = pairs[order], places, f0_T_f1s[order], chosen
    job = _PairJob(*geometry, frames, traits, points_rig, matcher)
    rows = [np.zeros((0, 2), np.int32)] * len(pairs)
    for p, matched in zip(order, workers.map_shards(job), strict=True):
        rows[p] = matched
    return Matches.of_rows(np.asarray(pairs, np.int32).reshape(-1, 2), rows)


@dataclass(frozen=True, slots=True)
class _PairJob:
    """The job of matching pairs, place by place."""

    pairs: np.ndarray  # (P, 2)
    places: np.ndarray  # (P,) number of the frame each is grouped with, see `by_place`
    f0_T_f1s: np.ndarray  # (P, 4, 4)
    gates: Sequence[Gate]  # (P)
    frames: SearchableFrames
    traits: ExtractorTraits
    points: Points | None  # points of first frames
    matcher: Matcher
    title: str = "matching"
    returns: Any = np.ndarray

    def __len__(self) -> int:
        return len(self.pairs)

    def __call__(self, p: int) -> np.ndarray:
        f0, f1 = (int(f) for f in self.pairs[p])
        points = None if self.points is None else self.points[f0]
        gate, f0_T_f1 = self.gates[p], self.f0_T_f1s[p]
        return self.matcher(self.frames, (f0, f1), f0_T_f1, gate, self.traits, points)

    def blocks(self) -> Sequence[tuple[int, int]]:
        return blocks_of_frames(self.places)

    def part(self, start: int, stop: int) -> "_PairJob":
        pairs, points = self.pairs[start:stop], self.points
        if points is not None:
            points = {int(f0): points[int(f0)] for f0 in np.unique(pairs[:, 0])}
        return replace(
            self,
            pairs=pairs,
            places=self.places[start:stop],
            f0_T_f1s=self.f0_T_f1s[start:stop],
            gates=list(self.gates[start:stop]),
            frames=self.frames.taken(np.unique(pairs).tolist()),
            points=points,
        )
