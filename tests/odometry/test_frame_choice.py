"""Frames chosen by what they show: how far apart, how sharp, how many."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsba.config import OdometrySettings
from gsba.geometry import pose, rotation_angle
from gsba.odometry import Odometry, choose_frames
from gsba.odometry.tracker_state import FrameStatus
from gsba.odometry.walk import MAX_TURN_DEG, write_chosen
from gsba.trajectory.files import read_trajectory

SETTINGS = OdometrySettings()


def _odometry(
    positions: np.ndarray,
    angles: np.ndarray | None = None,
    distances: np.ndarray | float = 1.0,
    statuses: np.ndarray | None = None,
    maps: np.ndarray | None = None,
    sharpness: np.ndarray | None = None,
) -> Odometry:
    num = len(positions)
    turns = np.zeros(num) if angles is None else angles
    rotations = Rotation.from_rotvec(turns[:, None] * np.array([[0.0, 1.0, 0.0]])).as_matrix()
    return Odometry(
        np.arange(num) / 30,
        pose(rotations, positions),
        np.zeros(num, np.uint8) if statuses is None else statuses,
        np.zeros(num, np.int32) if maps is None else maps,
        np.zeros(num, bool),
        np.broadcast_to(distances, num).astype(float),
        np.full(num, 100),
        np.ones(num) if sharpness is None else sharpness,
        1.0,
    )


def _line(num: int, step: float) -> np.ndarray:
    return step * np.arange(num)[:, None] * np.array([[1.0, 0.0, 0.0]])


def test_steps_are_at_most_the_asked_part_of_the_distance_of_things() -> None:
    distances = np.linspace(1.0, 3.0, 300)
    found = _odometry(_line(300, 0.02), distances=distances)
    rows = choose_frames(found, SETTINGS)
    steps = np.diff(found.world_T_rigs[rows, 0, 3])
    assert (steps <= SETTINGS.step * np.minimum(distances[rows[1:]], distances[rows[:-1]])).all()
    assert (steps > 0.5 * SETTINGS.step * distances[rows[:-1]]).all()  # and none are wasted
    assert steps[-1] > 2 * steps[0]


def test_the_sharpest_frame_of_a_stretch_is_taken() -> None:
    sharp = np.ones(200)
    sharp[3::4] = 2.0  # one in every stretch between .6 and 1 of a step
    rows = choose_frames(_odometry(_line(200, 0.02), sharpness=sharp), SETTINGS)
    assert np.mean(sharp[rows[1:]] == 2.0) > 0.9


def test_turning_counts_and_swaying_does_not() -> None:
    still = np.zeros((400, 3))
    turning = _odometry(still, np.deg2rad(np.arange(400.0)))
    rows = choose_frames(turning, SETTINGS)
    rotations = turning.world_T_rigs[rows, :3, :3]
    turns = rotation_angle(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:])
    assert np.rad2deg(turns).max() <= MAX_TURN_DEG + 1e-6
    assert len(rows) >= 400 / MAX_TURN_DEG
    swaying = _odometry(still, np.deg2rad(10 * np.sin(np.arange(400.0))))
    assert choose_frames(swaying, SETTINGS).tolist() == [0]


def test_a_step_longer_than_allowed_takes_the_frames_on_either_side() -> None:
    positions = _line(40, 0.02)
    positions[20:] += 5.0
    assert {19, 20} <= set(choose_frames(_odometry(positions), SETTINGS).tolist())


@pytest.mark.parametrize("most", [3, 10, 30])
def test_no_more_frames_are_chosen_than_asked(most: int) -> None:
    found = _odometry(_line(900, 0.02))
    settings = OdometrySettings(max_frames=most)
    rows = choose_frames(found, settings)
    assert 0.8 * most <= len(rows) <= most
    steps = np.diff(rows)
    assert steps.max() < 2 * steps.min()  # spread over the whole way


def test_lost_frames_are_left_out_and_maps_stay_apart() -> None:
    statuses = np.zeros(100, np.uint8)
    statuses[40:50] = FrameStatus.LOST
    maps = np.repeat([0, 1], [50, 50]).astype(np.int32)
    found = _odometry(_line(100, 0.05), statuses=statuses, maps=maps)
    rows = choose_frames(found, SETTINGS)
    assert not np.isin(rows, np.arange(40, 50)).any()
    assert {0, 50} <= set(rows.tolist())
    assert [len(piece.timestamps) for piece in found.pieces()] == [40, 50]
    assert [(s.frames, s.first_s) for s in found.lost()] == [(10, pytest.approx(40 / 30))]


def test_frames_of_a_map_that_goes_on_behind_another_are_in_order_of_time(tmp_path: Path) -> None:
    maps = np.repeat([0, 1, 0], 30).astype(np.int32)  # the third part was joined to the first
    found = _odometry(_line(90, 0.05), maps=maps)
    rows = choose_frames(found, SETTINGS)
    write_chosen(found, rows, tmp_path / "chosen.tum")
    times = read_trajectory(tmp_path / "chosen.tum").timestamps
    assert times.tolist() == found.timestamps[rows].tolist()
    assert np.bincount(maps[rows]).min() >= 10


def test_maps_of_few_frames_and_maps_without_points_have_no_pose() -> None:
    statuses = np.zeros(60, np.uint8)
    statuses[30:50] = FrameStatus.TURNING
    maps = np.repeat([0, 1, 2], [30, 20, 10]).astype(np.int32)
    maps[57:] = 3
    found = _odometry(_line(60, 0.05), statuses=statuses, maps=maps)
    assert np.flatnonzero(found.posed()).tolist() == [*range(30), *range(50, 57)]
    assert found.report()["maps"] == 2


def test_a_camera_that_only_turned_has_its_rotations() -> None:
    statuses = np.full(30, FrameStatus.TURNING, np.uint8)
    found = _odometry(np.zeros((30, 3)), statuses=statuses, distances=np.nan)
    assert found.posed().all() and not found.usable()
    assert "rotations only" in found.summary()


def test_a_turn_has_its_rotations_beside_a_map_of_few_frames() -> None:
    statuses = np.repeat([FrameStatus.TURNING, FrameStatus.TRACKED], [26, 4]).astype(np.uint8)
    maps = np.repeat([0, 1], [26, 4]).astype(np.int32)
    found = _odometry(np.zeros((30, 3)), statuses=statuses, maps=maps)
    assert np.flatnonzero(found.posed()).tolist() == [*range(26)]
    assert "26 of 30 frames posed" in found.summary() and "rotations only" in found.summary()


def test_frames_without_a_pose_have_no_rotations_either() -> None:
    statuses = np.full(30, FrameStatus.LOST, np.uint8)
    line = _odometry(np.zeros((30, 3)), statuses=statuses, distances=np.nan).summary()
    assert line.startswith("0 of 30 frames posed, 0 keyframes, ") and "rotations" not in line
