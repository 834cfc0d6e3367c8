"""The tracker on rendered walks: walking, turning, standing, darkness, another place."""

import numpy as np
import pytest
from dense_walk import WIDTH, RenderedWalk
from scipy.spatial.transform import Rotation

from gsba.evaluate.trajectory import evaluate
from gsba.geometry import rotation_angle
from gsba.odometry.tracker import FREE, HELD, Tracker
from gsba.odometry.tracker_state import FrameStatus
from gsba.types import Trajectory


def _track(walk: RenderedWalk, **options) -> Tracker:
    tracker = Tracker(WIDTH, **options)
    for frame in walk.frames:
        tracker.add(frame)
    return tracker


def _statuses(tracker: Tracker) -> np.ndarray:
    return np.array([record.status for record in tracker.state.records])


def _error(tracker: Tracker, walk: RenderedWalk, rows: np.ndarray) -> tuple[float, float]:
    """ATE as a part of the path, and the largest rotation error in degrees."""
    times = np.arange(len(rows), dtype=float)
    truth = walk.world_T_rigs[rows]
    errors = evaluate(Trajectory(times, tracker.world_T_rigs()[rows]), Trajectory(times, truth))
    path = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
    return errors.ate.rmse / path, errors.rotation_deg.max


def test_every_frame_of_a_walk_is_posed_in_one_map(walk: RenderedWalk) -> None:
    """Within the memory of the window."""
    tracker = _track(walk)
    assert len(tracker.state.keyframe_poses) > FREE + HELD == len(tracker.state.window)
    assert not (_statuses(tracker) == FrameStatus.LOST).any()
    assert {record.map_number for record in tracker.state.records} == {0}
    ate, rotation = _error(tracker, walk, np.arange(len(walk.frames)))
    assert ate < 0.01  # of the path, as asked of odometry alone
    assert rotation < 1.0


def test_the_same_frames_give_the_same_poses(walk: RenderedWalk) -> None:
    short = RenderedWalk(walk.frames[:8], walk.world_T_rigs[:8])
    one, other = _track(short).world_T_rigs(), _track(short).world_T_rigs()
    np.testing.assert_array_equal(one, other)


def test_a_camera_that_turns_on_the_spot_gives_rotations_alone(walk: RenderedWalk) -> None:
    turns = np.deg2rad(7.0) * np.arange(20)[:, None] * np.array([[0.1, 1.0, 0.05]])
    rotations = Rotation.from_rotvec(turns).as_matrix()
    turning = walk.at([0] * 20).turned(rotations)
    tracker = _track(turning)
    assert (_statuses(tracker) == FrameStatus.TURNING).all()
    poses = tracker.world_T_rigs()
    np.testing.assert_array_equal(poses[:, :3, 3], 0.0)  # no translation is made up
    off = rotation_angle(np.swapaxes(poses[:, :3, :3], 1, 2) @ rotations)
    assert np.rad2deg(off).max() < 0.3


@pytest.mark.parametrize("degrees", [5.0, 20.0])
def test_a_turn_during_a_walk_is_followed(walk: RenderedWalk, degrees: float) -> None:
    order = [*range(12), *[12] * 14, *range(12, 24)]
    angles = np.clip(np.arange(len(order)) - 12, 0, 14) * np.deg2rad(degrees)
    rotations = Rotation.from_rotvec(angles[:, None] * np.array([[0.0, 1.0, 0.0]])).as_matrix()
    turning = walk.at(order).turned(rotations)
    tracker = _track(turning)
    assert not (_statuses(tracker) == FrameStatus.LOST).any()
    ate, rotation = _error(tracker, turning, np.arange(len(order)))
    assert ate < 0.02 and rotation < 2.0


def test_a_camera_that_stands_adds_no_keyframes(walk: RenderedWalk) -> None:
    standing = walk.at([*range(10), *[10] * 20])
    tracker = _track(standing)
    assert max(tracker.state.keyframe_frames) <= 11
    positions = tracker.world_T_rigs()[11:, :3, 3]
    step = np.linalg.norm(np.diff(tracker.world_T_rigs()[:10, :3, 3], axis=0), axis=1).mean()
    assert np.linalg.norm(positions - positions.mean(axis=0), axis=1).max() < 0.2 * step


def test_dark_frames_get_no_pose_and_the_map_goes_on(walk: RenderedWalk) -> None:
    rng = np.random.default_rng(3)
    dark = walk.at([*range(14), *[14] * 10, *range(14, 24)])
    for n in range(14, 24):
        dark.frames[n][:] = np.clip(rng.normal(5, 2, dark.frames[n].shape), 0, 255)
    tracker = _track(dark)
    lost = _statuses(tracker) == FrameStatus.LOST
    np.testing.assert_array_equal(np.flatnonzero(lost), np.arange(14, 24))
    assert {record.map_number for record in tracker.state.records} == {0}
    ate, _ = _error(tracker, dark, np.flatnonzero(~lost))
    assert ate < 0.02


def test_another_place_begins_a_map_of_its_own(walk: RenderedWalk) -> None:
    flipped = [np.ascontiguousarray(frame[:, ::-1]) for frame in walk.frames]  # no place of it
    elsewhere = RenderedWalk(walk.frames[:12] + flipped[24:], walk.world_T_rigs)
    tracker = _track(elsewhere, patience=3)
    numbers = [record.map_number for record in tracker.state.records]
    assert numbers[11] == 0 and numbers[-1] == 1
    first = numbers.index(1)
    np.testing.assert_array_equal(tracker.world_T_rigs()[first], np.eye(4))


def test_what_is_masked_is_not_followed(walk: RenderedWalk) -> None:
    usable = np.ones((WIDTH // 2, WIDTH), bool)
    usable[:, : WIDTH // 2] = False
    tracker = _track(RenderedWalk(walk.frames[:4], walk.world_T_rigs[:4]), usable=usable)
    bearings = tracker.state.window[0].bearings
    longitudes = np.arctan2(bearings[:, 0], bearings[:, 2])
    assert len(bearings) > 50 and (longitudes > -0.05).all()


def test_a_picture_that_shows_nothing_begins_no_map() -> None:
    tracker = Tracker(WIDTH)
    for _ in range(3):
        tracker.add(np.full((WIDTH // 2, WIDTH), 20, np.uint8))
    assert (_statuses(tracker) == FrameStatus.LOST).all()
    np.testing.assert_array_equal(tracker.world_T_rigs(), np.tile(np.eye(4), (3, 1, 1)))
