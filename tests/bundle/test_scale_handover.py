"""Scale that is carried from step to step: kept, changed, lost, and where a camera stands."""

from dataclasses import replace

import numpy as np
import pytest
from plain_records import map_of, observing
from synthetic import unit

from gsba.bundle.map_strength import neighbour_shifts, position_errors, scale_changes
from gsba.types import JointErrors, Reconstruction

SIGMA = 1e-3  # radians, of bearings
NUM = 14
DOOR = 7  # the step from frame 7 to 8


def _corridor(along: np.ndarray, reach: float = 4.0) -> Reconstruction:
    """Frames at places along x, points around them, and bearings of those within reach, by point
    and then frame."""
    rng = np.random.default_rng(0)
    num, frames = 2000, len(along)
    points = rng.uniform([-3, -2, -2], [along.max() + 3, 2, 2], (num, 3))
    points[:, 1:] += np.sign(points[:, 1:])
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = along
    offsets = points[:, None] - poses[None, :, :3, 3]
    seen = np.argwhere(np.linalg.norm(offsets, axis=2) < reach)
    rays = offsets[seen[:, 0], seen[:, 1]]
    rays = unit(rays) + SIGMA * rng.normal(size=rays.shape)
    return map_of(poses, points, *seen.T, unit(rays), SIGMA)


ONE = np.zeros(NUM, np.int64)  # recording of every frame


def test_a_right_map_carries_its_scale_over_every_step() -> None:
    changes = scale_changes(_corridor(np.arange(NUM) * 0.7), ONE)
    assert np.flatnonzero(np.isnan(changes)).tolist() == [0, NUM - 2]
    assert np.nanmax(changes) < 0.01


@pytest.mark.parametrize("factor", [1.1, 0.95])
def test_a_map_that_is_larger_behind_a_door_is_found_there(factor: float) -> None:
    whole = _corridor(np.arange(NUM) * 0.7)
    poses = whole.world_T_rigs.copy()
    door = poses[DOOR, 0, 3]
    poses[DOOR + 1 :, 0, 3] = door + factor * (poses[DOOR + 1 :, 0, 3] - door)
    changes = scale_changes(replace(whole, world_T_rigs=poses), ONE)
    assert np.nanargmax(changes) in (DOOR - 1, DOOR)
    assert changes[DOOR] == pytest.approx(abs(np.log(factor)), rel=0.3)


def test_where_nothing_is_seen_from_both_sides_any_scale_fits() -> None:
    whole = _corridor(np.arange(NUM) * 0.7)
    behind = whole.observation_frames > DOOR
    before = np.bincount(whole.observation_points[~behind], minlength=len(whole.points_world))
    changes = scale_changes(
        observing(whole, ~(behind & (before[whole.observation_points] > 0))), ONE
    )
    assert np.flatnonzero(np.isinf(changes)).tolist() == [DOOR - 1, DOOR, DOOR + 1]


def test_a_camera_that_stands_for_long_loses_no_scale() -> None:
    along = np.concatenate([np.arange(6) * 0.7, np.full(10, 3.5), 3.5 + np.arange(1, 7) * 0.7])
    changes = scale_changes(_corridor(along), np.zeros(len(along), np.int64))
    assert np.nanmax(changes) < 0.01


@pytest.mark.parametrize("ahead", [True, False])
def test_where_a_walk_starts_or_ends_standing_there_is_no_scale_to_lose(ahead: bool) -> None:
    shaken = 1e-3 * np.array([0.0, 1.0, -1.0, 1.0, -1.0])
    along = np.concatenate([shaken, np.arange(1, 10) * 0.7])
    along = along if ahead else along.max() - along[::-1]
    changes = scale_changes(_corridor(along), ONE)
    stands = np.arange(6) if ahead else NUM - 2 - np.arange(6)
    assert np.flatnonzero(np.isnan(changes)).tolist() == sorted([*stands[:5], NUM - 2 - stands[0]])
    assert np.nanmax(changes) < 0.01


def test_recordings_are_judged_each_by_itself() -> None:
    changes = scale_changes(_corridor(np.arange(NUM) * 0.7), (np.arange(NUM) > DOOR).astype(int))
    assert np.flatnonzero(np.isnan(changes)).tolist() == [0, 6, 7, 8, NUM - 2]


def test_errors_that_a_similarity_takes_up_move_no_position() -> None:
    poses = _corridor(np.arange(5.0)).world_T_rigs
    draws = np.zeros((3, 5, 6), np.float32)
    draws[0, :, 3] = 0.1 * poses[:, 0, 3]  # longer
    draws[1, :, 4] = 0.2  # moved
    draws[2, 2, 4] = 0.3  # one frame aside
    errors = position_errors(poses, draws)
    assert np.abs(errors[:2]).max() < 1e-6
    assert errors[2].argmax() == 2 and 0.1 < errors[2, 2] < 0.3
    draws[:, 1] = np.nan
    assert np.isnan(position_errors(poses, draws)[:, 1]).all()


def test_points_are_shifted_in_the_next_picture_by_errors_of_the_step_alone() -> None:
    whole = _corridor(np.arange(4.0))
    draws = np.zeros((50, 4, 6), np.float32)
    draws[:, :, 4] = 0.7  # all frames together
    neighbours = np.zeros((3, 6, 6))
    shifts = neighbour_shifts(replace(whole, joint_errors=JointErrors(neighbours, draws)))
    assert np.abs(shifts[:3]).max() < 1e-6 and np.isnan(shifts[3])
    draws[:, 2, 1] = 0.01  # radians that the third frame is turned about y
    shifts = neighbour_shifts(replace(whole, joint_errors=JointErrors(neighbours, draws)))
    assert shifts[0] < 1e-6
    assert 0.005 < shifts[1] < 0.01 and 0.005 < shifts[2] < 0.012
