"""The last step of odometry, on all keyframes: maps joined, loops closed (both by the test of
`gsba.loop_closure.join_test`: a wrong one ruins a map), covariances."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsba.geometry import inverse
from gsba.loop_closure import map_merging
from gsba.odometry.loops import find_joins, find_loops
from gsba.odometry.places import KeyframePlaces, chosen_keyframes, described, make_places
from gsba.odometry.pose_graph import (
    Constraint,
    MeasuredSteps,
    close_loops,
    covariances_of,
    measure_steps,
)
from gsba.similarity import Sim3
from gsba.store.shards import Workers

logger = logging.getLogger(__name__)

_MIN_PLACES = 3  # least number of places of a map that is compared with others


@dataclass(frozen=True, slots=True)
class TrackedKeyframes:
    """Keyframes of a whole walk."""

    world_T_keys: np.ndarray  # (K, 4, 4) float64, each in the world of its map
    maps: np.ndarray  # (K,) int32
    solved: np.ndarray  # (K,) bool, keyframes of maps with points
    distances: np.ndarray  # (K,) float64, median distance of points, map units; positive
    features: Sequence[tuple[np.ndarray, np.ndarray]]  # (K) ids (N,) and bearings (N, 3), rig frame
    pictures: Sequence[np.ndarray]  # (K) JPEG panoramas, see `gsba.odometry.places.compressed`
    timestamps: np.ndarray  # (K,) float64, seconds
    width: int  # pixels across the panoramas
    usable: np.ndarray | None  # (h, 2h) bool, pixels of the scene; None = all


@dataclass(frozen=True, slots=True)
class ClosedKeyframes:
    """Keyframes after maps were joined and loops closed."""

    world_T_keys: np.ndarray  # (K, 4, 4) float64
    scales: np.ndarray  # (K,) float64, present length of one former unit beside each keyframe
    maps: np.ndarray  # (K,) int32; joined maps have the number of the first of them
    covariances: np.ndarray  # (K, 6, 6) float64, tangent [rotation rad, translation], map units,
    # the first pose of each map and its distance to the furthest held; NaN = not known
    loops: np.ndarray  # (L, 2) int64, keyframes of loops within a map
    joins: np.ndarray  # (M, 2) int64, keyframes at which two maps were joined

    @classmethod
    def unchanged(cls, tracked: TrackedKeyframes) -> "ClosedKeyframes":
        """Keyframes as they were tracked."""
        num, none = len(tracked.maps), np.zeros((0, 2), np.int64)
        poses, maps = tracked.world_T_keys.copy(), tracked.maps.copy()
        return cls(poses, np.ones(num), maps, np.full((num, 6, 6), np.nan), none, none)


def close(tracked: TrackedKeyframes, seed: int, workers: Workers) -> ClosedKeyframes:
    """Join the maps of a walk where they overlap, close loops, and estimate covariances."""
    found = ClosedKeyframes.unchanged(tracked)
    places = _places(tracked, seed, workers)
    if places is None:
        return found
    given = tracked.features, tracked.world_T_keys, tracked.maps, tracked.distances
    steps = measure_steps(*given)
    found = _joined(found, places, tracked)
    for number in np.unique(found.maps[tracked.solved]):
        keys = np.flatnonzero(tracked.solved & (found.maps == number))
        found = _closed(found, keys, places, steps)
    return found


def _places(tracked: TrackedKeyframes, seed: int, workers: Workers) -> KeyframePlaces | None:
    maps = np.where(tracked.solved, tracked.maps, -1)
    rows = chosen_keyframes(tracked.world_T_keys, maps, tracked.distances)
    if len(rows) < _MIN_PLACES:
        return None
    pictures = [tracked.pictures[row] for row in rows]
    features = described(pictures, tracked.width, tracked.usable)
    poses = tracked.world_T_keys[rows]
    return make_places(rows, tracked.maps[rows], poses, features, seed, workers)


def _joined(
    found: ClosedKeyframes, places: KeyframePlaces, tracked: TrackedKeyframes
) -> ClosedKeyframes:
    """Maps moved to where they overlap others; the first map of each group stays in place."""
    numbers, counts = np.unique(places.maps, return_counts=True)
    numbers = numbers[counts >= _MIN_PLACES]
    if len(numbers) < 2:
        return found
    rows = np.flatnonzero(np.isin(places.maps, numbers))
    some = places.taken(rows, places.solved.world_T_rigs[rows])
    parts = np.searchsorted(numbers, some.maps)
    seen = np.diff(parts) == 0
    times = tracked.timestamps[some.keyframes]
    registered = map_merging.merge(
        some.context, some.solved, parts, np.zeros(len(seen), bool), seen, times
    )
    poses, scales, maps = found.world_T_keys.copy(), found.scales.copy(), found.maps.copy()
    for component in np.unique(registered.components):
        together = np.unique(some.maps[registered.components == component])
        moves = [registered.move(int(np.flatnonzero(some.maps == m)[0])) for m in together]
        for number, move in zip(together, moves, strict=True):
            keys = tracked.maps == number
            poses[keys] = move.poses(tracked.world_T_keys[keys])
            scales[keys], maps[keys] = move.scale, together[0]
    for number, reason in enumerate(registered.reasons):
        if reason:
            rows = registered.components == number
            logger.info("map %d is joined to no other: %s", some.maps[rows][0] + 1, reason)
    return replace(found, world_T_keys=poses, scales=scales, maps=maps)


def _closed(
    found: ClosedKeyframes, keys: np.ndarray, places: KeyframePlaces, steps: MeasuredSteps
) -> ClosedKeyframes:
    """The map of some keyframes (N,) with its loops closed, and the covariances of its poses."""
    poses, scales = found.world_T_keys[keys], found.scales[keys]
    rows = np.flatnonzero(np.isin(places.keyframes, keys))
    if len(rows) < _MIN_PLACES:
        return found
    some = places.taken(rows, found.world_T_keys[places.keyframes[rows]])
    row_of = {int(k): row for row, k in enumerate(keys)}

    def of_keys(one: Constraint) -> Constraint:
        ends = (int(some.keyframes[end]) for end in (one.first, one.second))
        first, second = (row_of[k] for k in ends)
        return replace(one, first=first, second=second)

    joins = [of_keys(one) for one in find_joins(some)]
    loops = [of_keys(one) for one in find_loops(some, np.diff(some.maps) != 0)]
    path = [*_steps(keys, poses, scales, row_of, steps), *joins]
    since = np.ones(len(keys))  # changes of scale after joining
    if loops:
        closed = close_loops(poses, path, loops)
        if not closed.kept.all():
            left = np.count_nonzero(~closed.kept)
            logger.info("%d loops left out: the path cannot have drifted as far", left)
        loops = [one for one, kept in zip(loops, closed.kept, strict=True) if kept]
        poses, since = closed.world_T_keys, closed.scales
    covariances, scales = covariances_of(poses, since, [*path, *loops]), scales * since

    def with_values(before: np.ndarray, values: np.ndarray) -> np.ndarray:
        after = before.copy()
        after[keys] = values
        return after

    def with_ends(before: np.ndarray, new: list[Constraint]) -> np.ndarray:
        ends = [keys[[one.first, one.second]] for one in new]
        return np.concatenate([before, *(end[None] for end in ends)])

    return replace(
        found,
        world_T_keys=with_values(found.world_T_keys, poses),
        scales=with_values(found.scales, scales),
        covariances=with_values(found.covariances, covariances),
        loops=with_ends(found.loops, loops),
        joins=with_ends(found.joins, joins),
    )


def _steps(
    keys: np.ndarray,
    world_T_keys: np.ndarray,
    scales: np.ndarray,
    row_of: dict[int, int],
    steps: MeasuredSteps,
) -> list[Constraint]:
    """The steps of odometry within a map, in the units that its parts have after joining."""
    found = []
    for row, key in enumerate(keys.tolist()):
        if steps.parents[key] < 0:
            continue
        parent = row_of[int(steps.parents[key])]
        step = inverse(world_T_keys[parent]) @ world_T_keys[row]
        units = np.array([1.0] * 3 + [scales[row]] * 3 + [1.0])
        covariance = steps.covariances[key] * np.outer(units, units)
        found.append(Constraint(parent, row, Sim3.of(1.0, step), covariance))
    return found
