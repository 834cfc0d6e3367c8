"""A trajectory whose camera lies otherwise in its rig than raw pictures do."""

import numpy as np
import pytest
from synthetic import loop_walk

from gsba.geometry import inverse
from gsba.trajectory.conventions import QUARTER_TURNS, quarter_turn
from gsba.types import CoarsePoses, PoseSource


@pytest.mark.parametrize("turn", range(4))
def test_a_quarter_turn_about_the_way_ahead_is_found(turn: int) -> None:
    ours = loop_walk(24)
    ours_T_theirs = np.eye(4)
    ours_T_theirs[:3, :3] = QUARTER_TURNS[turn]
    sources = np.full(24, PoseSource.SLAM, np.uint8)
    world_T_first = inverse(ours[3])  # a world of its own
    theirs = CoarsePoses(world_T_first @ ours @ ours_T_theirs, sources, 0.0)
    np.testing.assert_array_equal(quarter_turn(theirs, ours), QUARTER_TURNS[turn])


def test_noise_makes_no_turn() -> None:
    ours, rng = loop_walk(24), np.random.default_rng(0)
    theirs = ours.copy()
    theirs[:, :3, 3] += rng.normal(0, 0.05, (24, 3))
    coarse = CoarsePoses(theirs, np.full(24, PoseSource.SLAM, np.uint8), 0.0)
    np.testing.assert_array_equal(quarter_turn(coarse, ours), np.eye(3))
