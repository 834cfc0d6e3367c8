"""Maps of a tour whose stills are in no order.

The path of most likeness proposes steps, which three frames confirm as in a tour in order. Of many
frames in no order, chance confirms more: a step must also be confirmed without its own triangulated
points, and maps, any two of which may meet anywhere, are only joined where many places say so and
few deny it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np

from factors.threads import map_in_threads
from gsba.geometry import angles_between, inverse
from gsba.log import track
from gsba.odometry.tour_joins import (
    MIN_LEAD,
    NEAR,
    Join,
    Joining,
    Places,
    TourMap,
    alike,
    join,
    scaled,
)
from gsba.odometry.tour_maps import (
    STEPS_SEARCH,
    TourMatches,
    Triple,
    confirmed,
    maps_of,
    matches_of,
    triples_of,
)
from gsba.odometry.tour_order import in_given_order, likeness, most_alike_path
from gsba.odometry.tour_steps import MIN_PARALLAX_RAD, Step, TourFrame, hypotheses, read_frame
from gsba.types import FrameSet

JOINS_SEARCH = "joining maps"
_MIN_STEP_SCORE = 14.0  # of the places on both sides of a step, which do not hold it themselves
_MIN_END_SCORE = 6.0  # of a step beyond which there is one frame
_MIN_SCORE = 40.0  # of a join of any two maps: maps of different flats have up to 28
_MIN_SUPPORT = 0.5  # share of places, of those that confirm or deny a join
_MIN_LIKENESS = 1.2  # of frames at which maps may meet; 1 = that of any two frames
_NEARBY_RAD = np.deg2rad(5.0)  # of keys that tell which surface is seen beside a place
_MIN_NEARBY = 2
_IN_FRONT, _AT_DEPTH = 1.3, 1.15  # factors of depth: a key before a surface; on it


def match_unordered(
    run_frames: FrameSet, num_threads: int = 1
) -> tuple[np.ndarray, TourMatches] | None:
    """An order (F,) int64 of the stills of a tour, and confirmed steps and joins of the stills in
    this order; None if neighbours are alike as they are."""
    num = len(run_frames)
    frames = list(map_in_threads(lambda f: read_frame(run_frames, f), num, num_threads))
    like = likeness(frames, num_threads)
    if in_given_order(like):
        return None
    path = most_alike_path(like)
    frames, like = [frames[f] for f in path], like[np.ix_(path, path)]
    found = map_in_threads(lambda f: hypotheses(frames[f], frames[f + 1]), num - 1, num_threads)
    steps = list(track(found, STEPS_SEARCH, num - 1))

    def triples(f: int) -> dict[tuple[int, int], list[Triple]]:
        return triples_of(frames[f], frames[f + 1], frames[f + 2], steps[f], steps[f + 1])

    every = list(map_in_threads(triples, num - 2, num_threads))
    order, matches = ordered_matches(frames, like, steps, every, num_threads)
    return path[order], matches


def ordered_matches(
    frames: Sequence[TourFrame],
    like: np.ndarray,
    steps: Sequence[Sequence[Step]],
    triples: Sequence[dict[tuple[int, int], list[Triple]]],
    num_threads: int,
) -> tuple[np.ndarray, TourMatches]:
    """Order (F,) int64 of the frames of a path in which maps that are joined follow one another,
    and the matches in this order, by the hypotheses of steps along the path and their triples."""
    chain, sure = confirmed(steps, triples)
    sure = without_unsupported(frames, steps, chain, sure, num_threads)
    maps = maps_of(frames, steps, chain, sure)
    clusters = merged(sure_joins(frames, maps, like, num_threads), maps)
    order = np.array([f for some in clusters for f in some.ids], np.int64)
    places, map_of = (
        np.argsort(order),
        np.repeat(np.arange(len(maps)), [len(m.depths) for m in maps]),
    )
    shown = [frames[f] for f in order]
    inside = (np.diff(order) == 1) & (np.diff(map_of[order]) == 0)
    kept_steps = [steps[f] if known else [] for f, known in zip(order[:-1], inside, strict=True)]
    kept_chain = [chain[f] if known else 0 for f, known in zip(order[:-1], inside, strict=True)]
    kept = [sure[order[n]] if inside[n] and inside[n + 1] else None for n in range(len(order) - 2)]
    joined = [one.numbered(places) for some in clusters for one in some.joins]
    return order, matches_of(shown, kept_steps, kept_chain, kept, joined)


def without_unsupported(
    frames: Sequence[TourFrame],
    steps: Sequence[Sequence[Step]],
    chain: Sequence[int],
    triples: Sequence[Triple | None],
    num_threads: int,
) -> list[Triple | None]:
    """Triples (F - 2,) without those of steps that places do not confirm which frames on either
    side have triangulated without the step."""
    maps = [some for some in maps_of(frames, steps, chain, triples) if not some.single]
    cuts = [(some, f) for some in maps for f in range(some.first, some.last)]

    def supported(n: int) -> bool:
        some, f = cuts[n]
        ends = some.first == f or some.last == f + 1
        score = _score_without(frames, steps, chain, triples, some, f)
        return score >= (_MIN_END_SCORE if ends else _MIN_STEP_SCORE)

    left = list(triples)
    for (_, f), good in zip(cuts, map_in_threads(supported, len(cuts), num_threads), strict=True):
        if not good:
            left[max(f - 1, 0) : f + 1] = [None] * (min(f, 1) + (f < len(left)))
    return left


def _score_without(
    frames: Sequence[TourFrame],
    steps: Sequence[Sequence[Step]],
    chain: Sequence[int],
    triples: Sequence[Triple | None],
    whole: TourMap,
    f: int,
) -> float:
    """Score of the join of both parts of a map, its frames up to f and those after, that this map
    makes of it; without the pair of frames beside the step."""

    def part(first: int, last: int) -> TourMap:
        rows = slice(first, last)
        between = triples[first : max(last - 1, first)]
        some = maps_of(frames[first : last + 1], steps[rows], chain[rows], between)
        if len(some) > 1:  # a single step, which no triple holds by itself
            step = steps[first][chain[first]]
            poses = np.stack([np.eye(4), step.f1_T_f0])
            return TourMap(first, poses, [step.depths0, step.depths1])
        return replace(some[0], first=first)

    def length(g: int) -> float:
        return float(np.linalg.norm(whole.between(g, g + 1)[:3, 3]))

    one, other = part(whole.first, f), part(f + 1, whole.last)
    after = length(f + 1) if not other.single else 1.0
    before = length(whole.first) if not one.single else after
    after = before if other.single else after
    at = Join(scaled(whole.between(f, f + 1), 1 / before), float(np.log(after / before)), 0.0, [])
    pairs = list(
        product(
            range(max(f - NEAR + 1, whole.first), f + 1),
            range(f + 1, min(f + NEAR, whole.last) + 1),
        )
    )
    fitted = Joining(frames, one, other).fitted(
        at, [p for p in pairs if p != (f, f + 1)], 0.35, 0.8
    )
    return fitted.score if alike(at, fitted) else 0.0


@dataclass(frozen=True, slots=True)
class Meeting:
    """A join of two maps at any of their frames, in the numbers of all frames."""

    one: int  # map
    other: int
    f: int  # frame of the first map
    g: int
    at: Join  # g_T_f; of its places f and g are those of all frames


@dataclass(frozen=True, slots=True)
class OrderedJoin:
    """A join of the last frame of some frames and the first of others."""

    one: "Cluster"
    other: "Cluster"
    at: Join

    def numbered(self, places: np.ndarray) -> tuple[TourMap, TourMap, Join]:
        """Both maps and the join with frames numbered by their places (F,) in the order."""
        one, other = (
            TourMap(int(places[some.ids[0]]), some.f_T_firsts, some.depths)
            for some in (self.one, self.other)
        )
        found = [
            replace(some, f=int(places[some.f]), g=int(places[some.g])) for some in self.at.places
        ]
        return one, other, replace(self.at, places=found)


@dataclass(frozen=True, slots=True)
class Cluster:
    """Maps that were joined, in the units of one."""

    ids: list[int]  # frames
    f_T_firsts: np.ndarray  # (F, 4, 4)
    depths: list[np.ndarray]  # as `TourMap.depths`
    units: dict[int, float]  # of its maps, in units of the cluster
    joins: list[OrderedJoin]

    def between(self, f: int, g: int) -> np.ndarray:
        """Pose g_T_f (4, 4) of frames by their numbers."""
        return self.f_T_firsts[self.ids.index(g)] @ inverse(self.f_T_firsts[self.ids.index(f)])


def sure_joins(
    frames: Sequence[TourFrame], maps: Sequence[TourMap], like: np.ndarray, num_threads: int
) -> list[Meeting]:
    """Joins of maps, two frames and more each, at those two frames that are most alike (F, F)."""
    tried = list[tuple[int, int, int, int]]()
    for (i, one), (j, other) in combinations(enumerate(maps), 2):
        if one.single or other.single:
            continue
        some = like[one.first : one.last + 1, other.first : other.last + 1]
        f, g = np.unravel_index(some.argmax(), some.shape)
        if some[f, g] >= _MIN_LIKENESS:
            tried.append((i, j, one.first + int(f), other.first + int(g)))

    def search(n: int) -> Meeting | None:
        i, j, f, g = tried[n]
        return meeting(frames, maps, i, j, f, g)

    found = map_in_threads(search, len(tried), num_threads)
    return [one for one in track(found, JOINS_SEARCH, len(tried)) if one] if tried else []


def meeting(
    frames: Sequence[TourFrame], maps: Sequence[TourMap], i: int, j: int, f: int, g: int
) -> Meeting | None:
    """The join of two maps at a frame of each, with the frames next to these; None if it is not
    sure."""
    ids0, one = _by_distance(maps[i], f, 0)
    ids1, other = _by_distance(maps[j], g, len(ids0))
    ids = [*ids0, *ids1]
    some = [frames[k] for k in ids]
    best, rival = join(some, one, other)
    if best is None or best.score < max(_MIN_SCORE, MIN_LEAD * rival):
        return None
    if support(Joining(some, one, other), best) < _MIN_SUPPORT:
        return None
    places = [replace(one, f=ids[one.f], g=ids[one.g]) for one in best.places]
    return Meeting(i, j, f, g, replace(best, places=places))


def _by_distance(some: TourMap, f: int, first: int) -> tuple[list[int], TourMap]:
    """Frames of a map by their distance from one of them, and the map of these numbered from
    `first`; the second of two maps if that is above 0, the frame itself being next to the other."""
    ids = list(range(some.first, some.last + 1))
    positions = inverse(some.f_T_firsts)[:, :3, 3]
    away = np.linalg.norm(positions - positions[f - some.first], axis=1)
    ids = [ids[n] for n in np.argsort(away, kind="stable")[:: 1 if first else -1]]
    poses = np.stack([some.between(ids[0], k) for k in ids])
    return ids, TourMap(first, poses, [some.depths[k - some.first] for k in ids])


def support(joining: Joining, at: Join) -> float:
    """Share of a join's places, those of sound keys, that confirm it: others deny it if the key is
    on a surface that the other map has there, or before it, and is not found."""
    confirming, denying = 0, 0
    for some in at.places:
        first = some.f <= joining.one.last
        to = joining.other if first else joining.one
        g_T_f = joining.between(at, some.f, some.g)
        points = (some.rays * some.depths[:, None]) @ g_T_f[:3, :3].T + g_T_f[:3, 3]
        depths = np.linalg.norm(points, axis=1)
        depths_there = depths * np.exp(-at.log_scale if first else at.log_scale)
        rays = points / depths[:, None]
        near, far = _surface(joining.frames[some.g], to.depths[some.g - to.first], rays)
        seen = depths_there < near / _IN_FRONT
        seen |= (depths_there >= near / _AT_DEPTH) & (depths_there <= far * _AT_DEPTH)
        moved = angles_between(some.rays @ g_T_f[:3, :3].T, rays) > MIN_PARALLAX_RAD
        good = joining.confirms(at, some)
        confirming += np.count_nonzero(good & some.sound)
        denying += np.count_nonzero(seen & moved & ~good & some.sound)
    return confirming / max(confirming + denying, 1)


def _surface(
    frame: TourFrame, depths: np.ndarray, rays: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest depth (M,) of a frame's keys (N,) within 5 degrees of rays (M, 3); NaN =
    too few."""
    known = np.isfinite(depths)
    nearby = rays @ frame.keys[known].T > np.cos(_NEARBY_RAD)
    few = np.count_nonzero(nearby, axis=1) < _MIN_NEARBY
    near = np.where(nearby, depths[known], np.inf).min(axis=1, initial=np.inf)
    far = np.where(nearby, depths[known], 0.0).max(axis=1, initial=0.0)
    return np.where(few, np.nan, near), np.where(few, np.nan, far)


