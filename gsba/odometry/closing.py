"""The last step of odometry, on all keyframes: maps joined, loops closed (both by the test of
`gsba.loop_closure.join_test`: a wrong one ruins a map), covariances."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsba.geometry import inverse
from gsba.loop_closure import join_evidence, loops, map_merging
from gsba.loop_closure.join_evidence import LOCAL, around
from gsba.loop_closure.join_evidence import Places as KnownPlaces
from gsba.loop_closure.join_test import JoinTest, Judged
from gsba.loop_closure.loops import Loop
from gsba.loop_closure.map_similarity import Meeting, Proposal, propose
from gsba.loop_closure.retrieval import global_descriptors
from gsba.matching import recovery
from gsba.odometry.places import KeyframePlaces, chosen_keyframes, described, make_places
from gsba.odometry.pose_graph import Constraint, close_loops, covariances_of, measure_steps
from gsba.similarity import Sim3
from gsba.store.shards import Workers

_MIN_POINTS = 6  # least number of points known at both places of a pair
_BESIDE = 4  # places from a meeting's ends that belong to it
_FITTED = 3  # places to either side of a meeting whose points measure the loop
_DIRECTION_SIGMA = np.deg2rad(0.25)  # noise of common points' bearings, as seen from a place
_CORRELATED = 4.0  # factor on the variance of independent points: those of one surface have
# correlated errors


def find_loops(places: KeyframePlaces, unseen: np.ndarray) -> list[Constraint]:
    """Loops among places of one map, in time order, proposed by appearance and confirmed by
    geometry and surroundings; unseen: (P - 1,) bool, steps between places without matches."""
    solved, context, num = places.solved, places.context, len(places.keyframes)
    looks = global_descriptors(context.strongest, num, context.settings.seed, context.workers)
    chosen = loops.candidates(looks, solved, unseen, context.settings, far_drift=context.far_drift)
    strongest = context.of_strongest()
    verified = recovery.match_anywhere(strongest, chosen, rivals=False)
    test = _join_test(places)
    none = np.zeros(0, np.int64)  # the later place of each pair moves to the earlier one
    meetings = test.meetings(verified.matches, none, verified.f0_T_f1s)
    meetings = [found for found in meetings if len(found.own) >= _MIN_POINTS]
    judged, rest = list[Judged](), sorted(meetings, key=lambda m: -len(m.own))
    while rest:  # pairs with their neighbours, around the pairs with the most points
        best = rest[0]
        near = [max(abs(m.f - best.f), abs(m.g - best.g)) <= _BESIDE for m in rest]
        group = [m for m, beside in zip(rest, near, strict=True) if beside]
        judged += _judged(group, places, unseen, test)
        rest = [m for m, beside in zip(rest, near, strict=True) if not beside]
    confirmed = [one for one in judged if one.evidence.confirmed]
    kept = [one for one in confirmed if not _rivals(one, confirmed, test)]
    for one in judged:
        logger.debug("a loop of places %s: %s", one.proposal.frames, one.evidence)
    sides = [_sides(*one.proposal.frames, num) for one in kept]
    measured = [_measured(one.proposal, *two, test) for one, two in zip(kept, sides, strict=True)]
    return [one for one in measured if one is not None]


def find_joins(places: KeyframePlaces) -> list[Constraint]:
    """Constraints between joined maps, each measured where they are closest; places have poses in
    one world."""
    positions, maps = places.solved.world_T_rigs[:, :3, 3], places.maps
    found, test = list[Constraint](), _join_test(places)
    inside = maps == maps[0]
    while not inside.all():
        rows, others = np.flatnonzero(~inside), np.flatnonzero(inside)
        distances = np.linalg.norm(positions[rows][:, None] - positions[others], axis=2)
        f, g = np.unravel_index(np.argmin(distances), distances.shape)
        proposal = Proposal(Sim3(), (int(rows[f]), int(others[g])), 0)
        part = np.flatnonzero(maps == maps[rows[f]])
        measured = _measured(proposal, part, others, test)
        if measured is None:
            # Frames that measure it are further off; the join itself is accepted all the same.
            end, start = others[g], rows[f]
            poses, wide = places.solved.world_T_rigs, 5.0 * _floor(test.depth)
            step = Sim3.of(1.0, inverse(poses[end]) @ poses[start])
            measured = Constraint(int(end), int(start), step, np.diag(np.square(wide)))
        found.append(measured)
        inside[part] = True
    return found


def _join_test(places: KeyframePlaces) -> JoinTest:
    solved, context = places.solved, places.context
    by_keypoint = solved.points_by_keypoint(context.keypoints)
    frames = np.arange(len(places.keyframes))
    known = [by_keypoint[int(f)] for f in frames]

    def rates(chosen: np.ndarray) -> join_evidence.FindingRates:
        beside = KnownPlaces(solved.world_T_rigs, known)
        return join_evidence.rates(context, beside, frames // (2 * LOCAL), chosen=chosen)

    poses, depth, one = solved.world_T_rigs, solved.median_depth(), np.zeros_like(frames)
    return JoinTest(context, poses, known, depth, one, rates)


def _judged(
    group: list[Meeting], places: KeyframePlaces, unseen: np.ndarray, test: JoinTest
) -> list[Judged]:
    """Each similarity proposed by a group of pairs, judged by its surroundings."""
    poses, seed = places.solved.world_T_rigs, places.context.settings.seed
    found = []
    for proposal in propose(group, poses, test.depth, seed)[:4]:
        if not _plausible(proposal, places, unseen, test.depth):
            continue
        one = test.judge(proposal, *_sides(*proposal.frames, len(poses)), found)
        if one and _plausible(one.proposal, places, unseen, test.depth):
            found.append(one)
    return found


def _plausible(
    proposal: Proposal, places: KeyframePlaces, unseen: np.ndarray, depth: float
) -> bool:
    """True if a loop needs no more drift than the path between its places can have."""
    if abs(np.log(proposal.move.scale)) > np.log(1.25):  # largest ratio, either way
        return False
    (f, g), poses = proposal.frames, places.solved.world_T_rigs
    g_T_f = inverse(poses[g]) @ proposal.move.poses(poses[f])
    loop = Loop(g, f, g_T_f, proposal.support)
    return loops.within_drift(loop, poses, depth, unseen, places.context.far_drift)


def _rivals(one: Judged, judged: list[Judged], test: JoinTest) -> list[Judged]:
    """Other loops of the same stretch that lead elsewhere and are no worse."""
    f, g = one.proposal.frames
    shared = [
        other
        for other in judged
        if min(abs(other.proposal.frames[0] - f), abs(other.proposal.frames[1] - g)) <= _BESIDE
    ]
    return test.rivals(one, shared)


def _measured(
    proposal: Proposal, rows: np.ndarray, inside: np.ndarray, test: JoinTest
) -> Constraint | None:
    """A proposal fitted to points of places next to the meeting; None if few of them fit it."""
    (f, g), poses, move = proposal.frames, test.poses, proposal.move
    rows, inside = around(rows, f, _FITTED), around(inside, g, _FITTED)
    found = test.meetings(test.weigh(rows, inside, move)[1], rows)
    start = Sim3.of(move.scale, inverse(poses[g]) @ move.poses(poses[f]))
    if sum(len(m.own) for m in found) < _MIN_POINTS:
        return None
    fitted = fit_loop(found, poses, (f, g), start)
    return None if fitted is None else Constraint(g, f, *fitted)


def _sides(f: int, g: int, num: int) -> tuple[np.ndarray, np.ndarray]:
    """Places after and before the middle between a later place f and an earlier one g."""
    middle = (f + g + 1) // 2
    return np.arange(middle, num), np.arange(middle)


def fit_loop(
    meetings: list[Meeting], poses: np.ndarray, at: tuple[int, int], start: Sim3
) -> tuple[Sim3, np.ndarray] | None:
    """The similarity g_T_f of the rigs of two places `at` = (f, g), near `start`, by directions and
    distances of common points, and its covariance (7, 7), see `Constraint`; None if few points fit
    it.

    Directions determine the pose; distances the scale, if the places are close to one another. The
    meetings are of places beside f with places beside g; poses (P, 4, 4) of all are consistent on
    either side.
    """
    from scipy.optimize import least_squares

    f, g = at
    beside_f = [inverse(poses[f]) @ poses[m.f] for m in meetings]  # poses of frames, rig f
    beside_g = [inverse(poses[g]) @ poses[m.g] for m in meetings]
    p, from_p = _in_rig([m.own for m in meetings], beside_f)
    q, from_q = _in_rig([m.theirs for m in meetings], beside_g)

    def residuals(x: np.ndarray) -> np.ndarray:
        fit = moved(start, x)
        there, back = fit.points(p) - from_q, fit.points_back(q) - from_p
        at_q, at_p = q - from_q, p - from_p
        lengths = [np.linalg.norm(v, axis=1, keepdims=True) for v in (there, at_q, back, at_p)]
        parts = [
            (there / lengths[0] - at_q / lengths[1]) / _DIRECTION_SIGMA,
            (back / lengths[2] - at_p / lengths[3]) / _DIRECTION_SIGMA,
            np.log(lengths[0] / lengths[1]) / 0.1,
        ]
        return np.concatenate([part.ravel() for part in parts])

    solved = least_squares(residuals, np.zeros(7), loss="soft_l1", x_scale="jac")
    left = residuals(solved.x)
    off = np.linalg.norm(left[: 6 * len(p)].reshape(2, len(p), 3), axis=2)
    if np.mean((off < 4.0).all(axis=0)) < 0.35:  # true loops have 0.4 to 0.6
        return None
    noise = max(float(np.median(np.abs(left))) / 0.6745, 0.5)
    information = solved.jac.T @ solved.jac
    covariance = _CORRELATED * noise**2 * np.linalg.inv(information)
    distance = float(np.median(np.linalg.norm(p, axis=1)))
    return moved(start, solved.x), covariance + np.diag(np.square(_floor(distance)))


def _floor(distance: float) -> np.ndarray:
    """Least standard deviations (7,) of a loop among points at a median distance."""
    # lenses have two centres, and each side has drifted
    return np.array([np.deg2rad(0.1)] * 3 + [0.003 * distance] * 3 + [0.01], float)


def moved(similarity: Sim3, tangent: np.ndarray) -> Sim3:
    """A similarity moved by a tangent (7,) [rotation, translation, log scale] on its right."""
    from scipy.spatial.transform import Rotation

    scale, rotation = similarity.scale, similarity.rotation
    return Sim3(
        scale * float(np.exp(tangent[6])),
        rotation @ Rotation.from_rotvec(tangent[:3]).as_matrix(),
        similarity.translation + scale * rotation @ tangent[3:6],
    )


def _in_rig(
    points: list[np.ndarray], rig_T_frames: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) of frames in one rig, and positions (N, 3) there of their frames."""
    there = [p @ T[:3, :3].T + T[:3, 3] for p, T in zip(points, rig_T_frames, strict=True)]
    seers = [np.tile(T[:3, 3], (len(p), 1)) for p, T in zip(points, rig_T_frames, strict=True)]
    return np.concatenate(there), np.concatenate(seers)


