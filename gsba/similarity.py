"""Similarities between point sets of which some are wrong."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from gsba.geometry import NoSimilarityError, turned_similarity
from gsba.log import GsbaError

Similarity = tuple[float, np.ndarray, np.ndarray]  # target = scale * rotation @ source + shift

_DRAWS, _SEED = 500, 0
_ALIKE = 0.5  # least correlation of the points and where the similarity carries them
_MEDIAN_LENGTH = 1.538  # of a 3-vector of independent unit normals
_OUTLIER_SIGMAS = 4.6  # 99.99% of such vectors are shorter


def robust_similarity(
    source: np.ndarray,
    target: np.ndarray,
    solve: Callable[[np.ndarray, np.ndarray], Similarity],
    num_needed: int,
) -> tuple[Similarity, np.ndarray, float]:
    """Similarity of most of the points, whatever fewer than half of them say.

    Least median of squares over random draws (Rousseeuw, JASA 79, 1984), then least squares over
    what lies within the noise, until that settles.

    Args:
        source, target: (N, 3) float64.
        solve: least squares over some of them.
        num_needed: how many it needs at least.

    Returns:
        the similarity, (N,) bool what it rests on, and their RMS residual in target units.

    Raises:
        NoSimilarityError: the points of both have little in common.
    """
    rng = np.random.default_rng(_SEED)
    best, fit = np.inf, None
    draws = (rng.choice(len(source), num_needed, replace=False) for _ in range(_DRAWS))
    for draw in draws if len(source) > num_needed else [np.arange(len(source))]:
        try:
            candidate = solve(source[draw], target[draw])
        except NoSimilarityError:
            continue
        median = float(np.median(residuals_of(candidate, source, target)))
        if median < best:
            best, fit = median, candidate
    fit = fit or solve(source, target)
    extent = float(np.linalg.norm(np.ptp(target, axis=0)))
    used = np.ones(len(source), bool)
    for _ in range(20):
        residuals = residuals_of(fit, source, target)
        sigma = max(float(np.median(residuals)) / _MEDIAN_LENGTH, 1e-9 * extent)
        before, used = used, residuals <= _OUTLIER_SIGMAS * sigma
        fit = solve(source[used], target[used])
        if np.array_equal(before, used):
            break
    turned_similarity(source[used], target[used], fit[1], _ALIKE)
    rms = float(np.sqrt(np.mean(residuals_of(fit, source, target)[used] ** 2)))
    return fit, used, rms


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Say that it is this file's positions which no similarity fits."""
    try:
        yield
    except NoSimilarityError:
        raise GsbaError(
            f"{path}: its positions and the frames' have nothing in common: check that they are "
            "of this recording and on the frames' clock"
        ) from None


def level_similarity(source: np.ndarray, target: np.ndarray) -> Similarity:
    """Least-squares similarity that turns around z only: scale, heading and shift.

    Closed form of the plane (Umeyama's with complex numbers); heights only help the scale.

    Raises:
        NoSimilarityError: see `gsba.geometry.turned_similarity`.
    """
    mean_s, mean_t = source.mean(axis=0), target.mean(axis=0)
    s, t = source - mean_s, target - mean_t
    cross = np.sum((t[:, 0] + 1j * t[:, 1]) * (s[:, 0] - 1j * s[:, 1]))
    turn = cross / max(abs(cross), 1e-300)
    rotation = np.array([[turn.real, -turn.imag, 0], [turn.imag, turn.real, 0], [0, 0, 1.0]])
    return turned_similarity(source, target, rotation)


def residuals_of(fit: Similarity, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Distances (N,) between targets and carried sources."""
    scale, rotation, shift = fit
    return np.linalg.norm(scale * source @ rotation.T + shift - target, axis=1)


def extents(positions: np.ndarray) -> np.ndarray:
    """Extents (3,) along the principal axes, as parts of the largest."""
    values = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
    values = np.concatenate([values, np.zeros(3)])[:3]
    return values / max(float(values[0]), 1e-12)
