"""Sampling on the sphere: exact at pixels, smooth over seam and poles, with a true gradient."""

import numpy as np
import pytest
from photometric_world import Texture, render
from synthetic import unit

from factors.sphere_image import SphereImage, halved, pixels_of
from gsba.geometry import bearings_from_erp, erp_from_bearings

WIDTH = 256
RNG = np.random.default_rng(3)
TEXTURE = Texture(RNG, 12.0)
GREY = render(np.eye(4), TEXTURE, WIDTH)
IMAGE = SphereImage.of(GREY)


def _around(bearing: np.ndarray, num: int = 200, spread: float = 0.05) -> np.ndarray:
    return unit(bearing + spread * RNG.normal(size=(num, 3)))


def test_pixels_come_back() -> None:
    v, u = np.mgrid[0 : WIDTH // 2, 0:WIDTH] + 0.5
    bearings = bearings_from_erp(np.stack([u, v], axis=-1), WIDTH, WIDTH // 2)
    values, _ = IMAGE.sample(bearings)
    # half a step of each of the sixteen coefficients' fixed point, 1/56 grey, bounds the error
    assert np.abs(values - GREY).max() < 0.02


@pytest.mark.parametrize(
    "towards",
    [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0, 1, 0), (0, -1, 0), (0.02, 1, -0.01)],
    ids=["centre", "seam", "right", "down", "up", "near the pole"],
)
def test_smooth_texture_is_met_everywhere(towards: tuple[float, ...]) -> None:
    bearings = _around(np.array(towards, dtype=float))
    values, _ = IMAGE.sample(bearings)
    # the texture's finest wave spans 21 pixels; at the pole rows of the panorama bend sharply
    assert np.abs(values - TEXTURE(4 * bearings)).max() < 0.5


@pytest.mark.parametrize("towards", [(0, 0, 1), (0, 0, -1), (0.3, 1, 0.2), (0, -1, 0.1)])
def test_gradient_is_that_of_the_values(towards: tuple[float, ...]) -> None:
    vectors = 1.7 * _around(np.array(towards, dtype=float))
    _, gradients = IMAGE.sample(vectors)
    step = 1e-6
    for k, axis in enumerate(np.eye(3)):
        ahead, behind = (IMAGE.sample(vectors + s * step * axis)[0] for s in (1, -1))
        scale = np.abs(gradients).max()
        assert np.abs((ahead - behind) / (2 * step) - gradients[:, k]).max() < 1e-5 * scale
    assert np.abs(np.einsum("ni,ni->n", gradients, vectors)).max() < 1e-9 * np.abs(gradients).max()


def test_no_direction_has_no_value() -> None:
    values, gradients = IMAGE.sample(np.zeros((1, 3)))
    assert np.isnan(values[0]) and not gradients.any()
    values, gradients = IMAGE.sample(np.array([[0.0, 1.0, 0.0], [0.0, -2.0, 0.0]]))
    assert np.isfinite(values).all() and np.isfinite(gradients).all()


def test_halving_keeps_bearings() -> None:
    half = SphereImage.of(halved(GREY))
    assert half.width == WIDTH // 2
    for towards in np.concatenate([np.eye(3), -np.eye(3)]):
        bearings = _around(towards)
        # the low-pass takes a little off the waves; a shift of half a pixel would cost 10
        assert np.abs(half.sample(bearings)[0] - TEXTURE(4 * bearings)).mean() < 1.0


def test_pixels_agree_with_the_rest_of_the_package() -> None:
    bearings = unit(RNG.normal(size=(50, 3)))
    assert np.allclose(pixels_of(bearings, WIDTH), erp_from_bearings(bearings, WIDTH, WIDTH // 2))


def test_extremes_fit_the_fixed_point() -> None:
    chequered = 255.0 * (np.indices((64, 128)).sum(axis=0) % 2)
    image = SphereImage.of(chequered)
    v, u = np.mgrid[8:56, 0:128] + 0.5
    values, _ = image.sample(bearings_from_erp(np.stack([u, v], axis=-1), 128, 64))
    assert np.abs(values - chequered[8:56]).max() < 0.05


@pytest.mark.parametrize(
    "grey", [np.zeros((10, 10)), np.zeros((5, 10)), np.full((4, 8), np.nan), np.zeros((4, 8, 3))]
)
def test_other_images_are_refused(grey: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"sphere image|finite"):
        SphereImage.of(grey)
    with pytest.raises(ValueError, match=r"sphere image|finite"):
        halved(grey)