def merged(meetings: Sequence[Meeting], maps: Sequence[TourMap]) -> list[Cluster]:
    """Maps and clusters of those that are joined, the largest first. Where joins disagree around a
    loop, no map of the loop is joined."""
    left = list(meetings)
    while True:
        clusters = [
            Cluster(list(range(m.first, m.last + 1)), m.f_T_firsts, m.depths, {n: 1.0}, [])
            for n, m in enumerate(maps)
        ]
        refused: set[int] | None = None
        for one in sorted(left, key=lambda some: -some.at.score):
            a, b = (next(c for c in clusters if n in c.units) for n in (one.one, one.other))
            if a is b:
                if not _agrees(a, one):
                    refused = set(a.units)
                    break
                continue
            clusters = [c for c in clusters if c is not a and c is not b]
            clusters.append(_joined(a, b, one))
        if refused is None:
            return sorted(clusters, key=lambda some: (-len(some.ids), some.ids[0]))
        left = [one for one in left if one.one not in refused]


def _agrees(some: Cluster, one: Meeting) -> bool:
    """True if a join of two maps of a cluster is where the cluster has them."""
    unit0, unit1 = some.units[one.one], some.units[one.other]
    known = Join(scaled(some.between(one.f, one.g), 1 / unit0), np.log(unit1 / unit0), 0.0, [])
    return alike(known, one.at)


