"""Projections: there and back, Jacobians against differences, and against OpenCV."""

import cv2
import numpy as np
import pytest

from gsba.camera.projections import (
    FisheyeProjection,
    PerspectiveProjection,
    RadialProjection,
    projection_of_model,
)

# with the largest angle from the axis, degrees
LENSES: dict[str, tuple[RadialProjection, float]] = {
    "equidistant": (FisheyeProjection(400, 380, 120.0, (201.0, 188.0)), 110),
    "fisheye": (
        FisheyeProjection(400, 380, 120.0, (201.0, 188.0), (-0.03, 0.004, -0.0006, 0.00004)),
        110,
    ),
    "perspective": (PerspectiveProjection(640, 480, 400.0, (322.0, 238.0), (-0.1, 0.02)), 50),
    "pinhole": (PerspectiveProjection(640, 480, 400.0, (322.0, 238.0)), 80),
}
OF_EACH = pytest.mark.parametrize(("lens", "furthest"), LENSES.values(), ids=LENSES)


def _directions(furthest_deg: float, least: float = 0.0, num: int = 300) -> np.ndarray:
    """Unit directions (N, 3) within an angle of the axis; the axis is the first one."""
    rng = np.random.default_rng(1)
    angles = np.deg2rad(furthest_deg) * np.sqrt(rng.uniform(least, 1, num))
    angles[0] = np.deg2rad(furthest_deg) * np.sqrt(least)
    around = rng.uniform(0, 2 * np.pi, num)
    sines = np.sin(angles)
    return np.stack([sines * np.cos(around), sines * np.sin(around), np.cos(angles)], axis=1)


@OF_EACH
def test_there_and_back(lens: RadialProjection, furthest: float) -> None:
    directions = _directions(furthest)
    pixels = lens.project(2.5 * directions)
    np.testing.assert_allclose(lens.unproject(pixels), directions, atol=1e-9)
    shaped = pixels.reshape(20, 15, 2)
    np.testing.assert_allclose(lens.project(lens.unproject(shaped)), shaped, atol=1e-7)


@OF_EACH
def test_jacobians_are_those_of_differences(lens: RadialProjection, furthest: float) -> None:
    vectors = 1.7 * _directions(min(furthest, 170))
    by_vector, by_parameters = lens.jacobians(vectors)
    for i in range(3):
        aside = 1e-6 * np.eye(3)[i]
        slope = (lens.project(vectors + aside) - lens.project(vectors - aside)) / 2e-6
        np.testing.assert_allclose(by_vector[:, :, i], slope, atol=1e-5 * lens.width)
    num = lens.num_parameters
    assert by_parameters.shape == (len(vectors), 2, num)
    for i in range(num):
        step = 1e-6 * np.eye(num)[i]
        moved = [lens.stepped(sign * step).project(vectors) for sign in (1, -1)]
        slope = (moved[0] - moved[1]) / 2e-6
        size = max(1.0, float(np.abs(slope).max()))
        np.testing.assert_allclose(by_parameters[:, :, i], slope, atol=1e-6 * size)


def test_a_perspective_lens_is_that_of_opencv() -> None:
    lens, furthest = LENSES["perspective"]
    assert isinstance(lens, PerspectiveProjection)
    directions = _directions(furthest)
    camera = np.diag([lens.focal, lens.focal, 1.0])
    camera[:2, 2] = lens.principal
    bent = np.array([*lens.radial, 0.0, 0.0])
    expected, _ = cv2.projectPoints(directions[:, None], np.zeros(3), np.zeros(3), camera, bent)
    np.testing.assert_allclose(lens.project(directions), expected[:, 0], atol=1e-9)
    assert np.isnan(lens.project(np.array([[0.1, 0.0, -1.0]]))).all()


def test_pixels_that_no_direction_reaches_get_one_anyway() -> None:
    """The radius of this estimate, of a cropped photo, turns back 243 pixels from its middle."""
    lens = PerspectiveProjection(500, 400, 72.5, (250.0, 200.0), (0.0233, -0.0022))
    pixels = np.stack(np.meshgrid(np.arange(0.5, 500), np.arange(0.5, 400)), axis=-1)
    directions = lens.unproject(pixels)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0, atol=1e-12)


def test_calibrations_name_known_projections() -> None:
    assert projection_of_model("Kannala-Brandt: r = f (th + ...)") is FisheyeProjection
    with pytest.raises(ValueError, match="'wavy', which is none of kannala-brandt"):
        projection_of_model("wavy")
