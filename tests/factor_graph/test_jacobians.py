"""Reference factors: Jacobians where they are hard, and GTSAM's own factors beside them."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X
from synthetic import unit

from factors import (
    BearingFactor,
    BearingTerm,
    FaceCameras,
    ReprojectionFactor,
    ReprojectionTerm,
    RobustLoss,
    bearing_residuals,
    jacobian_errors,
    reprojection_residuals,
    tangent_basis,
)
from factors._kernels import whitened_residual
from factors._observations import sort_observations
from factors.compiled import kernel_and_part

kernel, _ = kernel_and_part(fastmath={"contract"})


@kernel
def compiled_residual(obs, o, x, y, z):
    return whitened_residual(obs, o, x, y, z)


UNIT = gtsam.noiseModel.Unit.Create(2)
CAMERAS = FaceCameras(
    rig_R_faces=np.array([np.eye(3), gtsam.Rot3.Ry(np.pi / 2).matrix()]),
    focals=np.array([300.0, 250.0]),
    principals=np.array([[256.0, 256.0], [200.0, 210.0]]),
)
# Central differences of step 1e-5 on residuals of order one are good to about 1e-9.
TOLERANCE = 1e-7


def values_at(pose: gtsam.Pose3, point: np.ndarray) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(X(0), pose)
    values.insert(L(0), point)
    return values


def random_pose(rng) -> gtsam.Pose3:
    return gtsam.Pose3.Expmap(rng.normal(size=6))


def seen_from(pose: gtsam.Pose3, direction, depth: float) -> np.ndarray:
    """World point at a direction of the rig frame."""
    direction = np.asarray(direction, dtype=float)
    return pose.transformFrom(depth * direction / np.linalg.norm(direction))


BEARINGS = {
    "forward": [0, 0, 1],
    "seam": [1e-9, 0.1, -1],
    "other side of the seam": [-1e-9, 0.1, -1],
    "back": [0, 0, -1],
    "up": [0, -1, 0],
    "down": [0, 1, 0],
    "oblique": [0.3, -0.5, 0.2],
}


@pytest.mark.parametrize("bearing", BEARINGS.values(), ids=BEARINGS)
@pytest.mark.parametrize("error_rad", [0.0, 1e-6, 1e-3, 0.09, 0.11, 1.0, 2.5, 3.1])
def test_bearing_jacobians(bearing, error_rad):
    rng = np.random.default_rng(1)
    pose = random_pose(rng)
    bearing = np.asarray(bearing, dtype=float) / np.linalg.norm(bearing)
    axis = tangent_basis(bearing).T @ [np.cos(0.4), np.sin(0.4)]
    predicted = np.cos(error_rad) * bearing + np.sin(error_rad) * axis
    factor = BearingFactor(X(0), L(0), bearing, UNIT)
    errors = jacobian_errors(factor, values_at(pose, seen_from(pose, predicted, 3.0)))
    # near the antipode the residual turns on a circle of radius pi: curvature 1 / (pi - error)
    tolerance = TOLERANCE / max(np.pi - error_rad, 1e-3) ** 2
    assert max(errors.values()) < tolerance


def test_bearing_jacobians_at_random_states_and_depths():
    rng = np.random.default_rng(2)
    for depth in (0.05, 1.0, 1e4):  # the last: no parallax
        for _ in range(20):
            pose = random_pose(rng)
            bearing = rng.normal(size=3)
            bearing /= np.linalg.norm(bearing)
            point = seen_from(pose, bearing + 0.1 * rng.normal(size=3), depth)
            factor = BearingFactor(X(0), L(0), bearing, UNIT)
            # differences are taken over 1e-5 units: at depth 0.05 that is 2e-4 rad of angle
            assert max(jacobian_errors(factor, values_at(pose, point)).values()) < 1e-6


def test_bearing_residual_is_the_angle_all_the_way():
    bearing = np.array([[0.0, 0.0, 1.0]])
    for angle in (0.0, 1e-9, 1e-4, 0.0999, 0.1001, 1.0, 3.0, np.pi):
        point = np.array([[np.sin(angle), 0.0, np.cos(angle)]])
        residual, by_pose, by_point = bearing_residuals(np.eye(4)[None], point, bearing)
        assert np.linalg.norm(residual) == pytest.approx(angle, rel=1e-12, abs=1e-15)
        assert np.isfinite(by_pose).all() and np.isfinite(by_point).all()


def test_bearing_at_the_centre_is_finite():
    results = bearing_residuals(np.eye(4)[None], np.zeros((1, 3)), np.array([[0.0, 1.0, 0.0]]))
    assert all(np.isfinite(array).all() for array in results)
    assert not results[1].any()


def test_reprojection_jacobians():
    rng = np.random.default_rng(4)
    for face in (0, 1):
        for _ in range(20):
            pose = random_pose(rng)
            local = np.array([*rng.uniform(-1, 1, 2), 1.0])
            point = seen_from(pose, CAMERAS.rig_R_faces[face] @ local, rng.uniform(0.5, 20))
            factor = ReprojectionFactor(X(0), L(0), np.array([10.0, 20]), face, CAMERAS, UNIT)
            # 1e-5 units at half a unit's depth and 45 degrees: third derivatives of 300 px
            assert max(jacobian_errors(factor, values_at(pose, point)).values()) < 1e-6


def test_reprojection_behind_the_face_pulls_nowhere():
    pose = gtsam.Pose3()
    factor = ReprojectionFactor(X(0), L(0), np.array([10.0, 20]), 0, CAMERAS, UNIT)
    for point in ([0.1, 0.2, -1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]):
        values = values_at(pose, np.array(point))
        jacobian, right = factor.linearize(values).jacobian()
        assert not jacobian.any()
        assert np.array_equal(right, [-600.0, -600.0])
    in_front = reprojection_residuals(
        np.eye(4)[None], np.array([[0.1, 0.2, -1.0]]), np.zeros((1, 2)), np.array([0]), CAMERAS
    )[3]
    assert not in_front.any()


@pytest.mark.parametrize("face", [0, 1])
def test_reprojection_agrees_with_gtsam(face):
    rng = np.random.default_rng(5)
    noise = gtsam.noiseModel.Isotropic.Sigma(2, 0.7)
    f, (u, v) = CAMERAS.focals[face], CAMERAS.principals[face]
    calibration = gtsam.Cal3_S2(f, f, 0, u, v)
    rig_T_face = gtsam.Pose3(gtsam.Rot3(CAMERAS.rig_R_faces[face]), np.zeros(3))
    for _ in range(50):
        values = values_at(
            random_pose(rng), 3 * rng.normal(size=3)
        )  # behind the face half the time
        pixel = rng.uniform(0, 512, 2)
        ours = ReprojectionFactor(X(0), L(0), pixel, face, CAMERAS, noise).error(values)
        native = gtsam.GenericProjectionFactorCal3_S2(
            pixel, noise, X(0), L(0), calibration, rig_T_face
        ).error(values)
        assert ours == pytest.approx(native, rel=1e-9)


def test_kernels_agree_with_the_vectorised_residuals():
    """Everywhere at once: poles, seam, series and arc tangent, antipode, behind a face."""
    rng = np.random.default_rng(8)
    bearings = unit(np.concatenate([rng.normal(size=(60, 3)), list(BEARINGS.values())]))
    angles = np.array([0.0, 1e-8, 1e-4, 0.03, 0.0999, 0.1001, 1.0, 2.0, 3.1, np.pi])
    bearings, angles = np.repeat(bearings, len(angles), axis=0), np.tile(angles, len(bearings))
    axes = tangent_basis(bearings)[:, 0]
    points = np.cos(angles)[:, None] * bearings + np.sin(angles)[:, None] * axes
    points *= rng.uniform(0.5, 20, (len(points), 1))
    points[0] = 0.0  # the centre
    num = len(points)
    pixels, faces = rng.uniform(0, 512, (num, 2)), rng.integers(0, 2, num)
    zeros, rows = np.zeros(num, dtype=int), np.arange(num)
    poses = np.tile(np.eye(4), (num, 1, 1))
    terms = [
        BearingTerm(zeros, rows, bearings, 0.5),
        ReprojectionTerm(zeros, rows, pixels, faces, CAMERAS, 2.0),
    ]
    obs, order, point_order = sort_observations(terms, 1, num, RobustLoss())
    wanted = [bearing_residuals(poses, points, bearings)]
    wanted.append(reprojection_residuals(poses, points, pixels, faces, CAMERAS)[:3])
    residuals = np.concatenate([2.0 * wanted[0][0], 0.5 * wanted[1][0]])
    jacobians = np.concatenate([2.0 * wanted[0][2], 0.5 * wanted[1][2]])
    for o, row in enumerate(order):
        got = compiled_residual(obs, o, *points[row % num])
        near_antipode = row < num and angles[row] > np.pi - 1e-9  # direction there is arbitrary
        if not near_antipode:
            assert np.allclose(got[1:3], residuals[row], rtol=1e-9, atol=1e-12)
            assert np.allclose(got[3:], jacobians[row].ravel(), rtol=1e-7, atol=1e-9)
        assert np.isfinite(got).all()
    assert np.array_equal(np.sort(point_order), rows)


def test_tangent_basis_is_orthonormal():
    bearings = np.random.default_rng(6).normal(size=(100, 3))
    bearings = unit(np.concatenate([bearings, np.eye(3), -np.eye(3)]))
    frame = np.concatenate([tangent_basis(bearings), bearings[:, None]], axis=1)
    product = np.einsum("nij,nkj->nik", frame, frame)
    assert np.allclose(product, np.eye(3), atol=1e-12)
    assert np.allclose(np.linalg.det(frame), 1)


def test_a_jacobian_that_is_no_number_does_not_pass():
    """Python's max() ignores NaN after a first number."""

    def error(_factor, _values, jacobians):
        if jacobians is not None:
            jacobians[0], jacobians[1] = np.zeros((1, 6)), np.full((1, 3), np.nan)
        return np.zeros(1)

    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3())
    values.insert(X(1), np.zeros(3))
    factor = gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [X(0), X(1)], error)
    assert not max(jacobian_errors(factor, values).values()) < 1e-6
