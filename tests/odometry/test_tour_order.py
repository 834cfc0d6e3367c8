"""The order of stills by their likeness."""

from itertools import pairwise, permutations

import numpy as np
import pytest

from gsba.config import FeatureSettings
from gsba.odometry import tour_order, tour_steps
from gsba.odometry.tour_order import in_given_order, likeness, most_alike_path
from gsba.odometry.tour_steps import frame_of
from tests.room_tour import picture


def alike_in_a_row(num: int, seed: int) -> np.ndarray:
    """Likeness (num, num) that falls with the distance of frames, and chance."""
    rng = np.random.default_rng(seed)
    away = np.abs(np.subtract.outer(np.arange(num), np.arange(num)))
    noise = rng.uniform(0, 0.3, (num, num))
    alike = np.exp(-away / 2.0) + noise + noise.T
    np.fill_diagonal(alike, 0)
    return alike


@pytest.mark.parametrize("seed", range(4))
def test_the_way_is_found_from_any_numbering(seed: int) -> None:
    alike = alike_in_a_row(14, seed)
    way = most_alike_path(alike)
    assert np.count_nonzero(np.abs(np.diff(way)) == 1) >= 9
    numbers = np.random.default_rng(seed + 9).permutation(14)
    again = numbers[most_alike_path(alike[np.ix_(numbers, numbers)])]
    assert again.tolist() in (way.tolist(), way[::-1].tolist())


def test_no_path_of_six_frames_is_more_alike() -> None:
    noise = np.random.default_rng(3).uniform(size=(6, 6))
    alike = noise + noise.T
    totals = [sum(alike[f, g] for f, g in pairwise(p)) for p in permutations(range(6))]
    way = most_alike_path(alike)
    assert sorted(way.tolist()) == list(range(6)) and way[0] < way[-1]
    assert alike[way[:-1], way[1:]].sum() == pytest.approx(max(totals))


def test_an_order_is_told_from_none() -> None:
    alike = alike_in_a_row(12, 0)
    numbers = np.random.default_rng(1).permutation(12)
    assert in_given_order(alike) and in_given_order(alike[::-1, ::-1])
    assert not in_given_order(alike[np.ix_(numbers, numbers)])
    few = numbers[numbers < tour_order.MIN_FRAMES - 1]
    assert not in_given_order(alike[np.ix_(few, few)])
    few.sort()
    assert in_given_order(alike[np.ix_(few, few)])


def test_frames_of_one_room_are_more_alike_than_of_two(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tour_steps, "_FEATURES", FeatureSettings(max_per_face=150))
    stills = [picture(n, room) for room in range(2) for n in (1, 2)]
    stills.append(np.full((512, 1024), 90, np.uint8))
    alike = likeness([frame_of(still, None) for still in stills])
    np.testing.assert_array_equal(alike, alike.T)
    assert not alike.diagonal().any()
    assert min(alike[0, 1], alike[2, 3]) > 2 * alike[:2, 2:4].max()
