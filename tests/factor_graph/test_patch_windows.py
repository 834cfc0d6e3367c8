"""Windows of panoramas: the coded spline over seam and poles, its gradient, halved images."""

import numpy as np
import pytest
from photometric_world import CodedImage, Texture, render
from synthetic import unit

from factors.patch_windows import pixels_of
from factors.sphere_image import SphereImage
from gsba.camera.sphere import bearings_from_erp, erp_from_bearings
from gsba.photometric.patches import halved

WIDTH = 256
TEXTURE = Texture(np.random.default_rng(3), 12.0)
GREY = render(np.eye(4), TEXTURE, WIDTH)
FITTED = SphereImage.of(GREY)
IMAGE = CodedImage(FITTED)


def _around(bearing: np.ndarray, num: int = 200, spread: float = 0.05) -> np.ndarray:
    """Unit vectors, the same whatever test ran before."""
    return unit(bearing + spread * np.random.default_rng(4).normal(size=(num, 3)))


@pytest.mark.parametrize(
    "towards",
    [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0, 1, 0), (0, -1, 0), (0.02, 1, -0.01)],
    ids=["centre", "seam", "right", "down", "up", "near the pole"],
)
def test_coded_images_are_sampled_like_others(towards: tuple[float, ...]) -> None:
    bearings = _around(np.array(towards, dtype=float))
    values, gradients = IMAGE.sample(bearings)
    expected, slopes = FITTED.sample(bearings)
    # half a step of the coefficients' fixed point, 1/56 grey, bounds the error
    assert np.abs(values - expected).max() < 0.02
    # slopes of a basis add up to at most 2 per pixel and axis; longitude stretches at the poles
    flat = np.hypot(bearings[:, 0], bearings[:, 2])[:, None]
    assert (np.abs(gradients - slopes) * flat).max() < 2 * 0.02 * WIDTH / (2 * np.pi) * 1.5
    # the texture's finest wave spans 21 pixels; at the pole rows of the panorama bend sharply
    assert np.abs(values - TEXTURE(4 * bearings)).max() < 0.5


def test_no_direction_has_no_value() -> None:
    values, gradients = IMAGE.sample(np.zeros((1, 3)))
    assert np.isnan(values[0]) and not gradients.any()
    values, gradients = IMAGE.sample(np.array([[0.0, 1.0, 0.0], [0.0, -2.0, 0.0]]))
    assert np.isfinite(values).all() and np.isfinite(gradients).all()


def test_halving_keeps_bearings() -> None:
    half = SphereImage.of(halved(GREY))
    assert half.coefficients.shape == (WIDTH // 4, WIDTH // 2)
    for towards in np.concatenate([np.eye(3), -np.eye(3)]):
        bearings = _around(towards)
        # the low-pass takes a little off the waves; a shift of half a pixel would cost 10
        assert np.abs(half.sample(bearings)[0] - TEXTURE(4 * bearings)).mean() < 1.0


def test_pixels_agree_with_the_rest_of_the_package() -> None:
    bearings = unit(np.random.default_rng(5).normal(size=(50, 3)))
    assert np.allclose(pixels_of(bearings, WIDTH), erp_from_bearings(bearings, WIDTH, WIDTH // 2))


def test_extremes_fit_the_fixed_point() -> None:
    chequered = 255.0 * (np.indices((64, 128)).sum(axis=0) % 2)
    v, u = np.mgrid[8:56, 0:128] + 0.5
    bearings = bearings_from_erp(np.stack([u, v], axis=-1), 128, 64)
    values, _ = CodedImage(SphereImage.of(chequered)).sample(bearings)
    assert np.abs(values - chequered[8:56]).max() < 0.05


def test_values_that_are_not_finite_are_refused() -> None:
    with pytest.raises(ValueError, match="finite"):
        CodedImage(SphereImage.of(np.full((4, 8), np.nan)))