logger = logging.getLogger(__name__)

_MIN_PLACES = 3  # least number of places of a map that is compared with others


@dataclass(frozen=True, slots=True)
class TrackedKeyframes:
    """Keyframes of a whole walk."""

    world_T_keys: np.ndarray  # (K, 4, 4) float64, each in the world of its map
    maps: np.ndarray  # (K,) int32
    solved: np.ndarray  # (K,) bool, keyframes with features, of maps with points
    distances: np.ndarray  # (K,) float64, median distance of points, map units; positive
    features: Sequence[tuple[np.ndarray, np.ndarray]]  # (K) ids (N,) and bearings (N, 3), rig frame
    pictures: Sequence[np.ndarray]  # (K) JPEG panoramas, (n,) uint8 each
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


def close(tracked: TrackedKeyframes, seed: int, workers: Workers) -> ClosedKeyframes:
    """Join the maps of a walk where they overlap, close loops, and estimate covariances."""
    num, none = len(tracked.maps), np.zeros((0, 2), np.int64)
    poses, maps = tracked.world_T_keys.copy(), tracked.maps.copy()
    unknown = np.full((num, 6, 6), np.nan)
    found = ClosedKeyframes(poses, np.ones(num), maps, unknown, none, none)
    with_points = np.where(tracked.solved, tracked.maps, -1)
    rows = chosen_keyframes(tracked.world_T_keys, with_points, tracked.distances)
    if len(rows) < _MIN_PLACES:
        return found
    features = described([tracked.pictures[row] for row in rows], tracked.width, tracked.usable)
    at_places = tracked.world_T_keys[rows]
    places = make_places(rows, tracked.maps[rows], at_places, features, seed, workers)
    steps = measure_steps(tracked.features, tracked.world_T_keys, tracked.maps, tracked.distances)
    found = _joined(found, places, tracked)
    for number in np.unique(found.maps[tracked.solved]):
        keys = np.flatnonzero(tracked.solved & (found.maps == number))
        found = _closed(found, keys, places, steps)
    return found


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
    found: ClosedKeyframes,
    keys: np.ndarray,
    places: KeyframePlaces,
    steps: tuple[np.ndarray, np.ndarray],
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
    parents, covariances_of_steps = steps
    measured = []
    for k, key in enumerate(keys.tolist()):
        if parents[key] < 0:
            continue
        parent = row_of[int(parents[key])]
        step = inverse(poses[parent]) @ poses[k]
        units = np.array([1.0] * 3 + [scales[k]] * 3 + [1.0])
        covariance = covariances_of_steps[key] * np.outer(units, units)
        measured.append(Constraint(parent, k, Sim3.of(1.0, step), covariance))
    path = [*measured, *joins]
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
