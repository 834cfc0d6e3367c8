"""Lens centres from a map: found where there are two, believed nowhere else."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from lens_world import (
    SETTINGS,
    SIGMA,
    placed,
    problem_of,
    seen_through,
    solved_under,
    solved_with,
    turned,
)
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix
from synthetic import World

from factors import RobustLoss, bearing_residuals
from gsba.bundle import adjustment, lens_centres
from gsba.bundle.found_camera import FoundCamera
from gsba.bundle.lens_centres import LensCentres, StitchRadius
from gsba.bundle.optimizer import SolverOptions
from gsba.bundle.readout import CameraEstimate
from gsba.bundle.shared_parameters import ObservedRays
from gsba.camera.cameras import Cameras
from gsba.camera.lens import Lenses
from gsba.config import CameraSettings
from gsba.similarity import pose_similarity
from gsba.types import Keypoints, Solution, Tracks
from gsba.types.records import with_rows

CENTRE = np.array([0.004, -0.003, 0.05])
BAND = np.deg2rad(4)


def _found(world: World, shown: Keypoints, rounds: int = 5) -> tuple[LensCentres, Solution]:
    lenses, start = Lenses(band_rad=BAND), Solution.without_points(world.world_T_rigs)
    solved, keypoints, tracks = solved_under(world, shown, lenses, start)
    found = None
    for _ in range(rounds):
        around = replace(solved, landmarks=placed(solved, keypoints, tracks))
        found = lens_centres.estimate(ObservedRays(around, keypoints, problem_of(world), lenses))
        if not found.lenses:
            break
        lenses = found.lenses
        solved, keypoints, tracks = solved_under(world, shown, lenses, solved)
    assert found is not None
    return found, solved


@cache
def _of_two(inverse: float, seed: int) -> tuple[World, Keypoints, LensCentres, Solution]:
    world, shown = seen_through(Lenses(CENTRE, inverse, BAND), seed)
    return world, shown, *_found(world, shown)


@pytest.mark.parametrize("seed", range(2))
def test_two_lenses_are_found(seed: int) -> None:
    world, _, found, solved = _of_two(0.0, seed)
    assert not found.reason and (found.part_gains > 0.2).all()
    scale = pose_similarity(solved.world_T_rigs, world.world_T_rigs).scale  # no image knows it
    sigmas = scale * np.sqrt(np.diagonal(found.covariance))
    off = np.abs(scale * found.found - CENTRE)
    assert (off < 4 * sigmas).all() and sigmas.max() < 0.02 * CENTRE[2]
    assert solved.noise < 1.3  # times the noise that there is


@pytest.mark.parametrize("seed", range(3))
def test_one_centre_is_not_taken_for_two(seed: int) -> None:
    world, shown = seen_through(Lenses(), seed)
    found, _ = _found(world, shown)
    sigmas = np.sqrt(np.diagonal(found.covariance))
    assert found.reason and not found.lenses
    assert (np.abs(found.found) < 4 * sigmas).all()


class ThreeLenses:
    """Level, a third of the way round from one another, as in cameras for broadcasts."""

    def seeing(self, points_rig: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Points (N, 3) from the lens that faces each."""
        yaw = np.deg2rad([0.0, 120, 240])
        centres = 0.05 * np.column_stack([np.sin(yaw), 0 * yaw, np.cos(yaw)])
        return points_rig - centres[np.argmax(points_rig @ centres.T, axis=1)]


@pytest.mark.parametrize("seed", range(2))
def test_three_lenses_are_not_taken_for_two(seed: int) -> None:
    found, solved = _found(*seen_through(ThreeLenses(), seed))  # type: ignore[arg-type]
    assert found.reason.startswith("it does not predict") and not found.lenses
    assert np.isfinite(solved.world_T_rigs).all()


@pytest.mark.parametrize("inverse", [0.0, 0.05, 0.6])
def test_a_stitch_radius_is_judged_by_what_is_solved_with_it(inverse: float) -> None:
    world, shown, off, solved = _of_two(inverse, 0)
    problem = problem_of(world)

    def estimate(lenses: Lenses) -> StitchRadius:
        keypoints = Cameras((lenses,)).seen(shown)
        points = placed(solved, keypoints, Cameras((lenses,)).clear(world.tracks, keypoints))
        around = replace(solved, landmarks=points)
        given = around, keypoints, problem, lenses, shown.bearings_rig
        return lens_centres.stitched_for(ObservedRays(*given))

    found = estimate(off.lenses)
    tried = found.on_trial(off.lenses)
    scale = pose_similarity(solved.world_T_rigs, world.world_T_rigs).scale
    if inverse == 0.05:  # without a radius the lenses are a sixth too near each other
        assert tried is not None
        np.testing.assert_allclose(scale * tried.centre[2], CENTRE[2], rtol=0.02)
        np.testing.assert_allclose(tried.inverse_stitch_radius, scale * inverse, rtol=0.1)
        assert scale * off.lenses.centre[2] < 0.9 * CENTRE[2]
    if tried is not None:
        solved, camera = solved_with(world, shown, CameraEstimate(tried), solved, problem)
        found = estimate(camera.lenses)
    scale = pose_similarity(solved.world_T_rigs, world.world_T_rigs).scale
    assert bool(found.reason) == (inverse == 0) == (found.lenses.inverse_stitch_radius == 0)
    assert abs(found.inverse_stitch_radius - scale * inverse) < 4 * found.sigma < 0.05


