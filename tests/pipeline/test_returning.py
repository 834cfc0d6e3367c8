"""Paths that come back, and paths that do not."""

import numpy as np
import pytest

from gsba.pipeline.frontend import comes_back


def _circle(share: float, num: int = 60) -> np.ndarray:
    """Positions on a share of a circle of radius 5."""
    angles = 2 * np.pi * share * np.linspace(0, 1, num)
    return 5 * np.column_stack([np.cos(angles), np.zeros(num), np.sin(angles)])


def _drifted(positions: np.ndarray) -> np.ndarray:
    """The path, longer by 4 % at its end."""
    return positions * np.linspace(1, 1.04, len(positions))[:, None] + [100, 0, 7]


@pytest.mark.parametrize("num", [24, 60, 3000])
def test_a_closed_walk_comes_back_though_it_drifts(num: int) -> None:
    assert comes_back(_drifted(_circle(1.0, num)))
    assert comes_back(_drifted(_circle(2.3, num)))


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_a_part_of_it_does_not(share: float) -> None:
    assert not comes_back(_drifted(_circle(share)))


def test_there_and_back_is_back() -> None:
    out = np.linspace([0, 0, 0], [9, 0, 0], 30)
    assert not comes_back(out)
    assert comes_back(np.concatenate([out, np.add(out[::-1], [0, 0.1, 0.3])]))


def test_a_turn_on_the_way_leaves_the_walk_open() -> None:
    """A small loop at its beginning does not hold what lies behind."""
    start = _circle(1.0) / 5
    assert not comes_back(np.concatenate([start, np.linspace(start[-1], [40, 0, 0], 80)]))


def test_a_camera_that_stands_still_is_where_it_was() -> None:
    assert comes_back(np.zeros((12, 3)))
