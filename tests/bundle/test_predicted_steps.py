"""Steps are compared with those that points seen from far frames predict."""

import numpy as np
import pytest
from plain_records import map_of
from scipy.spatial.transform import Rotation
from synthetic import unit, with_noise

from gsba.bundle.map_strength import overlap_ratios, step_deviations
from gsba.geometry import pose
from gsba.types import Reconstruction

NUM, NUM_POINTS = 12, 80
NEST = slice(4, 8)  # frames that stand close together in the false map


def _map(nested: bool, noise: float = 0.0, standing: slice = slice(0)) -> Reconstruction:
    """A map of frames that see all points; `nested`: some stand in one place, where the residuals
    of what they see do not move them. Bearings have `noise` radians; the camera may be `standing`
    at some frames."""
    rng = np.random.default_rng(2)
    turns = Rotation.from_rotvec([[0, 0.3 * f, 0.02 * f] for f in range(NUM)]).as_matrix()
    poses = pose(turns, rng.normal(0, 0.05, (NUM, 3)))
    poses[standing, :3, 3] = poses[standing.start or 0, :3, 3]
    points = unit(rng.normal(size=(NUM_POINTS, 3))) * rng.uniform(1, 4, (NUM_POINTS, 1))
    which, frames = np.divmod(np.arange(NUM * NUM_POINTS), NUM)
    rays = points[which] - poses[frames, :3, 3]
    bearings = unit(np.einsum("oji,oj->oi", poses[frames, :3, :3], rays))
    bearings = with_noise(bearings, noise, rng)
    if nested:
        poses[NEST, :3, 3] = poses[4, :3, 3] + 0.01 * (poses[NEST, :3, 3] - poses[4, :3, 3])
    return map_of(poses, points, which, frames, bearings)


def test_true_steps_are_predicted() -> None:
    np.testing.assert_allclose(step_deviations(_map(nested=False)), 0, atol=1e-6)


def test_steps_that_shrank_are_not() -> None:
    off = step_deviations(_map(nested=True))
    assert off[4:7] == pytest.approx(0.99, abs=0.01)
    np.testing.assert_allclose(off[np.r_[:3, 8:11]], 0, atol=1e-6)


def test_without_far_frames_nothing_is_predicted() -> None:
    assert np.isnan(step_deviations(_map(nested=True).taken(np.arange(5)))).all()


def test_a_camera_that_stands_is_not_contradicted_by_noise() -> None:
    off = step_deviations(_map(nested=False, noise=1e-3, standing=NEST))
    assert np.nanmax(off) < 0.2


def _walk(cut: int, step_at_cut: float = 1.0) -> Reconstruction:
    """Frames along a line that see points of five frames in a row; over the step before frame
    `cut`, few of them."""
    lengths = np.ones(NUM)
    lengths[cut] = step_at_cut
    poses = pose(np.tile(np.eye(3), (NUM, 1, 1)), np.cumsum(lengths)[:, None] * [1.0, 0, 0])
    first = np.repeat(np.arange(-4, NUM), 10)[:, None]
    frames = np.arange(NUM)
    seen = (frames >= first) & (frames < first + 5)
    few = (np.arange(len(first)) % 10 == 0)[:, None]
    seen &= few | ((frames >= cut) == (first + 2 >= cut))
    owners, frames = np.nonzero(seen)
    return map_of(poses, np.zeros((len(first), 3)), owners, frames, np.zeros((len(owners), 3)))


def test_frames_over_a_cut_have_far_less_in_common_than_those_beside() -> None:
    one = np.zeros(NUM, np.int64)
    found = overlap_ratios(_walk(cut=6), one)
    assert found[5] < 0.4 and np.nanmin(np.delete(found, 5)) > 0.9
    assert np.isnan(found[[0, -1]]).all()
    assert np.nanmin(overlap_ratios(_walk(cut=0), one)) > 0.9
    assert overlap_ratios(_walk(cut=6, step_at_cut=2.0), one)[5] > found[5]  # less is expected
    assert np.isnan(overlap_ratios(_walk(cut=6, step_at_cut=20.0), one)[5])  # none is
    two_recordings = (np.arange(NUM) >= 6).astype(int)
    assert np.isnan(overlap_ratios(_walk(cut=6), two_recordings)[4:7]).all()


def test_frames_of_a_camera_that_stands_share_out_their_points() -> None:
    """Each has few points in common with the frames beside it; their place has as many as usual."""
    walk, place = _walk(cut=0), np.insert(np.arange(NUM), 6, [5, 5])  # of each frame, 5 thrice
    rows = walk.observation_frames
    shared = walk.observation_points % 3
    frames = np.where(rows == 5, 5 + shared, rows + 2 * (rows > 5))
    order = np.argsort(frames, kind="stable")
    standing = map_of(
        walk.world_T_rigs[place], walk.points_world, walk.observation_points[order], frames[order],
        np.zeros((len(rows), 3)),
    )  # fmt: skip
    found = overlap_ratios(standing, np.zeros(len(place), np.int64))
    assert np.nanmin(found) > 0.9
    assert np.isnan(found[5:7]).all() and np.isfinite(found[[4, 7]]).all()
