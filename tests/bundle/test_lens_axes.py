"""The way lenses look: the panorama's own, or one that turns below a stabilised panorama."""

from dataclasses import replace

import numpy as np
import pytest
from lens_world import placed, problem_of, seen_through, solved_under, solved_with
from scipy.spatial.transform import Rotation
from synthetic import loop_walk

from gsba.bundle import lens_axes, lens_centres
from gsba.bundle.lens_axes import upright
from gsba.bundle.readout import CameraEstimate
from gsba.bundle.shared_parameters import ObservedRays
from gsba.camera.lens import Lenses
from gsba.similarity import pose_similarity
from gsba.types import Solution

BAND, LENGTH, NUM = np.deg2rad(4), 0.05, 24


def _stabilised() -> np.ndarray:
    """The walk, its panoramas turned back to one heading."""
    poses = loop_walk(NUM)
    poses[:, :3, :3] = np.eye(3)
    return poses


def _held(seed: int) -> np.ndarray:
    """Axes (F, 3, 3) of lenses along that walk, held askew, a little anew in each frame."""
    positions = loop_walk(NUM)[:, :3, 3]
    ahead = np.roll(positions, -1, axis=0) - np.roll(positions, 1, axis=0)
    tilts = np.array([6.0, 10.0, 0.0]) + np.random.default_rng(seed).normal(0, 2.0, (NUM, 3))
    return upright(ahead) @ Rotation.from_rotvec(np.deg2rad(tilts)).as_matrix()


def _off_deg(axes: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Angles (F,) between lines along which lenses look."""
    cosines = np.abs(np.einsum("fi,fi->f", axes[:, :, 2], truth[:, :, 2]))
    return np.degrees(np.arccos(np.minimum(cosines, 1)))


@pytest.mark.parametrize("seed", range(2))
def test_axes_below_a_stabilised_panorama_are_found(seed: int) -> None:
    truth = _held(seed)
    camera = Lenses(np.array([0, 0, LENGTH]), band_rad=BAND, axes=truth)
    world, shown = seen_through(camera, seed, _stabilised())
    start, problem = Solution.without_points(world.world_T_rigs), problem_of(world)
    solved, keypoints, tracks = solved_under(world, shown, Lenses(), start)
    around = replace(solved, landmarks=placed(solved, keypoints, tracks))
    rays = ObservedRays(around, keypoints, problem, Lenses(band_rad=BAND))
    lenses = lens_axes.guess(rays).lenses
    assert lenses.axes is not None and np.median(_off_deg(lenses.axes, truth)) < 20
    found = lens_centres.estimate(replace(rays, lenses=lenses))
    assert not found.reason
    camera = CameraEstimate(found.lenses)
    solved, camera = solved_with(world, shown, camera, solved, problem)
    assert camera.lenses.axes is not None
    assert np.median(_off_deg(camera.lenses.axes, truth)) < 1
    scale = pose_similarity(solved.world_T_rigs, world.world_T_rigs).scale  # no image knows it
    assert scale * np.linalg.norm(camera.lenses.centre) == pytest.approx(LENGTH, rel=0.02)
    assert solved.noise < 1.2


@pytest.mark.parametrize("seed", range(2))
def test_lenses_that_look_as_their_panorama_does_are_not_turned(seed: int) -> None:
    camera = Lenses(np.array([0, 0, LENGTH]), band_rad=BAND)
    world, shown = seen_through(camera, seed)
    start, problem = Solution.without_points(world.world_T_rigs), problem_of(world)
    solved, keypoints, tracks = solved_under(world, shown, Lenses(), start)
    around = replace(solved, landmarks=placed(solved, keypoints, tracks))
    guess = lens_axes.guess(ObservedRays(around, keypoints, problem))
    assert guess.reason and guess.lenses.axes is None
    for _ in range(3):
        solved, keypoints, tracks = solved_under(world, shown, camera, solved)
    around = replace(solved, landmarks=placed(solved, keypoints, tracks))
    found = lens_axes.loosened(ObservedRays(around, keypoints, problem, camera))
    assert found.reason and found.lenses.axes is None


def test_upright_axes_are_rotations_along_what_they_are_given() -> None:
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions[:2] = [[0, 2, 0], [0, -1, 0]]  # straight down and up
    axes = upright(directions)
    along = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(axes[:, :, 2], along, atol=1e-12)
    products = axes @ np.swapaxes(axes, 1, 2)
    np.testing.assert_allclose(products, np.tile(np.eye(3), (50, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(axes), 1)
    np.testing.assert_allclose(axes[2:, 1, 0], 0, atol=1e-12)  # x is level


def test_a_camera_heads_along_its_own_map() -> None:
    """Every third frame is in no map, and lies far away."""
    world_T_rigs, maps = loop_walk(12, 1.0), np.zeros(12, np.int64)
    maps[2::3] = 1 + np.arange(4)
    apart = world_T_rigs.copy()
    apart[2::3, 0, 3] += 100
    ahead = apart[1::3, :3, 3] - apart[0::3, :3, 3]
    found = lens_axes._headings(apart, maps)
    for first in (0, 1):  # both frames of a map go along its step
        local = np.einsum("fji,fj->fi", apart[first::3, :3, :3], ahead)
        local[:, 1] = 0
        along = local / np.linalg.norm(local, axis=1, keepdims=True)
        np.testing.assert_allclose(found[first::3], along, atol=1e-9)
