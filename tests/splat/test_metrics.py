"""PSNR and SSIM against direct sums, and the training loss's derivative against differences."""

import numpy as np
import pytest

from gsba.splat.metrics import psnr, ssim, training_loss

RNG = np.random.default_rng(0)
TRUTH = RNG.random((24, 20, 3))
IMAGE = np.clip(TRUTH + RNG.normal(0, 0.1, TRUTH.shape), 0, 1)


def direct_similarity(x: np.ndarray, y: np.ndarray, at: tuple[int, int], channel: int) -> float:
    """SSIM of one pixel by its definition: weighted moments of an 11 x 11 window."""
    offsets = np.arange(-5, 6)
    weights = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    weights /= weights.sum()
    window = tuple(slice(c - 5, c + 6) for c in at)
    a, b = x[window][..., channel], y[window][..., channel]
    mean_a, mean_b = np.sum(weights * a), np.sum(weights * b)
    var_a = np.sum(weights * (a - mean_a) ** 2)
    var_b = np.sum(weights * (b - mean_b) ** 2)
    both = np.sum(weights * (a - mean_a) * (b - mean_b))
    light = (2 * mean_a * mean_b + 1e-4) / (mean_a**2 + mean_b**2 + 1e-4)
    return light * (2 * both + 9e-4) / (var_a + var_b + 9e-4)


def test_psnr_of_a_known_error() -> None:
    assert psnr(TRUTH + 0.01, TRUTH) == pytest.approx(40)
    assert psnr(TRUTH, TRUTH) == np.inf
    half = np.zeros((24, 20), bool)
    half[:12] = True
    assert psnr(np.where(half[..., None], TRUTH + 0.1, 7), TRUTH, half) == pytest.approx(20)


def test_ssim_is_its_definition() -> None:
    values = [
        direct_similarity(IMAGE, TRUTH, (r, c), channel)
        for r in range(5, 19)
        for c in range(5, 15)
        for channel in range(3)
    ]
    assert ssim(IMAGE, TRUTH) == pytest.approx(np.mean(values), abs=1e-9)
    assert ssim(TRUTH, TRUTH) == pytest.approx(1)


def test_masked_pixels_have_no_say() -> None:
    use = np.ones((24, 20), bool)
    use[:, :3] = False
    spoiled = IMAGE.copy()
    spoiled[~use] = 0
    assert ssim(spoiled, TRUTH, use) == ssim(IMAGE, TRUTH, use)
    loss, slope = training_loss(spoiled, TRUTH, use, 0.2)
    assert loss == training_loss(IMAGE, TRUTH, use, 0.2)[0]
    assert not slope[~use].any() and slope[use].any()
    assert np.isnan(ssim(IMAGE, TRUTH, np.zeros((24, 20), bool)))


@pytest.mark.parametrize("ssim_weight", [0.0, 0.2, 1.0])
def test_derivative_of_the_training_loss(ssim_weight: float, rng: np.random.Generator) -> None:
    _, slope = training_loss(IMAGE, TRUTH, None, ssim_weight)
    for pick in rng.permutation(IMAGE.size)[:40]:
        losses = []
        for step in (1e-6, -1e-6):
            moved = IMAGE.copy()
            moved.flat[pick] += step
            losses.append(training_loss(moved, TRUTH, None, ssim_weight)[0])
        expected = (losses[0] - losses[1]) / 2e-6
        assert slope.flat[pick] == pytest.approx(expected, abs=1e-4 * float(np.abs(slope).max()))
