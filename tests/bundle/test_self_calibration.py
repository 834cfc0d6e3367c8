"""What raw lenses are, found from a map: with their centre, and only where it predicts."""

from dataclasses import replace

import numpy as np
import pytest
from lens_world import placed, problem_of, seen_through, solved_under, solved_with, times
from synthetic import unit

from factors.bearing import bearing_residuals
from gsba.bundle import self_calibration
from gsba.bundle.camera_adjustment import CameraSystem
from gsba.bundle.readout import CameraEstimate, CameraEstimates
from gsba.bundle.self_calibration import SelfCalibration, num_parameters
from gsba.bundle.shared_parameters import ObservedRays
from gsba.camera.fisheye import Pair, Rig, changed, recalibrated
from gsba.camera.lens import Lenses
from gsba.types import Fisheye, Solution

CENTRE = np.array([0.004, -0.003, 0.05])
TRUE: Pair = (
    Fisheye(960, 960, 292.0, (481.0, 479.0), (-0.025, 0.0018, 0.0, 0.0), (0.01, 0.0, 1.5)),
    Fisheye(960, 960, 293.0, (478.0, 482.0), (-0.024, 0.0015, 0.0, 0.0), (0.0, 3.1, 0.02)),
)
OFF = np.array([-0.015, 0.006, -0.004, 0.01, 0.0, 0.0, 0.0, 0.004, -0.006, 0.005])
FRONT_OFF = np.concatenate([OFF[:7], np.zeros(3)])  # its turn is one of the rig
CUT: Pair = (changed(TRUE[0], FRONT_OFF), changed(TRUE[1], OFF))


def _estimated(
    reference_calibration: Pair, seed: int, rounds: int
) -> tuple[SelfCalibration, Solution]:
    world, shown = seen_through(
        Lenses(CENTRE, reference_calibration=reference_calibration, fisheyes=TRUE), seed
    )
    solved, lenses = (
        Solution.without_points(world.world_T_rigs),
        Lenses(CENTRE, reference_calibration=reference_calibration),
    )
    problem = problem_of(world)
    for _ in range(rounds):
        solved, keypoints, tracks = solved_under(world, shown, lenses, solved)
        around = replace(solved, landmarks=placed(solved, keypoints, tracks))
        given = around, keypoints, problem, lenses, shown.bearings_rig
        found = self_calibration.estimate(ObservedRays(*given))
        lenses = found.lenses
    return found, solved


def _off_deg(pair: Rig | None) -> float:
    """How far directions of pixels are from the true ones, rms over the sphere."""
    assert pair is not None
    off = self_calibration.apart(
        Lenses(reference_calibration=pair), Lenses(reference_calibration=pair, fisheyes=TRUE)
    )
    return float(np.rad2deg(off))


@pytest.mark.parametrize("seed", [0, 1])
def test_lenses_are_found_from_a_calibration_that_is_off(seed: int) -> None:
    found, _ = _estimated(CUT, seed, rounds=4)
    assert not found.reason
    assert _off_deg(CUT) > 0.5
    assert _off_deg(found.lenses.fisheyes) < 0.03


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_noise_makes_no_lens_longer(seed: int) -> None:
    """Angles of residuals shrink where focal lengths grow: that must not count as a gain."""
    world, shown = seen_through(Lenses(CENTRE, reference_calibration=TRUE, fisheyes=TRUE), seed)
    solved, lenses = (
        Solution.without_points(world.world_T_rigs),
        Lenses(CENTRE, reference_calibration=TRUE),
    )
    problem = problem_of(world)
    solved, keypoints, tracks = solved_under(world, shown, lenses, solved)
    around = replace(solved, landmarks=placed(solved, keypoints, tracks))
    given = around, keypoints, problem, lenses, shown.bearings_rig
    found = self_calibration.estimate(ObservedRays(*given), nominal=True)
    assert not found.reason
    assert _off_deg(found.lenses.fisheyes) < 0.05


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_lenses_that_are_known_are_left_as_they_are(seed: int) -> None:
    found, _ = _estimated(TRUE, seed, rounds=1)
    assert found.reason
    assert found.lenses.fisheyes is None


def test_the_graph_settles_lenses_beside_poses_and_says_how_well() -> None:
    world, shown = seen_through(Lenses(CENTRE, reference_calibration=CUT, fisheyes=TRUE))
    solved, problem = Solution.without_points(world.world_T_rigs), problem_of(world)
    near = self_calibration.moved(Lenses(CENTRE, reference_calibration=CUT), _step_to(TRUE, 0.7))
    seeing = CameraEstimate(near)
    solved, seeing = solved_with(world, shown, seeing, solved, problem)
    assert _off_deg(seeing.lenses.fisheyes) < 0.03
    system = CameraSystem(solved, shown, CameraEstimates((seeing,)), times(24), problem)
    sigmas = system.covariances().cameras[0].lens_sigmas
    off = self_calibration.from_calibrated(seeing.lenses) - _step_to(TRUE, 1.0)
    assert np.abs(off[[0, 7]] / sigmas[[0, 7]]).max() < 4
    assert np.all(sigmas < self_calibration.spread(2))


def _step_to(pair: Pair, share: float) -> np.ndarray:
    """Part of the way (K,) from what panoramas are cut by."""
    return share * self_calibration.from_calibrated(
        Lenses(reference_calibration=CUT, fisheyes=pair)
    )


def test_residuals_change_with_lenses_as_their_jacobian_says() -> None:
    rng = np.random.default_rng(0)
    shown = unit(rng.normal(size=(40, 3)))
    lenses = Lenses(CENTRE, reference_calibration=CUT, fisheyes=TRUE)
    frames = np.zeros(40, int)
    bearings, origins = lenses.rays(shown, frames)
    points = origins + 3 * bearings

    def residuals(step: np.ndarray) -> np.ndarray:
        rays = self_calibration.moved(lenses, step).rays(shown, frames)
        return bearing_residuals(np.tile(np.eye(4), (40, 1, 1)), points, *rays)[0]

    found = self_calibration.by_lenses(bearings, shown, lenses)
    for k in range(num_parameters(2)):
        step = np.zeros(num_parameters(2))
        step[k] = 1e-6
        slope = (residuals(step) - residuals(-step)) / 2e-6
        np.testing.assert_allclose(found[:, :, k], slope, atol=1e-5 * np.abs(slope).max())


def test_lenses_take_rays_where_they_point_and_points_back_where_they_are_shown() -> None:
    rng = np.random.default_rng(1)
    shown = unit(rng.normal(size=(200, 3)))
    shown = shown[np.abs(shown[:, 2]) > 0.05]
    lenses = Lenses(CENTRE, reference_calibration=CUT, fisheyes=TRUE)
    frames = np.zeros(len(shown), int)
    bearings, origins = lenses.rays(shown, frames)
    np.testing.assert_allclose(bearings, recalibrated(shown, CUT, TRUE), atol=1e-12)
    back = lenses.seeing(origins + 4 * bearings, frames)
    np.testing.assert_allclose(back / np.linalg.norm(back, axis=1)[:, None], shown, atol=1e-9)
    assert not Lenses(reference_calibration=CUT)
    assert lenses.cut_anew().reference_calibration == TRUE
