"""All maps of a tour, joined where places confirm it, in the order of the way."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from factors.threads import map_in_threads
from gsba.geometry import pose, unit
from gsba.log import track
from gsba.odometry.tour_joins import NEAR, Join, Joining, TourMap, alike, is_sure, join, scaled
from gsba.odometry.tour_steps import TourFrame, step_at

_MIN_HELD = 6  # places of a pair of frames that enter the map
_CLEAR_SCORE = 30.0  # of a join, below which others of the same maps are tried


def all_joined(
    frames: Sequence[TourFrame], maps: Sequence[TourMap], num_threads: int
) -> list[tuple[TourMap, TourMap, Join]]:
    """Joins of maps and single frames in the order of the way, with the maps before each; joined
    ones are joined further as one map. Where frames on both sides share little, as on either side
    of a doorway, a join further inside one of the maps is tried."""
    maps, made = list(maps), list[tuple[TourMap, TourMap, Join]]()
    known = dict[tuple[int, ...], tuple[Join | None, tuple[float, float]]]()

    def decide(pairs: Sequence[tuple[TourMap, TourMap]]) -> list[Join | None]:
        new = [pair for pair in pairs if _seen(*pair) not in known]

        def sure_join(n: int) -> Join | None:
            if new[n][0].single and new[n][1].single:
                return None
            best, rival = join(frames, *new[n])
            return best if is_sure(best, rival) else None

        found = map_in_threads(sure_join, len(new), num_threads)
        tried = track(found, "joining maps", len(new)) if new else found
        for pair, at in zip(new, tried, strict=True):
            known[_seen(*pair)] = at, _lengths_beside(*pair)
        return [_in_units_of(*pair, *known[_seen(*pair)]) for pair in pairs]

    while True:
        pairs = list(pairwise(maps))
        found = dict(enumerate(decide(pairs)))
        if not any(at and at.score >= _CLEAR_SCORE for at in found.values()):
            cuts = [other.first for _, other, _ in made]
            inside = [(n, part) for n, pair in enumerate(pairs) for part in _parts(*pair, cuts)]
            for (n, part), at in zip(inside, decide([part for _, part in inside]), strict=True):
                best = found[n]
                if at and (best is None or at.score > best.score):
                    carried = _carried(*pairs[n], *part, at)
                    if best and alike(best, carried):
                        carried = replace(carried, places=[*carried.places, *best.places])
                    found[n] = carried
        sure = [(at.score, n, at) for n, at in found.items() if at]
        if not sure:
            return made
        _, n, at = max(sure, key=lambda some: some[0])
        made.append((*pairs[n], at))
        maps[n : n + 2] = [_merged(frames, *made[-1])]


def held(
    frames: Sequence[TourFrame], one: TourMap, other: TourMap, at: Join
) -> list[tuple[tuple[int, int], np.ndarray, np.ndarray, np.ndarray]]:
    """Pairs of frames over a join, their poses f0_T_f1 (4, 4) of unit translation, and places
    (N, 3) in either frame of the other one's keys that fit it; NaN = none. Of the frames next to
    it, all places along epipolar lines if few have a known depth."""
    joining, found = Joining(frames, one, other), dict[tuple[int, int], np.ndarray]()
    for some in at.places:
        rows = joining.confirms(at, some)
        nothing = np.full((len(frames[some.f].keys), 3), np.nan)
        found.setdefault((some.f, some.g), nothing)[some.rows[rows]] = some.found[rows]
    ends = one.last, other.first
    pairs = list[tuple[tuple[int, int], np.ndarray, np.ndarray, np.ndarray]]()
    for f, g in sorted({ends, *((min(pair), max(pair)) for pair in found)}):
        found_g, found_f = (
            found.get(pair, np.full((len(frames[pair[0]].keys), 3), np.nan))
            for pair in ((f, g), (g, f))
        )
        f_T_g = joining.between(at, g, f)
        few = np.count_nonzero(np.isfinite(np.append(found_g[:, 0], found_f[:, 0]))) < _MIN_HELD
        if few and (f, g) != ends:
            continue
        if few:
            step = step_at(frames[f], frames[g], joining.between(at, f, g))
            found_g, found_f = step.places1, step.places0
        pairs.append(((f, g), pose(f_T_g[:3, :3], unit(f_T_g[:3, 3])), found_g, found_f))
    return pairs


def _seen(one: TourMap, other: TourMap) -> tuple[int, ...]:
    """Frames beside the step between two maps: the first, those next to it, the last."""
    first, last = max(one.first, one.last - NEAR + 1), min(other.last, other.first + NEAR - 1)
    return first, one.last, other.first, last


def _lengths_beside(one: TourMap, other: TourMap) -> tuple[float, float]:
    """Lengths of the steps before and after the one between two maps, in units of either; a single
    frame has those of the other map."""
    before, after = (
        1.0 if some.single else float(np.linalg.norm(some.between(f, f + 1)[:3, 3]))
        for some, f in ((one, one.last - 1), (other, other.first))
    )
    return after if one.single else before, before if other.single else after


def _in_units_of(
    one: TourMap, other: TourMap, at: Join | None, before: tuple[float, float]
) -> Join | None:
    """A join found where the steps beside it had lengths `before`, in the units of the maps, which
    change where a map before the first one is joined to it."""
    if at is None:
        return None
    by = [now / then for now, then in zip(_lengths_beside(one, other), before, strict=True)]
    places = [
        replace(some, depths=some.depths * by[int(some.f >= other.first)]) for some in at.places
    ]
    log_scale = at.log_scale + float(np.log(by[0]) - np.log(by[1]))
    return Join(scaled(at.g_T_f, by[0]), log_scale, at.score, places)


def _parts(one: TourMap, other: TourMap, cuts: Sequence[int]) -> list[tuple[TourMap, TourMap]]:
    """Both maps, one of them only as far as a frame at which it was joined itself."""
    before = max((cut for cut in cuts if one.first + 1 < cut <= one.last), default=None)
    after = min((cut for cut in cuts if other.first < cut < other.last), default=None)
    found = list[tuple[TourMap, TourMap]]()
    if before is not None:
        found.append((one.part(one.first, before - 1), other))
    if after is not None:
        found.append((one, other.part(after, other.last)))
    return [pair for pair in found if not (pair[0].single or pair[1].single)]


def _carried(one: TourMap, other: TourMap, part: TourMap, after: TourMap, at: Join) -> Join:
    """The join of two maps by that of parts of them."""
    back = scaled(other.between(after.first, other.first), float(np.exp(at.log_scale)))
    g_T_f = back @ at.g_T_f @ one.between(one.last, part.last)
    return replace(at, g_T_f=g_T_f)


def _merged(frames: Sequence[TourFrame], one: TourMap, other: TourMap, at: Join) -> TourMap:
    """The map of two, in the units of the first one."""
    scale = float(np.exp(at.log_scale))
    start = at.g_T_f @ one.f_T_firsts[-1]
    poses = [scaled(g_T_first, scale) @ start for g_T_first in other.f_T_firsts]
    depths = [*one.depths, *(some * scale for some in other.depths)]
    if one.single or other.single:
        length = np.linalg.norm(at.g_T_f[:3, 3])
        step = step_at(frames[one.last], frames[other.first], at.g_T_f)
        n = len(one.depths)
        if one.single:
            depths[n - 1] = step.depths0 * length
        if other.single:
            depths[n] = step.depths1 * length
    return TourMap(one.first, np.concatenate([one.f_T_firsts, poses]), depths)
