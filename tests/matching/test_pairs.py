"""Which frames are matched: neighbours in time, and places met again."""

import numpy as np
from synthetic import loop_walk

from gsba.config import PairSettings
from gsba.matching import pairs

SETTINGS = PairSettings(window=8, max_baseline_depths=1.0, max_loop_neighbours=3)


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
