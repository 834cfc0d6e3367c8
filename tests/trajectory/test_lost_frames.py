"""Rows of lost frames are left out; standing cameras, new maps and first frames are kept."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsba.geometry import pose
from gsba.trajectory.restarts import split_restarts, without_lost_frames
from gsba.types import Trajectory

NUM = 30


def _walk() -> np.ndarray:
    t = np.linspace(0, 1, NUM)
    turns = Rotation.from_rotvec(np.column_stack([0.02 * np.sin(9 * t), 1.5 * t, 0 * t]))
    return pose(turns.as_matrix(), np.column_stack([9 * np.sin(t), 0.1 * np.cos(7 * t) - 0.1, t]))


def _kept(poses: np.ndarray) -> list[int]:
    found = without_lost_frames(Trajectory(np.arange(NUM) * 0.5, poses))
    return np.round(found.timestamps / 0.5).astype(int).tolist()


@pytest.mark.parametrize(("first", "last"), [(5, 7), (12, 12), (3, 20), (27, 29), (29, 29)])
@pytest.mark.parametrize("kind", ["identity", "repeated"])
def test_lost_frames_have_no_pose(kind: str, first: int, last: int) -> None:
    poses = _walk()
    poses[first : last + 1] = np.eye(4) if kind == "identity" else poses[first - 1]
    assert _kept(poses) == [n for n in range(NUM) if not first <= n <= last]


def test_frames_before_the_first_map_have_no_pose() -> None:
    poses = _walk()
    poses[:6] = np.eye(4)
    assert _kept(poses) == list(range(6, NUM))  # the path begins far from the identity
    poses = np.concatenate([np.tile(np.eye(4), (5, 1, 1)), _walk()[: NUM - 5]])
    assert _kept(poses) == list(range(5 - (poses[5] != np.eye(4)).any(), NUM))


def test_a_camera_that_stands_is_kept() -> None:
    """A wheel's odometry repeats its pose exactly, and goes on at its pace."""
    walk = _walk()
    poses = np.concatenate([walk[:10], np.tile(walk[9], (8, 1, 1)), walk[10 : NUM - 8]])
    assert _kept(poses) == list(range(NUM))
    still = Trajectory(np.arange(NUM) * 0.5, np.tile(walk[3], (NUM, 1, 1)))
    assert len(without_lost_frames(still).timestamps) == NUM


@pytest.mark.parametrize("scale", [0.4, 1.0, 2.7])
@pytest.mark.parametrize("at", [7, 14])
def test_a_new_map_is_no_lost_frame(scale: float, at: int) -> None:
    poses = np.linalg.inv(_walk()[0]) @ _walk()
    second = np.linalg.inv(poses[at]) @ poses[at:]
    second[:, :3, 3] *= scale
    second[0] = np.eye(4)
    poses[at:] = second
    assert _kept(poses) == list(range(NUM))
    pieces = split_restarts(without_lost_frames(Trajectory(np.arange(NUM) * 0.5, poses)))
    assert [len(piece.timestamps) for piece in pieces] == [at, NUM - at]


def test_lost_frames_are_no_new_map() -> None:
    poses = _walk()
    poses[12:16] = np.eye(4)
    cleaned = without_lost_frames(Trajectory(np.arange(NUM) * 0.5, poses))
    assert len(split_restarts(cleaned)) == 1