def test_another_unit_of_length_changes_a_camera_with_all_its_errors() -> None:
    world, shown, found, solved = _of_two(0.05, 0)
    lenses = found.lenses
    points = placed(solved, shown, Cameras((lenses,)).clear(world.tracks, shown))
    around = replace(solved, landmarks=points)
    given = around, Cameras((lenses,)).seen(shown), problem_of(world), lenses, shown.bearings_rig
    radius = lens_centres.stitched_for(ObservedRays(*given))
    camera = FoundCamera(found, stitch_radius=radius).scaled(3.0)
    assert camera.centres is not None and camera.stitch_radius is not None
    length, sigma = np.array(lens_centres.baseline_of(camera.centres, 1.0))
    np.testing.assert_allclose((length, sigma), lens_centres.baseline_of(found, 3.0))
    assert camera.lenses.baseline == pytest.approx(3 * lenses.baseline)
    significance = camera.stitch_radius.inverse_stitch_radius / camera.stitch_radius.sigma
    assert significance == pytest.approx(radius.inverse_stitch_radius / radius.sigma)
    assert camera.stitch_radius.sigma == pytest.approx(radius.sigma / 3)


def test_what_is_asked_for_is_taken_and_too_little_is_named() -> None:
    world, shown = seen_through(Lenses(), 0)
    camera = CameraSettings(model="two_lens")
    solved, keypoints, tracks = solved_under(
        world, shown, Lenses(band_rad=BAND), Solution.without_points(world.world_T_rigs)
    )
    problem = problem_of(world)
    asked = SETTINGS.model_copy(update={"camera": camera})
    around = replace(solved, landmarks=placed(solved, keypoints, tracks))
    rays = ObservedRays(around, keypoints, problem, Lenses(band_rad=BAND))
    taken = lens_centres.estimate(replace(rays, context=replace(problem, settings=asked)))
    assert taken.lenses and not taken.reason
    rows = np.flatnonzero(tracks.points < 30)
    some = Tracks(tracks.points[rows], tracks.frames[rows], tracks.keypoints[rows], 30)
    none = lens_centres.estimate(rays.of(placed(solved, keypoints, some)))
    assert none.reason.startswith("too few points") and not none.lenses


def test_a_step_is_that_of_an_independent_solver() -> None:
    """Poses, points and the centre by SciPy's sparse least squares, without a robust loss."""
    world, shown = seen_through(Lenses(CENTRE, band_rad=BAND), 7)
    few = (world.tracks.points < 220) & ~world.false
    tracks = replace(with_rows(world.tracks, few), num_points=220)
    plain = SETTINGS.model_copy(update={"camera": CameraSettings(model="two_lens")})
    exact = SolverOptions(relative_tolerance=1e-10, loss=RobustLoss())
    world = replace(world, tracks=tracks)
    problem = replace(problem_of(world), settings=plain, solver=exact)
    lenses, solved = Lenses(band_rad=BAND), Solution.without_points(world.world_T_rigs)
    for _ in range(6):
        cameras = Cameras((lenses,))
        keypoints = cameras.seen(shown)
        clear = cameras.clear(tracks, keypoints)
        solved = adjustment.adjust(clear, keypoints, solved, problem, (60.0,))
        landmarks = solved.landmarks
        rays = ObservedRays(replace(solved, noise=1.0), keypoints, problem, lenses)
        lenses = lens_centres.estimate(rays).lenses
    used = landmarks.tracks
    bearings = shown.bearings_rig[shown.rows(used)]
    signs = np.where(bearings[:, 2] >= 0, 1.0, -1.0)
    num_f, num_j = len(world.world_T_rigs), used.num_points

    def residuals(x: np.ndarray) -> np.ndarray:
        poses = solved.world_T_rigs.copy()
        steps = np.vstack([np.zeros(6), x[: 6 * (num_f - 1)].reshape(-1, 6)])
        poses[:, :3, 3] += np.einsum("fij,fj->fi", poses[:, :3, :3], steps[:, 3:])
        poses[:, :3, :3] = poses[:, :3, :3] @ turned(steps[:, :3])
        points = landmarks.points_world + x[6 * (num_f - 1) : -3].reshape(-1, 3)
        origins = signs[:, None] * x[-3:]
        found = bearing_residuals(poses[used.frames], points[used.points], bearings, origins)[0]
        scale = np.linalg.norm(poses[num_f // 2, :3, 3] - poses[0, :3, 3])
        held = np.linalg.norm(solved.world_T_rigs[num_f // 2, :3, 3] - poses[0, :3, 3])
        return np.concatenate([found.ravel() / SIGMA, [1e5 * (scale - held)]])

    pattern = lil_matrix((2 * len(used) + 1, 6 * (num_f - 1) + 3 * num_j + 3), dtype=int)
    for o, (f, j) in enumerate(zip(used.frames, used.points, strict=True)):
        if f:
            pattern[2 * o : 2 * o + 2, 6 * (f - 1) : 6 * f] = 1
        start = 6 * (num_f - 1) + 3 * j
        pattern[2 * o : 2 * o + 2, start : start + 3] = 1
        pattern[2 * o : 2 * o + 2, -3:] = 1
    pattern[-1, 6 * (num_f // 2 - 1) : 6 * (num_f // 2)] = 1
    start = np.concatenate([np.zeros(6 * (num_f - 1) + 3 * num_j), lenses.centre])
    there = least_squares(residuals, start, jac_sparsity=pattern, x_scale="jac", method="trf").x
    np.testing.assert_allclose(lenses.centre, there[-3:], atol=2e-4)
