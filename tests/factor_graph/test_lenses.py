"""Rays that start beside the rig's centre: Jacobians, and cameras of their own beside them."""

import gtsam
import numpy as np
import pytest
from dense_system import dense
from gtsam.symbol_shorthand import C, L, X

from factors import (
    BearingTerm,
    FaceCameras,
    LandmarkBlock,
    LensBearingFactor,
    ReprojectionTerm,
    RobustLoss,
    jacobian_errors,
)

UNIT = gtsam.noiseModel.Unit.Create(2)
FRAMES, POINTS = 4, 12
CENTRES = np.array([[0.02, -0.05, 0.3], [-0.03, 0.04, -0.25]])  # of two lenses
CAMERAS = FaceCameras(np.eye(3)[None], np.array([100.0]), np.array([[50.0, 50.0]]))


@pytest.mark.parametrize("bearing", [[0, 0, 1], [1e-9, 0.1, -1], [0, -1, 0], [0.3, -0.5, 0.2]])
@pytest.mark.parametrize("depth", [0.6, 4.0, 1e4])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_jacobians_by_pose_point_and_lens(bearing: list[float], depth: float, sign: float) -> None:
    rng = np.random.default_rng(0)
    direction = np.array(bearing) / np.linalg.norm(bearing)
    values, pose = gtsam.Values(), gtsam.Pose3.Expmap(rng.normal(size=6))
    values.insert(X(0), pose)
    values.insert(L(0), pose.transformFrom(depth * direction + 0.02 * rng.normal(size=3)))
    values.insert(C(0), CENTRES[0])
    factor = LensBearingFactor(X(0), L(0), C(0), direction, UNIT, sign)
    errors = jacobian_errors(factor, values)
    # differences are taken over 1e-5 units: at depth 0.6 that is 3e-5 rad of angle
    assert len(errors) == 3 and max(errors.values()) < 1e-6


def _blocks(families: tuple[str, ...]) -> tuple[LandmarkBlock, LandmarkBlock, gtsam.Values]:
    """Frames of two lenses each, as rays beside their centres, and as cameras of their own."""
    rng = np.random.default_rng(1)
    points, values = rng.normal(size=(POINTS, 3)), gtsam.Values()
    frames, which = np.divmod(np.arange(2 * FRAMES * POINTS), 2 * POINTS)
    lenses, which = np.divmod(which, POINTS)
    for f in range(FRAMES):
        pose = gtsam.Pose3(gtsam.Rot3.Expmap(0.2 * rng.normal(size=3)), [0.3 * f, 0, -4.0])
        values.insert(X(f), pose)
        for n, centre in enumerate(CENTRES):
            values.insert(C(2 * f + n), pose.compose(gtsam.Pose3(gtsam.Rot3(), centre)))
    bearings = rng.normal(0, 0.02, (len(which), 3))
    for row, (f, n, j) in enumerate(zip(frames, lenses, which, strict=True)):
        bearings[row] += values.atPose3(C(2 * int(f) + int(n))).transformTo(points[j])
    pixels = 100 * bearings[:, :2] / bearings[:, 2:] + 50
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    faces = np.zeros(len(which), np.int64)

    def terms(rows: np.ndarray, origins: np.ndarray | None) -> list:
        return [
            BearingTerm(rows, which, bearings, 0.02, origins_rig=origins)
            if family == "bearing"
            else ReprojectionTerm(rows, which, pixels, faces, CAMERAS, 2.0, origins_rig=origins)
            for family in families
        ]

    loss, start = RobustLoss("cauchy", 1.5), points + 0.1 * rng.normal(size=points.shape)
    beside = LandmarkBlock(
        [X(f) for f in range(FRAMES)], start, terms(frames, CENTRES[lenses]), loss, 1
    )
    own = [C(n) for n in range(2 * FRAMES)]
    return beside, LandmarkBlock(own, start, terms(2 * frames + lenses, None), loss, 1), values


@pytest.mark.parametrize("families", [("bearing",), ("reprojection",), ("bearing", "reprojection")])
def test_a_lens_beside_the_centre_is_a_camera_of_its_own(families: tuple[str, ...]) -> None:
    """The two systems are one, carried from the cameras to the rig by their adjoints."""
    beside, own, values = _blocks(families)
    assert beside.polish(values) == pytest.approx(own.polish(values), rel=1e-9)
    np.testing.assert_allclose(beside.points_world, own.points_world, atol=1e-7)
    H, gradient = dense(beside.linearize(values), beside.pairs)
    of_own, own_gradient = dense(own.linearize(values), own.pairs)
    carry = np.zeros((12 * FRAMES, 6 * FRAMES))
    for n in range(2 * FRAMES):
        lens_T_rig = gtsam.Pose3(gtsam.Rot3(), -CENTRES[n % 2])
        f = n // 2
        carry[6 * n : 6 * n + 6, 6 * f : 6 * f + 6] = lens_T_rig.AdjointMap()
    scale = np.abs(H).max()
    np.testing.assert_allclose(H, carry.T @ of_own @ carry, atol=1e-6 * scale)
    np.testing.assert_allclose(gradient, carry.T @ own_gradient, atol=1e-5 * np.sqrt(scale))


def test_origins_that_are_no_places_are_refused() -> None:
    rows, bearings = np.zeros(2, np.int64), np.tile([0.0, 0, 1], (2, 1))
    for origins in (np.zeros((1, 3)), np.full((2, 3), np.nan)):
        term = BearingTerm(rows, rows, bearings, origins_rig=origins)
        with pytest.raises(ValueError, match="origins must be finite"):
            LandmarkBlock([X(0)], np.ones((1, 3)), [term])
