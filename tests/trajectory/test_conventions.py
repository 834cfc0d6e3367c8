"""Trajectories in other conventions become ours by the words that refusals name."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from synthetic import ROS, loop_walk, w_first

from gsba.geometry import inverse
from gsba.trajectory.conventions import Convention, axis_systems
from gsba.types import Trajectory

WALK = Trajectory(np.arange(9.0), loop_walk(9))


@pytest.mark.parametrize(
    ("words", "read"),
    [
        (None, WALK.world_T_rigs),
        ("right-down-forward", WALK.world_T_rigs),
        ("wxyz", w_first(WALK.world_T_rigs)),
        ("camera-from-world", inverse(WALK.world_T_rigs)),
        ("forward-left-up", WALK.world_T_rigs @ ROS),
        ("wxyz, camera-from-world", w_first(inverse(WALK.world_T_rigs))),
        ("wxyz,forward-left-up", w_first(WALK.world_T_rigs @ ROS)),
    ],
)
def test_other_conventions_become_ours(words: str | None, read: np.ndarray) -> None:
    convention = Convention.parse(words)
    found = convention.in_our_axes(convention.poses(replace(WALK, world_T_rigs=read)))
    np.testing.assert_allclose(found.world_T_rigs, WALK.world_T_rigs, atol=1e-12)


@pytest.mark.parametrize("words", ["xyz", "forward-right-up", "up-up-left", "wxyz,wzyx"])
def test_words_that_are_no_convention_are_refused(words: str) -> None:
    refused("right-handed system, as right-down-forward", Convention.parse, words)


def test_there_are_24_systems_of_axes() -> None:
    systems = dict(axis_systems())
    assert len(systems) == 24
    assert len({tuple(rotation.ravel()) for rotation in systems.values()}) == 24
