"""The block of known points against differences, and fits of poses and cameras to exact scenes."""

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import unit

from factors import RobustLoss
from gsba.bundle.pose_variables import X
from gsba.camera.projections import PerspectiveProjection
from gsba.geometry import pose
from gsba.localization.known_points import (
    COARSE,
    FINE,
    CameraPrior,
    K,
    KnownPointBlock,
    PointSightings,
    fit,
    isotropic,
    residuals_of,
)

CAMERA = PerspectiveProjection(800, 600, 500.0, (410.0, 295.0), (0.05, -0.01))


def test_derivatives_of_a_panoramas_residuals_agree_with_differences() -> None:
    seen, world_T_rig = _panorama(np.random.default_rng(1), 30, 1e-2)
    seen = PointSightings(
        seen.points_world,
        seen.covariances,
        seen.measured,
        seen.spreads,
        np.random.default_rng(2).normal(0, 0.02, (30, 3)),
    )
    found = residuals_of(seen, world_T_rig, None)
    for axis in range(6):
        ends = [
            residuals_of(seen, _moved(world_T_rig, sign * 1e-6, axis), None).values
            for sign in (1, -1)
        ]
        numerical = (ends[0] - ends[1]) / 2e-6
        np.testing.assert_allclose(found.by_pose[:, :, axis], numerical, atol=1e-7)


def test_derivatives_of_a_photos_residuals_agree_with_differences() -> None:
    seen, world_T_rig = _photo(np.random.default_rng(3), 30, 0.5)
    found = residuals_of(seen, world_T_rig, CAMERA)
    for axis in range(6):
        ends = [
            residuals_of(seen, _moved(world_T_rig, sign * 1e-6, axis), CAMERA).values
            for sign in (1, -1)
        ]
        numerical = (ends[0] - ends[1]) / 2e-6
        np.testing.assert_allclose(found.by_pose[:, :, axis], numerical, atol=1e-3)
    for k in range(5):
        step = 1e-6 * np.eye(5)[k]
        ends = [residuals_of(seen, world_T_rig, CAMERA.stepped(s * step)).values for s in (1, -1)]
        numerical = (ends[0] - ends[1]) / 2e-6
        np.testing.assert_allclose(found.by_camera[:, :, k], numerical, atol=1e-3)


def test_the_blocks_model_predicts_its_cost_for_small_steps() -> None:
    seen, world_T_rig = _photo(np.random.default_rng(4), 40, 0.5)
    block = KnownPointBlock([seen], [CAMERA], RobustLoss("none", 1.0))
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3(_moved(world_T_rig, 1e-3, 4)))
    values.insert(K(0), np.array([1e-3, 0, 0, 1e-3, 0]))
    block.refresh(values)
    model, cost = block.linearize(values), block.costs(values)["known_points"]
    step = 1e-5 * np.random.default_rng(5).normal(size=(2, 6))
    step[1, 5] = 0
    trial = gtsam.Values()
    trial.insert(X(0), values.atPose3(X(0)).retract(step[0]))
    trial.insert(K(0), values.atVector(K(0)) + step[1, :5])
    linear = np.einsum("fi,fi->", model.gradient, step)
    square = np.einsum("fi,fij,fj->", step, model.diagonal, step) / 2
    square += step[0] @ model.off_diagonal[0] @ step[1]
    assert block.propose(trial, step) - cost == pytest.approx(linear + square, rel=1e-2)


def test_a_panorama_is_fitted_despite_outliers_with_a_fair_covariance() -> None:
    squares = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        seen, world_T_rig = _panorama(rng, 200, 1e-3)
        wrong = rng.permutation(200)[:60]
        bearings = seen.measured.copy()
        bearings[wrong] = unit(rng.normal(size=(60, 3)))
        seen = PointSightings(seen.points_world, seen.covariances, bearings, seen.spreads)
        start = _moved(_moved(world_T_rig, 0.01, 1), 0.05, 3)
        start = fit([seen], start[None], COARSE).world_T_rigs
        found = fit([seen], start, FINE)
        error = gtsam.Pose3(found.world_T_rigs[0]).localCoordinates(gtsam.Pose3(world_T_rig))
        assert not found.inliers[0][wrong].all()
        squares.append(error @ np.linalg.solve(found.covariances[0], error))
    assert 4 < np.mean(squares) < 9  # six degrees of freedom, with a mean's spread of .6


