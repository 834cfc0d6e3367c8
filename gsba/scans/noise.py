"""Noise of the distances between a cloud's points and the scan's surfaces that they are on."""

from dataclasses import dataclass

import numpy as np

from gsba.scans.types import Cloud, Scan
from gsba.similarity import Sim3

LEAST_SIGMA = 0.1  # smallest sigma, part of the scan's spacing
_MAX_NEAR_DISTANCE = 0.02  # of a point to a near surface, part of the cloud's size
_MAX_LOG_CHANGE = 20.0  # of log parameters from their start: beyond, likelihoods are constant
_MIN_POINTS = 50  # with fewer, the noise cannot be estimated


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise model of distances from a cloud's points to the planes of a scan."""

    sigma: float  # standard deviation that all points share, unit of the scan
    factor: float = 1.0  # factor on the standard deviations of the cloud's points
    inliers: float = 0.8  # share of points near a surface that are on it

    def variances(self, fit: Sim3, cloud: Cloud, scan: Scan, rows: np.ndarray) -> np.ndarray:
        """Variances (N,) of the distances to the planes of the scan's points `rows` (N,)."""
        own = _own_variances(fit, cloud, scan, rows)
        return self.sigma**2 + self.factor**2 * own + scan.variances(rows)

    def logs(self, off: np.ndarray, variances: np.ndarray, reach: float) -> np.ndarray:
        """Log likelihood ratios (N,) of distances within `reach` over a uniform distribution.

        Distances of inliers are normal, those of outliers uniform.
        """
        normal = np.exp(-0.5 * off**2 / variances) / np.sqrt(2 * np.pi * variances)
        return np.log(self.inliers * 2 * reach * normal + 1 - self.inliers)


def noise_of(fit: Sim3, cloud: Cloud, scan: Scan, sigma: float) -> Noise:
    """Maximum-likelihood noise, from points within a fiftieth of the cloud's size of a surface.

    Args:
        sigma: initial standard deviation, unit of the scan.
    """
    from scipy.optimize import minimize

    reach = reach_of(fit, cloud)
    _, nearest, off, gaps = residuals_of(fit, cloud, scan, reach + scan.reach)
    near = (np.abs(off) <= reach) & (gaps <= reach + scan.reaches[nearest])
    if near.sum() < _MIN_POINTS:
        return Noise(sigma)
    some, off, rows = cloud.taken(np.flatnonzero(near)), off[near], nearest[near]
    own, rough = _own_variances(fit, some, scan, rows), scan.variances(rows)
    least = LEAST_SIGMA * scan.spacing

    def noise(x: np.ndarray) -> Noise:
        shared, factor, odds = np.clip(x, low, high)
        share = 1 / (1 + float(np.exp(-odds)))
        return Noise(max(float(np.exp(shared)), least), float(np.exp(factor)), share)

    def cost(x: np.ndarray) -> float:
        tried = noise(x)
        logs = tried.logs(off, tried.sigma**2 + tried.factor**2 * own + rough, reach)
        return 0.01 * float(x[1] ** 2) - float(logs.mean())

    start = np.array([np.log(max(sigma, least)), 0.5, 1.4])
    low, high = start - _MAX_LOG_CHANGE, start + _MAX_LOG_CHANGE
    return noise(minimize(cost, start, method="Nelder-Mead", options={"xatol": 0.01}).x)


def _own_variances(fit: Sim3, cloud: Cloud, scan: Scan, rows: np.ndarray) -> np.ndarray:
    """Variances (N,) of the cloud's points along the scan's normals, unit of the scan squared."""
    turned = scan.normals[rows] @ fit.rotation
    return fit.scale**2 * np.einsum("ni,nij,nj->n", turned, cloud.covariances, turned)


def reach_of(fit: Sim3, cloud: Cloud) -> float:
    """Largest distance of a point that counts as near a surface, unit of the scan."""
    return _MAX_NEAR_DISTANCE * cloud.size * fit.scale


def residuals_of(
    fit: Sim3, cloud: Cloud, scan: Scan, reach: float = np.inf
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Nearest scan points and distances of a transformed cloud.

    Returns:
        transformed points (N, 3), rows (N,) of the nearest scan points, distances (N,) to the
        planes of these, and distances (N,) to these, infinite beyond `reach`.
    """
    carried = fit.points(cloud.points)
    gaps, nearest = scan.tree.query(carried, distance_upper_bound=reach)
    nearest = np.minimum(nearest, len(scan.points) - 1)
    offsets = carried - scan.points[nearest]
    return carried, nearest, np.einsum("ni,ni->n", scan.normals[nearest], offsets), gaps