def _joined(a: Cluster, b: Cluster, one: Meeting) -> Cluster:
    """The cluster of two, in the units of the first."""
    unit0, unit1 = a.units[one.one], b.units[one.other]
    log_scale = one.at.log_scale + float(np.log(unit0 / unit1))
    scale = float(np.exp(log_scale))
    g_T_f = scaled(one.at.g_T_f, unit0)
    back = scaled(b.between(one.g, b.ids[0]), scale)
    first_T_last = back @ g_T_f @ a.between(a.ids[-1], one.f)
    start = first_T_last @ a.f_T_firsts[-1]
    poses = [*a.f_T_firsts, *(scaled(g_T_first, scale) @ start for g_T_first in b.f_T_firsts)]
    units = (a.units[one.one], b.units[one.other])
    at = Join(first_T_last, log_scale, one.at.score, _in_units(one.at.places, a.ids, units))
    return Cluster(
        [*a.ids, *b.ids],
        np.stack(poses),
        [*a.depths, *(some * scale for some in b.depths)],
        a.units | {n: size * scale for n, size in b.units.items()},
        [*a.joins, *b.joins, OrderedJoin(a, b, at)],
    )


def _in_units(
    places: Sequence[Places], ids: Sequence[int], units: tuple[float, float]
) -> list[Places]:
    """Places with the depths of the first map's frames (ids) and of the second's in the units of
    their clusters."""
    return [replace(some, depths=some.depths * units[0 if some.f in ids else 1]) for some in places]
