"""Similarity of a map to local level metres, by GPS fixes, a known vertical and a known scale."""

from dataclasses import dataclass

import numpy as np

from gsba.bundle.gps_factors import MAX_DRIFT_SHARE, FrameFixes
from gsba.geometry import extent_of
from gsba.similarity import (
    NoSimilarityError,
    Sim3,
    level_similarity,
    robust_similarity,
    similarity,
)


@dataclass(frozen=True, slots=True)
class GpsFit:
    """Similarity to local level metres with its covariance."""

    similarity: Sim3
    used: np.ndarray  # (G,) bool, inlier fixes
    centre: np.ndarray  # (3,) float64, map units: point whose shift `covariance` holds
    covariance: np.ndarray  # (7, 7) float64: log scale; rotation about east, north and up, radians;
    # shift of the centre, metres. Errors are applied from the left
    rms_m: float  # RMS residual of the inliers
    misfit: float  # RMS of residuals / sigma; if above 1, covariances are scaled by its square

    @property
    def scale_sigma(self) -> float:
        """Relative standard deviation of the scale."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def heading_sigma(self) -> float:
        """Standard deviation of the heading, radians."""
        return float(np.sqrt(self.covariance[3, 3]))

    @property
    def tilt_sigma(self) -> float:
        """Standard deviation of the vertical in its least certain direction, radians."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[1:3, 1:3])[-1]))

    def position_sigmas(self, points: np.ndarray) -> np.ndarray:
        """Standard deviations (N, 3) east, north and up, metres, of points (N, 3) of the map."""
        columns = _columns(self.similarity, points - self.centre)
        return np.sqrt(np.einsum("nia,ab,nib->ni", columns, self.covariance, columns))


def fit_fixes(
    positions: np.ndarray,
    fixes: FrameFixes,
    up_sigma: float | None = None,
    scale: tuple[float, float] | None = None,
) -> GpsFit:
    """Maximum-likelihood similarity from a map to GPS fixes with correlated errors and outliers.

    Least squares with the inverse covariance of all fixes (`FrameFixes.whitened`), initialised by
    `gsba.similarity.robust_similarity`. For the gate of outliers see `FrameFixes.inliers`.

    Args:
        positions: (G, 3) positions of the fixes' frames, map units, not all on one point.
        up_sigma: standard deviation of the direction +z of the map, radians, which is then kept as
            up; None = up is not known.
        scale: metres per map unit, known from other data, and its standard deviation.

    Raises:
        NoSimilarityError: positions and fixes are barely correlated.
    """
    solve, num = (similarity, 3) if up_sigma is None else (level_similarity, 2)
    limits = fixes.tolerances(), MAX_DRIFT_SHARE
    fit, used = robust_similarity(positions, fixes.positions, solve, num, *limits)
    centre = positions[used].mean(axis=0)
    free = list(range(7)) if up_sigma is None else [0, 3, 4, 5, 6]  # no tilt if up is known
    information = np.zeros((7, 7))
    for _ in range(20):  # selections of inliers
        fit, information = _most_probable(fit, positions, fixes, used, centre, free, scale)
        extent = fit.scale * extent_of(positions)
        before, (used, _) = used, fixes.inliers(_residuals(fit, positions, fixes), extent)
        if used.sum() < num:
            raise NoSimilarityError(f"only {used.sum()} of {len(used)} positions agree")
        if np.array_equal(before, used):
            break
    off = _residuals(fit, positions, fixes)[used]
    misfit = np.mean((off / fixes.sigmas[used]) ** 2)
    covariance = np.zeros((7, 7))
    covariance[np.ix_(free, free)] = np.linalg.pinv(information[np.ix_(free, free)], hermitian=True)
    covariance *= max(1.0, float(misfit))
    if up_sigma is not None:
        covariance[1, 1] = covariance[2, 2] = up_sigma**2
    rms = float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    return GpsFit(fit, used, centre, covariance, rms, float(np.sqrt(misfit)))


def _residuals(fit: Sim3, positions: np.ndarray, fixes: FrameFixes) -> np.ndarray:
    """Residuals (G, 3): fixes less the transformed positions of their frames, metres."""
    return fixes.positions - fit.points(positions)


def _columns(fit: Sim3, from_centre: np.ndarray) -> np.ndarray:
    """Derivative (G, 3, 7) of placed positions by the unknowns of `GpsFit.covariance`."""
    placed = fit.scale * from_centre @ fit.rotation.T
    columns = np.zeros((len(placed), 3, 7))
    columns[:, :, 0] = placed
    for axis, unit in enumerate(np.eye(3)):
        columns[:, :, 1 + axis] = np.cross(unit, placed)
    columns[:, :, 4:] = np.eye(3)
    return columns


def _most_probable(
    fit: Sim3,
    positions: np.ndarray,
    fixes: FrameFixes,
    used: np.ndarray,
    centre: np.ndarray,
    free: list[int],
    scale: tuple[float, float] | None,
) -> tuple[Sim3, np.ndarray]:
    """Similarity by Gauss-Newton over the inliers `used`, and its information (7, 7)."""
    chosen, some = fixes.taken(used), positions[used]
    information = np.zeros((7, 7))
    for _ in range(20):  # Gauss-Newton steps
        columns = chosen.whitened(_columns(fit, some - centre)).reshape(-1, 7)
        off = chosen.whitened(chosen.positions - fit.points(some)).ravel()
        information, right = columns.T @ columns, columns.T @ off
        if scale is not None:
            weight = (scale[0] / max(scale[1], 1e-9 * scale[0])) ** 2
            information[0, 0] += weight
            right[0] += weight * np.log(scale[0] / fit.scale)
        inverse = np.linalg.pinv(information[np.ix_(free, free)], hermitian=True)
        step = np.zeros(7)
        step[free] = inverse @ right[free]
        step[0] = np.clip(step[0], -1, 1)
        fit = fit.moved(np.roll(step, -1), about=fit.points(centre[None])[0])
        reach = np.array([1.0, 1, 1, 1, *[max(float(np.ptp(chosen.positions)), 1e-9)] * 3])
        if np.all(np.abs(step) <= 1e-10 * reach):
            break
    return fit, information
