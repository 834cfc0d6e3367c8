"""Frames that follow corrected keyframes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import loop_walk

from gsba.geometry import inverse, pose, rotation_angle
from gsba.log import GsbaError
from gsba.trajectory.association import follow_keyframes
from gsba.types import Trajectory

TRUTH, TIMES = loop_walk(41), np.arange(41) / 10
KEYS = np.arange(2, 41, 6)  # the last is 38


def _bent(amount: float) -> np.ndarray:
    """The walk before its loop was closed: the world turned and shifted more and more."""
    along = amount * TIMES[:, None]
    turns = Rotation.from_rotvec(along * [0, 0.02, 0]).as_matrix()
    return pose(turns, along * [0.1, 0, 0.05]) @ TRUTH


def test_frames_between_corrected_keyframes_are_nearly_right() -> None:
    stale = Trajectory(TIMES, _bent(1.0))
    followed = follow_keyframes(stale, Trajectory(TIMES[KEYS], TRUTH[KEYS]))
    np.testing.assert_array_equal(followed.timestamps, TIMES)
    np.testing.assert_allclose(followed.world_T_rigs[KEYS], TRUTH[KEYS], atol=1e-9)
    inner = slice(KEYS[0], KEYS[-1] + 1)
    off = np.linalg.norm((followed.world_T_rigs - TRUTH)[inner, :3, 3], axis=1)
    before = np.linalg.norm((stale.world_T_rigs - TRUTH)[inner, :3, 3], axis=1)
    assert off.max() < 2e-3 and before.max() > 0.3
    between = np.swapaxes(followed.world_T_rigs[inner, :3, :3], 1, 2) @ TRUTH[inner, :3, :3]
    assert np.degrees(rotation_angle(between)).max() < 0.02


def test_beyond_the_keyframes_the_motion_goes_on() -> None:
    stale = _bent(1.0)
    followed = follow_keyframes(Trajectory(TIMES, stale), Trajectory(TIMES[KEYS], TRUTH[KEYS]))
    for f, key in ((0, KEYS[0]), (40, KEYS[-1])):
        expected = TRUTH[key] @ inverse(stale[key]) @ stale[f]
        np.testing.assert_allclose(followed.world_T_rigs[f], expected, atol=1e-9)


def test_keyframes_without_a_frame_are_added() -> None:
    kept = np.setdiff1d(np.arange(41), [KEYS[3]])
    followed = follow_keyframes(
        Trajectory(TIMES[kept], TRUTH[kept]), Trajectory(TIMES[KEYS], TRUTH[KEYS])
    )
    np.testing.assert_array_equal(followed.timestamps, TIMES)
    np.testing.assert_allclose(followed.world_T_rigs, TRUTH, atol=1e-9)


def test_files_of_different_runs_are_refused() -> None:
    with pytest.raises(GsbaError, match="only 0 of 7 keyframes"):
        follow_keyframes(Trajectory(TIMES, TRUTH), Trajectory(TIMES[KEYS] + 0.05, TRUTH[KEYS]))
