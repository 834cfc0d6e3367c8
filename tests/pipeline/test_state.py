"""Matches that the state of a run hands on."""

import numpy as np

from gsba.pipeline.state import MapMatches
from gsba.types import Matches


def _matches(*pairs: tuple[int, int]) -> Matches:
    rows = [np.zeros((1, 2), np.int32)] * len(pairs)
    return Matches.of_rows(np.array(pairs, np.int32).reshape(-1, 2), rows)


def test_sets_are_in_the_order_in_which_tracks_are_built() -> None:
    near, known, across, loops = (_matches((0, n)) for n in range(1, 5))
    assert MapMatches(near).sets() == [near]
    assert MapMatches(near, loops=loops, known_points=known).sets() == [near, known, loops]
    assert MapMatches(near, known, across, loops).sets() == [near, known, across, loops]


def test_matches_between_parts_are_dropped_where_parts_were_found_apart() -> None:
    parts, loops = np.array([0, 0, 1, 1]), _matches((0, 3))
    found = MapMatches(_matches((0, 1), (1, 2), (2, 3)), _matches((0, 2)), loops=loops)
    within = found.within(parts)
    assert within.neighbours.pairs.tolist() == [[0, 1], [2, 3]]
    assert within.known_points is not None and len(within.known_points.pairs) == 0
    assert within.across is None and within.loops is loops
    assert MapMatches(found.neighbours).within(parts).known_points is None
