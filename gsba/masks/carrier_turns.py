"""Rotation of the carrier in pictures that do not turn with the camera.

With direction lock the picture keeps its heading, so that the carrier turns in it: its columns
shift as a whole, while the floor moves differently. A template of the lowest rows and each frame's
shift against it are estimated in turn, every pixel weighted by its stability.
"""

import numpy as np

from gsba.masks.medians import median_picture

WIDTH = 256  # pixels across the pictures in which shifts are estimated
_NUM_ROUNDS = 4
_MIN_CHANGE = 4.0  # grey levels: more stable pixels have equal weights


def band_of(picture: np.ndarray) -> np.ndarray:
    """The compared rows (r, WIDTH) float32 of a small picture (h, 2h, 3) uint8 RGB."""
    import cv2

    small = cv2.resize(picture, (WIDTH, WIDTH // 2), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(small[int(0.7 * len(small)) :], cv2.COLOR_RGB2GRAY).astype(np.float32)


def find_turns(bands: np.ndarray) -> np.ndarray:
    """Rotation of the carrier in each frame.

    Args:
        bands: (F, r, WIDTH) float32 grey levels, the lowest rows of each picture.

    Returns:
        Turns (F,) float64, radians, to the right, relative to the first frame.
    """
    levels = bands.mean(axis=(1, 2), keepdims=True)
    even = bands / np.maximum(levels, 1.0) * levels.mean()
    spectra = np.fft.rfft(even, axis=-1)
    squares = np.fft.rfft(even**2, axis=-1)
    best, turns = 0.0, np.zeros(len(bands))
    references = np.unique(np.linspace(0, len(bands) - 1, 3).astype(int))
    for reference in references:
        template, weights = even[reference], np.ones(even.shape[1:])
        shifts = np.zeros(len(bands))
        for _ in range(_NUM_ROUNDS):
            shifts = _shifts(spectra, squares, template, weights)
            template, weights = _steadiness(_rolled(spectra, -shifts))
        if weights.sum() > best:
            best, turns = float(weights.sum()), 2 * np.pi / WIDTH * shifts
    turns = turns - turns[0]
    return (turns + np.pi) % (2 * np.pi) - np.pi


def _steadiness(bands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median (r, WIDTH) of bands, and the weight (r, WIDTH) of each pixel: 1 / its variance."""
    median = median_picture(bands)
    change = median_picture(np.abs(bands - median))
    return median, 1 / (change**2 + _MIN_CHANGE**2)


def _shifts(
    spectra: np.ndarray, squares: np.ndarray, template: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Shifts (F,) in columns to the right of a template, by least weighted squares."""
    w, wt = (np.fft.rfft(x, axis=-1).conj() for x in (weights, weights * template))
    costs = np.fft.irfft((squares * w - 2 * spectra * wt).sum(axis=1), WIDTH, axis=-1)
    at = np.argmin(costs, axis=1)
    rows = np.arange(len(costs))
    left, middle, right = (costs[rows, (at + k) % WIDTH] for k in (-1, 0, 1))
    curve = left - 2 * middle + right
    return at + np.where(curve > 0, 0.5 * (left - right) / np.maximum(curve, 1e-12), 0.0)


def _rolled(spectra: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """Bands (F, r, WIDTH) shifted to the right by fractional columns (F,)."""
    waves = -2j * np.pi / WIDTH * np.arange(spectra.shape[-1])
    return np.fft.irfft(spectra * np.exp(waves * shifts[:, None, None]), WIDTH, axis=-1)