def test_photos_of_one_camera_share_its_focal_length() -> None:
    rng = np.random.default_rng(7)
    pairs = [_photo(rng, 150, 0.3) for _ in range(4)]
    plain = PerspectiveProjection(800, 600, 530.0, (400.0, 300.0), (0.0, 0.0))
    priors = [CameraPrior(np.zeros(5), np.array([0.3, 0.02, 0.02, 0.1, 0.05]))]
    starts = np.array([_moved(world_T_rig, 0.01, 4) for _, world_T_rig in pairs])
    pictures = [seen for seen, _ in pairs]
    starts = fit(pictures, starts, COARSE, [plain], priors).world_T_rigs
    found = fit(pictures, starts, FINE, [plain], priors)
    projection = found.projections[0]
    assert isinstance(projection, PerspectiveProjection)
    assert projection.focal == pytest.approx(CAMERA.focal, rel=1e-3)
    np.testing.assert_allclose(projection.principal, CAMERA.principal, atol=1.0)
    np.testing.assert_allclose(projection.radial, CAMERA.radial, atol=0.01)
    sigma = np.sqrt(found.camera_covariances[0][0, 0])
    assert abs(np.log(projection.focal / CAMERA.focal)) < 4 * sigma < 4e-3


def test_uncertain_points_count_less() -> None:
    rng = np.random.default_rng(8)
    seen, world_T_rig = _panorama(rng, 100, 1e-4)
    points, covariances = seen.points_world.copy(), seen.covariances.copy()
    points[:50] += rng.normal(0, 0.2, (50, 3))
    covariances[:50] = 0.04 * np.eye(3)
    blurred = PointSightings(points, covariances, seen.measured, seen.spreads)
    found = fit([blurred], world_T_rig[None], FINE)
    assert np.linalg.norm(found.world_T_rigs[0][:3, 3] - world_T_rig[:3, 3]) < 2e-3


def _panorama(
    rng: np.random.Generator, num: int, sigma: float
) -> tuple[PointSightings, np.ndarray]:
    """Sightings of points around a panorama, and its pose."""
    world_T_rig = pose(Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.normal(size=3))
    bearings, distances = unit(rng.normal(size=(num, 3))), rng.uniform(1, 8, (num, 1))
    points = (bearings * distances) @ world_T_rig[:3, :3].T + world_T_rig[:3, 3]
    noisy = unit(bearings + rng.normal(0, sigma, (num, 3)))
    return PointSightings(
        points, np.zeros((num, 3, 3)), noisy, isotropic(np.full(num, sigma))
    ), world_T_rig


def _photo(
    rng: np.random.Generator, num: int, sigma_px: float
) -> tuple[PointSightings, np.ndarray]:
    """Sightings of points in a photo by CAMERA, and its pose."""
    world_T_rig = pose(Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.normal(size=3))
    pixels = rng.uniform([0, 0], [800, 600], (num, 2))
    local = CAMERA.unproject(pixels) * rng.uniform(1, 8, (num, 1))
    points = local @ world_T_rig[:3, :3].T + world_T_rig[:3, 3]
    noisy = pixels + rng.normal(0, sigma_px, (num, 2))
    spreads = isotropic(np.full(num, sigma_px))
    return PointSightings(points, np.zeros((num, 3, 3)), noisy, spreads, camera=0), world_T_rig


def _moved(world_T_rig: np.ndarray, by: float, axis: int) -> np.ndarray:
    """A pose moved along one axis of its tangent."""
    return gtsam.Pose3(world_T_rig).retract(by * np.eye(6)[axis]).matrix()
