"""Which frame a point is taken from, and where it is looked for."""

import numpy as np
import pytest

from gsba.geometry import pose, standing_places
from gsba.photometric import references as references_
from gsba.photometric.references import references, visible_frames
from gsba.types import Counts, Landmarks, Tracks

ALL = np.ones(1, bool)


def _poses(x: np.ndarray) -> np.ndarray:
    return pose(np.tile(np.eye(3), (len(x), 1, 1)), np.column_stack([x, 0 * x, 0 * x]))


def _landmarks(points: list[list[float]], seen: list[list[int]]) -> Landmarks:
    owners = np.repeat(np.arange(len(seen)), [len(frames) for frames in seen]).astype(np.int32)
    frames = np.concatenate(seen).astype(np.int32)
    tracks = Tracks(owners, frames, np.zeros(len(frames), np.int32), len(seen))
    return Landmarks(np.array(points, float), tracks, Counts(len(seen), len(seen), "tracks"))


def _visible(
    landmarks: Landmarks, x: np.ndarray, rows: np.ndarray, extended: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    poses = _poses(x)
    return visible_frames(landmarks, poses, rows, extended, standing_places(poses[:, :3, 3]))


def test_the_reference_is_in_the_middle() -> None:
    poses = _poses(np.arange(7.0))
    landmarks = _landmarks([[3, 0, 5], [3, 0, 5]], [[0, 2, 6], [1, 5, 6]])
    assert list(references(landmarks, poses)) == [1, 4]


def test_views_are_similar_and_never_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    x = np.array([0, 1, 2, 3, 4, 30.0])
    landmarks = _landmarks([[2, 0, 4]], [[1, 2, 3]])
    monkeypatch.setattr(references_, "MAX_ANGLE_DEG", 20.0)
    points, frames = _visible(landmarks, x, np.array([1]), ALL)
    assert list(points) == [0, 0] and list(frames) == [1, 3]  # 0 and 4 are 27 degrees off
    monkeypatch.setattr(references_, "MAX_ANGLE_DEG", 30.0)
    assert set(_visible(landmarks, x, np.array([1]), ALL)[1]) == {0, 1, 3, 4}


def test_revisits_are_views_whatever_their_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(references_, "_NEAR_FRAMES", 3)
    x = np.array([0, 1, 2, 50, 51, 1.1])
    landmarks = _landmarks([[1, 0, 4]], [[0, 1, 2]])
    _, frames = _visible(landmarks, x, np.array([1]), ALL)
    assert set(frames) == {0, 2, 5}


def test_a_camera_that_stands_takes_no_views_from_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twelve frames of one place are one view of the six, tracked or near."""
    monkeypatch.setattr(references_, "_MAX_VIEWS", 6)
    monkeypatch.setattr(references_, "_NEAR_FRAMES", 6)
    x = np.r_[0, 1, 2, 3 + 0.01 * np.arange(12) % 0.03, 4, 5, 6]
    standing = list(range(3, 15))
    landmarks = _landmarks([[3, 0, 9], [2, 0, 9]], [standing, [2, 15]])
    both = np.ones(2, bool)
    points, frames = _visible(landmarks, x, np.array([5, 12]), both)
    assert set(frames[points == 0]) == {*range(18)} - {8}
    shown = frames[points == 1]
    assert set(shown) >= {0, 1, 15, 16} and len(set(shown) & set(standing)) == 1


def test_limits_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(references_, "_MAX_VIEWS", 5)
    x = np.linspace(0, 1, 12)
    landmarks = _landmarks([[0.5, 0, 4], [0.5, 0, 5]], [[3, 5, 7], [4, 6]])
    points, frames = _visible(landmarks, x, np.array([1, 4]), np.array([True, False]))
    assert np.count_nonzero(points == 0) == 5
    assert list(frames[points == 1]) == [4]  # not to be looked for elsewhere


def test_a_point_at_a_centre_is_looked_for_nowhere_else() -> None:
    landmarks = _landmarks([[1, 0, 0]], [[0, 1, 2]])
    _, frames = _visible(landmarks, np.arange(4.0), np.array([1]), ALL)
    assert 3 not in frames
