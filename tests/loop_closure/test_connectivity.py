"""Points that hand the scale on from step to step, steps given up without them, and maps of frames
that images tie together."""

import numpy as np

from gsba.loop_closure import connectivity
from gsba.trajectory.steps import given_up
from gsba.types import Tracks


def test_points_of_three_frames_bridge_those_between() -> None:
    frames = np.array(
        [0, 1, 1, 2, 4, 3, 4, 5, 5]
    )  # of points seen twice, three times, thrice, once
    points = np.array([0, 0, 1, 1, 1, 2, 2, 2, 3])
    tracks = Tracks(points, frames, np.zeros(9, np.int32), 4)
    assert connectivity.bridging(tracks, 6).tolist() == [0, 0, 1, 1, 1, 0]
    nothing = Tracks(*np.zeros((3, 0), np.int32), 0)
    assert connectivity.bridging(nothing, 3).tolist() == [0, 0, 0]


def test_the_step_that_parts_most_is_given_up_then_that_of_fewer_matches() -> None:
    matches = np.array([50, 40, 30, 60])
    assert given_up({2}, matches) == {2}
    assert given_up({1, 2}, matches) == {1}
    assert given_up({1, 3}, matches) == {1, 2}
    assert given_up(set(), matches) == set()


def test_too_few_frames_are_no_map_of_images() -> None:
    tied = np.array([(0, 1), (1, 2), (3, 4), (5, 6), (6, 7), (7, 8)])
    assert connectivity.maps_of_images(tied, 10).tolist() == [1, 1, 1, -1, -1, 0, 0, 0, 0, -1]
    whole = np.column_stack([np.arange(3), np.arange(1, 4)])
    assert connectivity.maps_of_images(whole, 4).tolist() == [0, 0, 0, 0]
