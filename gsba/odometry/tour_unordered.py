"""Steps of a tour whose stills are in no order.

The path of most likeness proposes steps, which three frames confirm as in a tour in order. Among
frames in no order chance confirms more, so that places on both sides must confirm a step without
the points that it triangulates itself. Maps are not joined: any two might meet, and like pictures
in two rooms join them as clearly as a door does.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from factors.threads import map_in_threads
from gsba.odometry.tour_joins import NEAR, Join, Joining, TourMap, alike, scaled
from gsba.odometry.tour_maps import KeptSteps, TourMatches, Triple, maps_of, matches_of, searched
from gsba.odometry.tour_merging import all_joined
from gsba.odometry.tour_order import most_alike_path
from gsba.odometry.tour_steps import Step, TourFrame

_MIN_STEP_SCORE = 15.0  # of the places on both sides of a step, which do not hold it themselves
_MIN_END_SCORE = 8.0  # of a step beyond which there is one frame


def match_stills(
    frames: Sequence[TourFrame],
    given_names: tuple[str, ...],
    likeness: np.ndarray | None,
    num_threads: int,
    kept: KeptSteps,
) -> TourMatches:
    """Confirmed steps of a tour, in the order given; by their likeness (F, F), if that is known
    since names are in no order, in another one, unless no step is confirmed there."""
    if likeness is None:
        steps, sure = searched(frames, given_names, num_threads, kept)
        joined = all_joined(frames, maps_of(frames, steps, sure), num_threads)
        return matches_of(frames, given_names, steps, sure, joined)
    path = most_alike_path(likeness)
    given, frames = frames, [frames[f] for f in path]
    names = tuple(given_names[f] for f in path)
    steps, sure = searched(frames, names, num_threads, kept)
    sure = without_unsupported(frames, steps, sure, num_threads)
    if not any(sure):
        return matches_of(given, given_names, steps, sure, [])
    return replace(matches_of(frames, names, steps, sure, []), order_found=True)


def without_unsupported(
    frames: Sequence[TourFrame],
    steps: Sequence[Step | None],
    triples: Sequence[Triple | None],
    num_threads: int,
) -> list[Triple | None]:
    """Triples (F - 2,) without those of steps that places do not confirm which frames on either
    side have triangulated without the step."""
    maps = [some for some in maps_of(frames, steps, triples) if not some.single]
    cuts = [(some, f) for some in maps for f in range(some.first, some.last)]

    def supported(n: int) -> bool:
        some, f = cuts[n]
        ends = some.first == f or some.last == f + 1
        score = _score_without(frames, steps, triples, some, f)
        return score >= (_MIN_END_SCORE if ends else _MIN_STEP_SCORE)

    left = list(triples)
    for (_, f), good in zip(cuts, map_in_threads(supported, len(cuts), num_threads), strict=True):
        if not good:
            left[max(f - 1, 0) : f + 1] = [None] * (min(f, 1) + (f < len(left)))
    return left


def _score_without(
    frames: Sequence[TourFrame],
    steps: Sequence[Step | None],
    triples: Sequence[Triple | None],
    whole: TourMap,
    f: int,
) -> float:
    """Score of the join of both parts of a map, its frames up to f and those after, that this map
    makes of it; without the pair of frames beside the step."""

    def part(first: int, last: int) -> TourMap:
        own = steps[first:last]
        some = maps_of(frames[first : last + 1], own, triples[first : max(last - 1, first)])
        if len(some) > 1 and (step := own[0]):  # a single step, which no triple holds by itself
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
    near = range(max(f - NEAR + 1, whole.first), f + 1)
    beyond = range(f + 1, min(f + NEAR, whole.last) + 1)
    pairs = [pair for pair in product(near, beyond) if pair != (f, f + 1)]
    fitted = Joining(frames, one, other).fitted(at, pairs, 0.35, 0.8)
    return fitted.score if alike(at, fitted) else 0.0
