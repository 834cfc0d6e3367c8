"""Aligning patches: known shifts, warps, gains and depths are found, with an honest covariance."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factors import tangent_basis
from factors.patches import ALIGNED, REASONS, PatchSet, Sightings, expect, found_at
from factors.sphere_image import SphereImage
from gsba.camera.sphere import bearings_from_erp, erp_directions

HEIGHT = 256
WIDTH = 2 * HEIGHT
PIXEL = 2 * np.pi / WIDTH
SIZE = 15
DIRECTIONS = {
    "ahead": [0.1, -0.2, 1.0],
    "seam": [0.01, 0.1, -1.0],
    "near the pole": [0.05, -1.0, 0.03],
    "down": [0.3, 0.9, -0.4],
}
_CENTRES = erp_directions(WIDTH)


def _texture(vectors: np.ndarray, seed: int = 0, blur_px: float = 0.0) -> np.ndarray:
    """Waves in all directions, of wavelengths of 6 pixels and more, seen along unit vectors;
    blur_px: standard deviation of a blur along x."""
    rng = np.random.default_rng(seed)
    out = np.full(vectors.shape[:-1], 120.0)
    for _ in range(40):
        wave = rng.normal(size=3)
        wave *= rng.uniform(0.2, 1.0) * 2 * np.pi / (6 * PIXEL) / np.linalg.norm(wave)
        left = np.exp(-0.5 * (blur_px * PIXEL * wave[0]) ** 2)
        out += 6 * left * np.sin(vectors @ wave + rng.uniform(0, 2 * np.pi))
    return out


def _panorama(pull: Callable[[np.ndarray], np.ndarray], noise: float = 0, seed: int = 1):
    """Panorama that shows along each bearing the texture of `pull(bearings)`."""
    pixels = _texture(pull(_CENTRES))
    pixels += noise * np.random.default_rng(seed).normal(size=pixels.shape)
    return SphereImage.of(pixels)


def _patch(direction: list[float]) -> tuple[np.ndarray, np.ndarray]:
    origin = np.array(direction) / np.linalg.norm(direction)
    return origin[None], PIXEL * np.swapaxes(tangent_basis(origin[None]), 1, 2)


def _align(
    first: SphereImage,
    second: SphereImage,
    direction: list[float],
    mask: np.ndarray | None = None,
    cut_mask: np.ndarray | None = None,
) -> tuple[PatchSet, Sightings]:
    origins, spreads = _patch(direction)
    patches = PatchSet(1, SIZE, 0.6, 0.15, 0.3, 3.0)
    patches.cut(first, cut_mask, np.array([0]), origins, spreads, 2.0)
    sightings = expect(np.array([0]), origins, spreads)
    patches.align(second, mask, np.array([0]), sightings, 4.5, 20, 1e-3)
    return patches, sightings


@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS)
def test_a_turn_of_the_camera_is_found(direction: list[float]) -> None:
    turn = Rotation.from_rotvec(np.array([0.8, -0.5, 0.6]) * PIXEL).as_matrix()
    _, sightings = _align(_panorama(lambda b: b), _panorama(lambda b: b @ turn), direction)
    assert sightings.states[0] == ALIGNED and sightings.scores[0] > 0.999
    bearings, _ = found_at(sightings)
    expected = turn @ _patch(direction)[0][0]
    assert np.linalg.norm(bearings[0] - expected) < 0.01 * PIXEL


def test_the_seam_is_not_seen() -> None:
    pixels = _texture(_CENTRES)
    longitudes = np.arange(-14, 14.1, 0.7) * PIXEL  # patches on either side, and all across
    origins = np.stack([np.sin(longitudes), np.full(len(longitudes), 0.2), np.cos(longitudes)], 1)
    spreads = PIXEL * np.swapaxes(tangent_basis(origins), 1, 2)
    half_turn, every = np.diag([-1.0, 1.0, -1.0]), np.arange(len(origins))
    ahead, behind = (PatchSet(len(origins), SIZE, 0.6, 0.15, 0.3, 3.0) for _ in range(2))
    ahead.cut(SphereImage.of(pixels), None, every, origins, spreads, 2.0)
    turned = SphereImage.of(np.roll(pixels, HEIGHT, axis=1))
    behind.cut(turned, None, every, origins @ half_turn, half_turn @ spreads, 2.0)
    for there, here in zip(behind.templates[2:5], ahead.templates[2:5], strict=True):
        np.testing.assert_allclose(there, here, atol=1e-3)


def test_gain_and_offset_change_nothing() -> None:
    turn = Rotation.from_rotvec(np.array([0.3, 0.9, 0.1]) * PIXEL).as_matrix()
    dark = SphereImage.of(0.6 * _texture(_CENTRES @ turn) + 30)
    _, plain = _align(_panorama(lambda b: b), _panorama(lambda b: b @ turn), [0.1, 0.2, 1])
    _, dimmed = _align(_panorama(lambda b: b), dark, [0.1, 0.2, 1])
    np.testing.assert_allclose(found_at(dimmed)[0], found_at(plain)[0], atol=2e-3 * PIXEL)
    np.testing.assert_allclose(dimmed.variances, plain.variances, rtol=0.2, atol=0.05)


def test_a_slanted_surface_is_followed() -> None:
    """A wall seen under another angle: the affine part finds it, the shift stays right."""
    origin, spread = _patch([0, 0, 1])
    slant = np.array([[1.08, 0.05], [-0.04, 0.93]])
    axes = spread[0] / PIXEL

    def pull(b: np.ndarray) -> np.ndarray:
        plane = (b @ axes) / np.maximum(b @ origin[0], 0.2)[..., None]  # on the tangent plane
        flat = origin[0] + (plane @ np.linalg.inv(slant).T) @ axes.T
        return flat / np.linalg.norm(flat, axis=-1, keepdims=True)

    _, sightings = _align(_panorama(lambda b: b), _panorama(pull), [0, 0, 1])
    assert sightings.states[0] == ALIGNED
    np.testing.assert_allclose(sightings.warps[0, :2], 0, atol=0.02)
    found = sightings.warps[0, 2:].reshape(2, 2).T + np.eye(2)
    np.testing.assert_allclose(found, slant, atol=0.02)  # the prior holds it back a little


@pytest.mark.parametrize("sharper", ["template", "sighting"])
def test_blur_shifts_no_patch(sharper: str) -> None:
    """One picture is blurred by .8 pixels along one axis; shifts without blur among the
    unknowns are the measure."""
    places = np.stack(np.meshgrid(np.arange(-0.18, 0.19, 0.03), np.arange(-0.18, 0.19, 0.03)), -1)
    origins = np.column_stack([places.reshape(-1, 2), np.ones(169)])
    origins /= np.linalg.norm(origins, axis=1)[:, None]
    spreads, rows = PIXEL * np.swapaxes(tangent_basis(origins), 1, 2), np.arange(169)
    pictures = [SphereImage.of(_texture(_CENTRES, blur_px=blur)) for blur in (0.0, 0.8)]
    if sharper == "sighting":
        pictures.reverse()
    errors = []
    for blur_sigma in (0.3, 1e-4):
        patches = PatchSet(len(rows), SIZE, 0.6, 0.15, blur_sigma, 3.0)
        patches.cut(pictures[0], None, rows, origins, spreads, 2.0)
        sightings = expect(rows, origins, spreads)
        patches.align(pictures[1], None, rows, sightings, 4.5, 20, 1e-3)
        aligned = sightings.states == ALIGNED
        assert np.count_nonzero(aligned) > 0.9 * len(rows)
        errors.append(np.sqrt(np.mean(sightings.warps[aligned, :2] ** 2)))
    assert errors[0] < 0.35 * errors[1]


def test_covariance_is_honest() -> None:
    """Whitened errors of many patches under noise: chi-square of two dimensions."""
    rng = np.random.default_rng(3)
    num = 300
    origins = bearings_from_erp(
        np.column_stack([rng.uniform(0, WIDTH, num), rng.uniform(40, HEIGHT - 40, num)]),
        WIDTH,
        HEIGHT,
    )
    spreads = PIXEL * np.swapaxes(tangent_basis(origins), 1, 2)
    patches = PatchSet(num, SIZE, 2.0, 0.15, 0.3, 3.0)
    rows = np.arange(num)
    patches.cut(_panorama(lambda b: b), None, rows, origins, spreads, 2.0)
    sightings = expect(rows, origins, spreads)
    patches.align(_panorama(lambda b: b, noise=4.0), None, rows, sightings, 4.5, 20, 1e-3)
    kept = sightings.states == ALIGNED
    assert np.count_nonzero(kept) > 0.95 * num
    covariances = patches.shift_covariances(rows, sightings.variances)[kept]
    shifts = sightings.warps[kept, :2]
    squares = np.einsum("ni,nij,nj->n", shifts, np.linalg.inv(covariances), shifts)
    # The mean of chi-square (2) is 2 +- 0.12 here; neighbouring samples share image noise, which
    # the Hessian does not know and the bundle adjustment's noise estimate takes up.
    assert 1.4 < np.mean(squares) < 3.2


def test_derivative_by_the_shift() -> None:
    origins, spreads = _patch([0.2, 0.5, -1])
    sightings = expect(np.array([0]), origins, spreads * [1.1, 0.8])
    sightings.warps[0] = [0.4, -0.7, 0.1, 0.05, -0.06, 0.2]
    _, by_shift = found_at(sightings)
    affine = np.eye(2) + sightings.warps[0, 2:].reshape(2, 2).T
    for k in range(2):
        moved = []
        for step in (1e-3, -1e-3):
            other = expect(np.array([0]), sightings.origins, sightings.spreads)
            other.warps[0] = sightings.warps[0]
            other.warps[0, :2] += step * affine[:, k]
            moved.append(found_at(other)[0][0])
        np.testing.assert_allclose(by_shift[0, :, k], (moved[0] - moved[1]) / 2e-3, atol=1e-9)


@pytest.mark.parametrize("grey", [0, 128, 255])
def test_without_texture_there_is_no_patch(grey: int) -> None:
    blank = SphereImage.of(np.full((HEIGHT, WIDTH), grey))
    patches, sightings = _align(blank, _panorama(lambda b: b), [0, 0, 1])
    assert REASONS[int(sightings.states[0])] == "no texture"
    _, sightings = _align(_panorama(lambda b: b), blank, [0, 0, 1])
    assert REASONS[int(sightings.states[0])] == "no texture"
    assert np.isfinite(sightings.warps).all() and np.isfinite(patches.templates.inverses).all()


def test_an_edge_that_can_slide_is_no_patch() -> None:
    stripes = SphereImage.of(128 + 60 * np.tanh(3 * (_CENTRES[..., 0]) / PIXEL))
    _, sightings = _align(stripes, stripes, [0, 0, 1])
    assert REASONS[int(sightings.states[0])] == "no texture"


def test_masks_are_respected_on_both_sides() -> None:
    image = _panorama(lambda b: b)
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[:, WIDTH // 2 + 3 :] = False
    _, sightings = _align(image, image, [0, 0, 1], mask=mask)
    assert REASONS[int(sightings.states[0])] == "masked"
    _, sightings = _align(image, image, [0, 0, 1], cut_mask=mask)
    assert REASONS[int(sightings.states[0])] == "masked"
    _, sightings = _align(image, image, [-1, 0, 1], mask=mask, cut_mask=mask)
    assert sightings.states[0] == ALIGNED


def test_another_texture_is_not_taken() -> None:
    other = SphereImage.of(_texture(_CENTRES, seed=9))
    for direction in DIRECTIONS.values():
        _, sightings = _align(_panorama(lambda b: b), other, direction)
        assert sightings.states[0] != ALIGNED or sightings.scores[0] < 0.75


def test_an_even_size_is_refused() -> None:
    with pytest.raises(ValueError, match="odd"):
        PatchSet(1, 8, 0.6, 0.1, 0.3, 3.0)
