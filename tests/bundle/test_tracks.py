"""Tracks: matches joined in order of trust, a frame at most once."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gsba.bundle import tracks
from gsba.types import Matches, Tracks


def _matches(*rows: tuple[int, int, int, int]) -> Matches:
    """One pair for every row (f0, k0, f1, k1)."""
    table = np.array(rows, np.int32).reshape(-1, 4)
    return Matches(table[:, [0, 2]], np.arange(len(table) + 1), table[:, [1, 3]])


def _as_sets(found: Tracks) -> set[frozenset[tuple[int, int]]]:
    groups: dict[int, set[tuple[int, int]]] = {}
    for point, frame, keypoint in zip(found.points, found.frames, found.keypoints, strict=True):
        groups.setdefault(int(point), set()).add((int(frame), int(keypoint)))
    return {frozenset(group) for group in groups.values()}


def _reference(rows: list[tuple[int, int, int, int]]) -> set[frozenset[tuple[int, int]]]:
    """Groups merged one match at a time unless a frame would come twice."""
    group: dict[tuple[int, int], frozenset[tuple[int, int]]] = {}
    for f0, k0, f1, k1 in rows:
        a = group.get((f0, k0), frozenset([(f0, k0)]))
        b = group.get((f1, k1), frozenset([(f1, k1)]))
        joined = a | b
        if a == b or len({frame for frame, _ in joined}) < len(a) + len(b):
            continue
        group.update(dict.fromkeys(joined, joined))
    return set(group.values())


def test_a_chain_becomes_one_track() -> None:
    found = tracks.build([_matches((0, 4, 1, 2), (1, 2, 2, 7), (3, 1, 2, 7))], np.full(4, 8))
    assert _as_sets(found) == {frozenset([(0, 4), (1, 2), (2, 7), (3, 1)])}
    assert found.num_points == 1


def test_the_more_trusted_match_wins_a_conflict() -> None:
    """Keypoints 1 and 2 of frame 0 both want keypoint 5 of frame 1: the earlier match has it."""
    first, second = (0, 1, 1, 5), (0, 2, 1, 5)
    size = np.full(2, 8)
    assert _as_sets(tracks.build([_matches(first, second)], size)) == {frozenset([(0, 1), (1, 5)])}
    assert _as_sets(tracks.build([_matches(second, first)], size)) == {frozenset([(0, 2), (1, 5)])}
    # And so across sets.
    found = tracks.build([_matches(second), _matches(first)], size)
    assert _as_sets(found) == {frozenset([(0, 2), (1, 5)])}


def test_a_conflict_through_a_third_frame_is_seen() -> None:
    rows = [(0, 0, 1, 0), (2, 0, 3, 0), (0, 1, 2, 0), (1, 0, 3, 0)]  # the last would join (0, 0)
    found = tracks.build([_matches(*rows)], np.full(4, 2))
    assert _as_sets(found) == {frozenset([(0, 0), (1, 0)]), frozenset([(0, 1), (2, 0), (3, 0)])}


def test_no_matches_make_no_tracks() -> None:
    for sets in ([], [_matches()]):
        found = tracks.build(sets, np.array([3, 0, 2]))
        assert (len(found), found.num_points) == (0, 0)


@st.composite
def _match_lists(draw: st.DrawFn) -> tuple[list[tuple[int, int, int, int]], np.ndarray]:
    sizes = draw(st.lists(st.integers(1, 4), min_size=2, max_size=6))
    frame = st.integers(0, len(sizes) - 1)
    rows = []
    for _ in range(draw(st.integers(0, 30))):
        f0, f1 = draw(frame), draw(frame)
        if f0 != f1:
            k0 = draw(st.integers(0, sizes[f0] - 1))
            rows.append((f0, k0, f1, draw(st.integers(0, sizes[f1] - 1))))
    return rows, np.array(sizes)


@settings(max_examples=200, deadline=None)
@given(_match_lists(), st.integers(0, 30))
def test_tracks_are_those_of_a_plain_reference(case: tuple, cut: int) -> None:
    rows, sizes = case
    found = tracks.build([_matches(*rows[:cut]), _matches(*rows[cut:])], sizes)
    assert _as_sets(found) == _reference(rows)
    key = found.points.astype(np.int64) * len(sizes) + found.frames
    assert (np.diff(key) > 0).all()  # by point, then frame; a frame once
    assert found.num_points == len(np.unique(found.points)) == len(_as_sets(found))
    assert (np.bincount(found.points) > 1).all()
