"""Pieces of a trajectory: found where a map was begun anew, and laid into one world."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import drifted, loop_walk

from gsba.config import ReadSettings
from gsba.geometry import inverse, pose
from gsba.similarity import Sim3
from gsba.trajectory import joining
from gsba.trajectory.joining import GUESS
from gsba.trajectory.restarts import associate_pieces, split_restarts
from gsba.types import CoarsePoses, FrameSet, PictureFormat, PoseSource, Trajectory

NUM, BREAK = 40, 17
TRUTH = loop_walk(NUM)
TIMES = np.arange(NUM, dtype=float)
SCALE = 1.7
MOVE = pose(Rotation.from_rotvec([0.4, -2.0, 0.7]).as_matrix(), np.array([5.0, -3.0, 8.0]))


def _frames(num: int = NUM) -> FrameSet:
    names = tuple(f"{f:03d}" for f in range(num))
    paths = tuple((Path(name),) for name in names)
    return FrameSet(names, paths, TIMES[:num], (None,) * num, (PictureFormat("erp", 64, 32),))


def _begun_anew(scale: float = SCALE) -> np.ndarray:
    """The walk as a SLAM writes it that loses its map: the identity once more."""
    poses = inverse(TRUTH[:1]) @ TRUTH
    poses[BREAK:] = Sim3.of(scale, np.eye(4)).poses(inverse(TRUTH[BREAK])[None] @ TRUTH[BREAK:])
    return poses


def _coarse(poses: np.ndarray) -> CoarsePoses:
    own = np.full(NUM, PoseSource.SLAM, np.uint8)
    return CoarsePoses(poses, own, 0.0, (np.arange(NUM) >= BREAK).astype(np.int32))


def test_a_map_begun_anew_is_found() -> None:
    found = split_restarts(Trajectory(TIMES, _begun_anew()))
    assert [len(piece.timestamps) for piece in found] == [BREAK, NUM - BREAK]


def test_a_map_begun_anew_whose_first_pose_is_missing_is_found() -> None:
    """The first entry of a frame trajectory may be the second frame of its map."""
    poses, first = np.delete(_begun_anew(0.6), BREAK, axis=0), np.delete(TIMES, BREAK)
    found = split_restarts(Trajectory(first, poses))
    assert [len(piece.timestamps) for piece in found] == [BREAK, NUM - BREAK - 1]


@pytest.mark.parametrize("what", ["a walk", "excursions to the start", "standing at the start"])
def test_one_map_stays_one(what: str) -> None:
    poses = inverse(TRUTH[:1]) @ drifted(TRUTH, np.random.default_rng(0))
    if what == "excursions to the start":  # false relocalisations, four frames each
        poses[12:16], poses[24:28] = poses[0:4], poses[1:5]
        poses[12:16, 0, 3] += 1e-3
    elif what == "standing at the start":
        poses[:5] = np.eye(4)
    assert len(split_restarts(Trajectory(TIMES, poses))) == 1


def test_pieces_keep_their_worlds_until_joined() -> None:
    poses = _begun_anew()
    pieces = [Trajectory(TIMES[:BREAK], poses[:BREAK]), Trajectory(TIMES[BREAK:], poses[BREAK:])]
    coarse = associate_pieces(_frames(), pieces[::-1], ReadSettings())  # in any order
    np.testing.assert_allclose(coarse.world_T_rigs, poses, atol=1e-12)
    assert coarse.segments is not None
    np.testing.assert_array_equal(coarse.segments, np.arange(NUM) >= BREAK)
    assert (coarse.sources == PoseSource.SLAM).all()


def test_frames_between_pieces_go_on_from_the_nearer_one() -> None:
    poses = _begun_anew()
    first, second = slice(0, BREAK - 4), slice(BREAK + 2, NUM)
    pieces = [Trajectory(TIMES[piece], poses[piece]) for piece in (first, second)]
    coarse = associate_pieces(_frames(), pieces, ReadSettings())
    between = np.arange(BREAK - 4, BREAK + 2)
    assert (coarse.sources[between] == PoseSource.EXTRAPOLATED).all()
    assert coarse.segments is not None and coarse.segments[BREAK - 4] == 0
    step = np.linalg.norm(poses[1, :3, 3] - poses[0, :3, 3])
    leap = np.linalg.norm(coarse.world_T_rigs[BREAK - 4, :3, 3] - poses[BREAK - 5, :3, 3])
    assert leap < 2 * step  # and not on the way to another world's origin


def test_where_pieces_overlap_the_earlier_leads() -> None:
    other = Sim3.of(SCALE, MOVE).poses(TRUTH)
    pieces = [Trajectory(TIMES[:25], TRUTH[:25]), Trajectory(TIMES[10:], other[10:])]
    coarse = associate_pieces(_frames(), pieces, ReadSettings())
    np.testing.assert_allclose(coarse.world_T_rigs[:25], TRUTH[:25], atol=1e-12)
    np.testing.assert_allclose(coarse.world_T_rigs[25:], other[25:], atol=1e-12)
    inside = [pieces[0], Trajectory(TIMES[10:20], other[10:20])]
    alone = associate_pieces(_frames(25), inside, ReadSettings())
    assert alone.segments is None


def test_the_origin_is_that_of_the_first_piece_with_frames() -> None:
    origins = np.array([[5e5, 0.0, 0.0], [6e5, 0.0, 0.0]])
    pieces = [
        Trajectory(TIMES + shift, TRUTH, origin)
        for shift, origin in zip((-100.0, 0.0), origins, strict=True)
    ]
    for piece in pieces:
        frames = replace(_frames(), timestamps=piece.timestamps)
        coarse = associate_pieces(frames, pieces, ReadSettings())
        assert coarse.segments is None and coarse.origin is piece.origin


def test_a_piece_is_placed_as_if_the_pace_went_on() -> None:
    poses = TRUTH.copy()
    poses[BREAK:] = Sim3.of(SCALE, MOVE).poses(TRUTH[BREAK:])
    coarse, joints = joining.join(_coarse(poses))
    assert joints[0].how == GUESS and joints[0].scale == pytest.approx(1 / SCALE, rel=0.1)
    np.testing.assert_array_equal(np.flatnonzero(joining.guessed(joints, NUM)), [BREAK - 1])
    steps = np.linalg.norm(np.diff(coarse.world_T_rigs[:, :3, 3], axis=0), axis=1)
    assert steps[BREAK - 1] < 2 * np.median(steps)
