"""Which frames are matched: neighbours in time, and places met again."""

from functools import lru_cache

import numpy as np
import pytest
from synthetic import loop_walk

from gsba.config import PairSettings
from gsba.matching import pairs

SETTINGS = PairSettings(window=8, max_loop_neighbours=3)


@pytest.fixture(autouse=True)
def _short_reach(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pairs, "MAX_BASELINE_DEPTHS", 1.0)


def _as_set(found: np.ndarray) -> set[tuple[int, int]]:
    return {(int(a), int(b)) for a, b in found}


def test_adjacent_frames() -> None:
    np.testing.assert_array_equal(
        pairs.adjacent(4), [[0, 1], [1, 2], [2, 3], [0, 2], [1, 3]]
    )  # the closest first
    np.testing.assert_array_equal(pairs.adjacent(3, reach=1), [[0, 1], [1, 2]])
    assert pairs.adjacent(1).shape == (0, 2)


def test_a_loop_closes_where_it_comes_near() -> None:
    positions = loop_walk(24)[:, :3, 3]  # steps of 1.05
    window, loops = pairs.covisible(positions, 3.0, SETTINGS)
    found = _as_set(loops)
    assert {(0, 23), (0, 22), (1, 23)} <= found
    for a, b in found:
        assert b - a > SETTINGS.window
        assert np.linalg.norm(positions[a] - positions[b]) < 3.0
    assert len(found) == len(loops)
    distances = np.linalg.norm(positions[loops[:, 0]] - positions[loops[:, 1]], axis=1)
    assert (np.diff(distances) >= 0).all()  # the most trusted first
    gaps = window[:, 1] - window[:, 0]
    assert gaps.min() == 1 and gaps.max() <= SETTINGS.window
    assert (np.diff(gaps) >= 0).all()


def test_a_straight_path_closes_no_loop() -> None:
    positions = np.arange(30)[:, None] * [0.0, 0.0, 0.2]
    _, loops = pairs.covisible(positions, 1.0, SETTINGS)  # reach: 5 frames
    assert loops.shape == (0, 2)


def test_frames_far_apart_are_not_paired_but_neighbours_always_are() -> None:
    positions = np.arange(10)[:, None] * [0.0, 0.0, 5.0]
    window, _ = pairs.covisible(positions, 1.0, SETTINGS)
    assert _as_set(window) == {(f, f + gap) for gap in (1, 2) for f in range(10 - gap)}


def test_a_standing_camera_is_paired_with_few() -> None:
    _, loops = pairs.covisible(np.zeros((60, 3)), 1.0, SETTINGS)
    per_frame = np.bincount(loops.ravel(), minlength=60)
    assert len(loops) <= 60 * SETTINGS.max_loop_neighbours and (per_frame > 0).all()


def test_without_points_nothing_is_near() -> None:
    _, loops = pairs.covisible(loop_walk(24)[:, :3, 3], 0.0, SETTINGS)
    assert loops.shape == (0, 2)


def test_loops_can_be_switched_off() -> None:
    settings = SETTINGS.model_copy(update={"max_loop_neighbours": 0})
    assert len(pairs.covisible(loop_walk(24)[:, :3, 3], 3.0, settings)[1]) == 0


def _laps(num: int, length: int = 40, radius: float = 8.0) -> np.ndarray:
    """Positions (F, 3) of a walk in circles, each a little off the others."""
    frames = np.arange(num * length)
    angles = 2 * np.pi * frames / length
    off = np.random.default_rng(1).normal(scale=0.05, size=(len(frames), 3))
    return radius * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles]) + off


def test_each_visit_is_closed_with_those_beside_it() -> None:
    """However many laps: the others follow from these, and drift is least between these."""
    positions = _laps(6)
    closing = pairs.closing(positions, 4.0, SETTINGS)
    gaps = closing[:, 1] - closing[:, 0]
    assert gaps.min() > SETTINGS.window and gaps.max() <= 40 + SETTINGS.window
    crossed = {tuple(pair) for pair in (closing // 40).tolist()}
    assert {(lap, lap + 1) for lap in range(5)} <= crossed  # every lap is tied to the next
    distances = np.linalg.norm(positions[closing[:, 0]] - positions[closing[:, 1]], axis=1)
    assert (np.diff(distances) >= 0).all()
    everything = pairs.covisible(positions, 4.0, SETTINGS)[1]
    assert (everything[:, 1] - everything[:, 0]).max() > 100


def test_a_place_met_again_once_is_closed_with_all_that_is_near() -> None:
    positions = loop_walk(24)[:, :3, 3]
    every = pairs.covisible(positions, 3.0, SETTINGS)[1]
    np.testing.assert_array_equal(pairs.closing(positions, 3.0, SETTINGS), every)


def test_what_was_only_met_from_afar_hides_no_former_visit() -> None:
    """An aisle beside this one, passed since, is no reason to leave out the last time here."""
    along = np.arange(20)[:, None] * [1.0, 0.0, 0.0]
    beside, away = (along + np.array([0.0, off, 0.0]) for off in (3.5, 100.0))
    positions = np.concatenate([along, away, beside, away, along])
    closing = _as_set(pairs.closing(positions, 4.0, SETTINGS))
    assert {(f, f + 80) for f in range(20)} <= closing


def test_frames_are_wanted_for_a_short_while() -> None:
    """Walking in circles wants each frame once; one lap after the other, once in each lap."""
    positions = _laps(8)
    window, loops = pairs.covisible(positions, 4.0, SETTINGS)
    chosen = np.concatenate([window, loops])
    order, places = pairs.by_place(chosen, len(positions))
    np.testing.assert_array_equal(np.sort(order), np.arange(len(chosen)))
    assert (np.diff(places) >= 0).all()
    close = chosen[order, 1] - chosen[order, 0] <= 32
    np.testing.assert_array_equal(places[close], chosen[order[close], 0])
    assert (places[~close] >= len(positions)).all()
    by_time = np.lexsort((loops[:, 1], loops[:, 0]))
    met = pairs.by_place(loops, len(positions))[0]
    assert _reads(loops[met], 64) < 1.2 * len(positions) < _reads(loops[by_time], 64) / 2


def _reads(chosen: np.ndarray, kept: int) -> int:
    """How often frames are read that take part in pairs (P, 2), if so many are kept."""
    read = lru_cache(kept)(lambda frame: frame)
    for frame in chosen.ravel().tolist():
        read(frame)
    return read.cache_info().misses


def test_no_pairs_have_an_order() -> None:
    order, places = pairs.by_place(np.zeros((0, 2), np.int32), 3)
    assert len(order) == len(places) == 0


def test_each_frame_keeps_its_first_pairs_where_nothing_is_predicted() -> None:
    chosen = np.array([[f, g] for f in range(5) for g in range(10, 16)])
    chosen = chosen[np.argsort(chosen.sum(axis=1), kind="stable")]
    unpredicted = chosen[:, 1] > 11
    kept = pairs.thinned(chosen, unpredicted, 2)
    assert kept[~unpredicted].all()
    left = chosen[kept & unpredicted]
    assert len(left) < np.count_nonzero(unpredicted)
    assert all(np.count_nonzero(left == f) >= 2 for f in (*range(5), *range(12, 16)))
    np.testing.assert_array_equal(pairs.thinned(chosen, unpredicted, 6), np.ones(len(chosen), bool))
