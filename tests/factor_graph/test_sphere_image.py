"""Sampling a panorama on the sphere: against closed forms, over the seam and the poles."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates, spline_filter
from synthetic import unit

from factors.sphere_image import SphereImage
from gsba.camera.sphere import bearings_from_erp, erp_directions

HEIGHT = 64
WIDTH = 2 * HEIGHT
DIRECTION = np.array([0.6, -0.48, 0.64])


def _smooth(bearings: np.ndarray) -> np.ndarray:
    """A function without any border on the sphere."""
    x, y, z = np.moveaxis(bearings, -1, 0)
    return 100 + 50 * x * y + 30 * np.sin(3 * z) + 40 * bearings @ DIRECTION


def _places() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    near = 0.05 * rng.normal(size=(200, 3))
    places = {"anywhere": unit(rng.normal(size=(500, 3)))}
    for name, axis in {"seam": [0, 0, -1], "top": [0, -1, 0], "bottom": [0, 1, 0]}.items():
        places[name] = near + axis
    return places


@pytest.mark.parametrize("place", _places())
def test_follows_a_smooth_function(place: str) -> None:
    vectors = _places()[place]
    image = SphereImage.of(_smooth(erp_directions(WIDTH)))
    values, _ = image.sample(vectors)
    # An order-4 spline: (2 pi / 128)^4 of the fourth derivative, here up to about 3000.
    np.testing.assert_allclose(values, _smooth(unit(vectors)), atol=2e-2)


def test_passes_through_pixels() -> None:
    pixels = np.random.default_rng(1).uniform(0, 255, (HEIGHT, WIDTH))
    values, _ = SphereImage.of(pixels).sample(erp_directions(WIDTH))
    np.testing.assert_allclose(values, pixels, atol=2e-3)  # float32 coefficients


def test_is_the_spline_of_scipy_away_from_borders() -> None:
    pixels = np.random.default_rng(2).uniform(0, 255, (HEIGHT, WIDTH))
    rng = np.random.default_rng(3)
    u, v = rng.uniform(30, WIDTH - 30, 300), rng.uniform(25, HEIGHT - 25, 300)
    bearings = bearings_from_erp(np.column_stack([u, v]), WIDTH, HEIGHT)
    coefficients = spline_filter(pixels, order=3)
    expected = map_coordinates(coefficients, [v - 0.5, u - 0.5], order=3, prefilter=False)
    np.testing.assert_allclose(SphereImage.of(pixels).sample(bearings)[0], expected, atol=2e-3)


def test_turning_the_panorama_changes_nothing_but_longitude() -> None:
    pixels = np.random.default_rng(4).uniform(0, 255, (HEIGHT, WIDTH))
    shift = 37
    turned = SphereImage.of(np.roll(pixels, shift, axis=1))
    bearings = unit(np.random.default_rng(5).normal(size=(300, 3)))
    angle = 2 * np.pi * shift / WIDTH
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    np.testing.assert_allclose(
        turned.sample(bearings @ rotation.T)[0],
        SphereImage.of(pixels).sample(bearings)[0],
        atol=5e-3,
    )


@pytest.mark.parametrize("place", _places())
def test_gradient_is_the_derivative(place: str) -> None:
    image = SphereImage.of(_smooth(erp_directions(WIDTH)))
    vectors = _places()[place][:50]
    _, gradients = image.sample(vectors)
    step = 1e-3  # values carry float32 noise of about 1e-5
    for axis in np.eye(3):
        ahead, behind = (
            image.sample(vectors + step * axis)[0],
            image.sample(vectors - step * axis)[0],
        )
        np.testing.assert_allclose(gradients @ axis, (ahead - behind) / (2 * step), atol=0.15)


def test_gradient_lies_across_the_vector() -> None:
    vectors = 3.0 * unit(np.random.default_rng(6).normal(size=(100, 3)))
    _, gradients = SphereImage.of(_smooth(erp_directions(WIDTH))).sample(vectors)
    np.testing.assert_allclose(np.einsum("ni,ni->n", gradients, vectors), 0, atol=1e-9)


def test_the_poles_themselves_are_finite() -> None:
    values, gradients = SphereImage.of(_smooth(erp_directions(WIDTH))).sample(
        np.array([[0, 1.0, 0], [0, -1, 0]])
    )
    np.testing.assert_allclose(values, _smooth(np.array([[0, 1.0, 0], [0, -1, 0]])), atol=2e-2)
    assert np.isfinite(gradients).all()


def test_another_shape_is_refused() -> None:
    with pytest.raises(ValueError, match="panorama"):
        SphereImage.of(np.zeros((10, 30)))
