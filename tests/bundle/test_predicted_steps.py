"""Steps are compared with those that points seen from far frames predict."""

import numpy as np
import pytest
from plain_records import map_of
from scipy.spatial.transform import Rotation
from synthetic import unit, with_noise

from gsba.bundle.map_strength import step_deviations
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
