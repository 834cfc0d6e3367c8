"""What covers the scene: found where points vanish at once, and without a say in poses."""

import cv2
import numpy as np
import pytest
from dense_walk import WIDTH, RenderedWalk
from scipy.spatial.transform import Rotation

from gsba.evaluate.trajectory import evaluate
from gsba.geometry import inverse, pose, unit
from gsba.odometry.frame_record import FrameStatus
from gsba.odometry.occlusion import Occlusion
from gsba.odometry.tracker import Tracker
from gsba.odometry.window import WindowObservations, judge_features
from gsba.types import Trajectory


def _bearings(num: int = 600) -> np.ndarray:
    return unit(np.random.default_rng(0).normal(size=(num, 3)))


def test_half_a_sphere_that_vanishes_at_once_is_covered_until_new_features_agree() -> None:
    occlusion, bearings = Occlusion(4), _bearings()
    left = bearings[:, 0] < 0
    assert occlusion.update(10, bearings, ~left)
    assert occlusion.covers(np.array([[-1.0, 0, 0]])).all()
    assert not occlusion.covers(np.array([[1.0, 0, 0]])).any()
    occlusion.clear(bearings[left], np.zeros(np.count_nonzero(left), bool))
    assert occlusion.covers(np.array([[-1.0, 0, 0]])).all()
    occlusion.clear(bearings[left], np.ones(np.count_nonzero(left), bool))
    assert not occlusion.covers(bearings).any()


def test_points_that_vanish_here_and_there_cover_nothing() -> None:
    occlusion, bearings = Occlusion(4), _bearings()
    fits = np.random.default_rng(1).random(len(bearings)) < 0.4
    assert not occlusion.update(0, bearings, fits)
    assert not occlusion.covers(bearings).any()


def test_features_that_move_with_the_camera_are_told_from_those_that_stand() -> None:
    steps = 0.3 * np.arange(5)[:, None] * np.array([[0.2, 0.0, 1.0]])
    turns = np.deg2rad([[0.0, 5.0, 1.0]]) * np.array([[0.0], [1.0], [-1.0], [2.0], [0.5]])
    poses = pose(Rotation.from_rotvec(turns).as_matrix(), steps)
    points, carried = 3 * _bearings(100), _bearings(160)[100:]
    offsets = [(points - t[:3, 3]) @ t[:3, :3] for t in poses]
    ids = np.arange(160)
    seen = WindowObservations.of([(ids, np.concatenate([unit(o), carried])) for o in offsets])
    judged = judge_features(poses, seen, np.deg2rad(0.1), 4.0)
    assert len(judged.ids) > 140
    np.testing.assert_array_equal(judged.agree, judged.ids < 100)


@pytest.mark.parametrize("speed_px", [0, 4])
def test_a_hand_over_half_the_picture_does_not_bend_the_path(
    walk: RenderedWalk, speed_px: int
) -> None:
    noise = np.random.default_rng(0).normal(size=walk.frames[0].shape)
    hand = np.clip(128 + 700 * cv2.GaussianBlur(noise, (0, 0), 2), 0, 255).astype(np.uint8)
    frames = [frame.copy() for frame in walk.frames]
    for n in range(14, 24):
        covering = np.roll(hand, speed_px * (n - 14), axis=1)
        frames[n][:, : WIDTH // 2] = covering[:, : WIDTH // 2]
    tracker = Tracker(WIDTH)
    for frame in frames:
        tracker.add(frame)
    found = np.flatnonzero([r.status != FrameStatus.LOST for r in tracker.records])
    assert len(found) == len(frames)
    assert {record.map_number for record in tracker.records} == {0}
    truth = inverse(walk.world_T_rigs[0]) @ walk.world_T_rigs
    times = np.arange(len(frames), dtype=float)
    errors = evaluate(Trajectory(times, tracker.world_T_rigs()), Trajectory(times, truth))
    path = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
    assert errors.ate.rmse < 0.01 * path
