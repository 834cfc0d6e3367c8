"""Poses from bearings of known points: derivatives, exact recovery, and what chance explains."""

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factors import tangent_basis
from gsba.geometry import inverse, pose, rotation_angle, unit
from gsba.odometry.resection import linearised, resect

SIGMA = np.deg2rad(0.1)


def _scene(num: int = 300, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, their exact bearings, and the pose that they are seen from."""
    rng = np.random.default_rng(seed)
    points = 3 * unit(rng.normal(size=(num, 3))) * rng.uniform(0.5, 2, (num, 1))
    world_T_rig = pose(Rotation.from_rotvec([0.3, -2.0, 0.7]).as_matrix(), np.array([0.4, 0.1, -1]))
    offsets = (points - world_T_rig[:3, 3]) @ world_T_rig[:3, :3]
    return points, unit(offsets), world_T_rig


def test_jacobians_are_those_of_the_residuals() -> None:
    points, bearings, world_T_rig = _scene()
    seen = unit(bearings + np.random.default_rng(1).normal(size=bearings.shape) * 0.2)
    bases, step, at = tangent_basis(seen), 1e-6, gtsam.Pose3(world_T_rig)
    _, jacobians, _ = linearised(points, bases, seen, world_T_rig)
    for k, tangent in enumerate(step * np.eye(6)):
        ahead = linearised(points, bases, seen, at.retract(tangent).matrix())[0]
        behind = linearised(points, bases, seen, at.retract(-tangent).matrix())[0]
        np.testing.assert_allclose((ahead - behind) / (2 * step), jacobians[:, :, k], atol=1e-8)


def test_exact_bearings_give_the_exact_pose_despite_outliers() -> None:
    points, bearings, truth = _scene()
    bearings[:120] = unit(np.random.default_rng(2).normal(size=(120, 3)))
    start = gtsam.Pose3(truth).retract([0.03, -0.02, 0.05, 0.1, -0.1, 0.05]).matrix()
    found = resect(points, bearings, start, SIGMA)
    off = inverse(truth) @ found.world_T_rig
    assert rotation_angle(off[:3, :3]) < 1e-6
    assert np.linalg.norm(off[:3, 3]) < 1e-6
    assert found.significant and found.inliers[120:].all()


def test_noise_is_found_and_the_covariance_covers_the_error() -> None:
    errors = []
    for seed in range(20):
        points, bearings, truth = _scene(seed=seed)
        rng = np.random.default_rng(100 + seed)
        noisy = unit(bearings + rng.normal(size=bearings.shape) * SIGMA)
        found = resect(points, noisy, truth, SIGMA)
        tangent = _tangent(inverse(truth) @ found.world_T_rig)
        errors.append(tangent @ np.linalg.solve(found.covariance, tangent))
        assert found.noise == pytest.approx(SIGMA, rel=0.3)
    assert 2 < np.median(errors) < 14  # of chi-square with six degrees of freedom: 5.3


def test_bearings_without_order_are_not_significant() -> None:
    points, bearings, truth = _scene()
    found = resect(points, unit(np.random.default_rng(3).normal(size=bearings.shape)), truth, SIGMA)
    assert not found.significant


def test_few_points_in_one_direction_are_not_significant() -> None:
    points, bearings, truth = _scene(num=3000)
    near = np.flatnonzero(bearings[:, 2] > np.cos(np.deg2rad(6)))
    found = resect(points[near], bearings[near], truth, SIGMA)
    assert len(near) and not found.significant


def test_no_points_leave_the_start_as_it_is() -> None:
    found = resect(np.zeros((0, 3)), np.zeros((0, 3)), np.eye(4), SIGMA)
    np.testing.assert_array_equal(found.world_T_rig, np.eye(4))
    assert not found.significant


def _tangent(a_T_b: np.ndarray) -> np.ndarray:
    return np.concatenate([Rotation.from_matrix(a_T_b[:3, :3]).as_rotvec(), a_T_b[:3, 3]])
