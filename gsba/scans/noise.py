"""How far a cloud's points lie off a scan's surfaces where both show the same."""

from dataclasses import dataclass

import numpy as np

from gsba.scans.types import Cloud, Scan
from gsba.similarity import Sim3

LEAST_SIGMA = 0.1  # of the distance between the scan's points
_REACH = 0.02  # of a cloud's size: how far surfaces count as near
_FAR = 20.0  # of logarithms from where they start: nothing in double precision tells these apart
_FEW = 50  # points that tell nothing of their noise


@dataclass(frozen=True, slots=True)
class Noise:
    """Of distances from a cloud's points to the planes of a scan, where both show one surface."""

    sigma: float  # that points share, unit of the scan
    factor: float = 1.0  # by which the cloud's own standard deviations are too small
    inliers: float = 0.8  # share of points beside a surface that are on it

    def variances(self, fit: Sim3, cloud: Cloud, scan: Scan, rows: np.ndarray) -> np.ndarray:
        """Of distances (N,) to the planes of the scan's points `rows` (N,)."""
        own = _own_variances(fit, cloud, scan, rows)
        return self.sigma**2 + self.factor**2 * own + scan.variances(rows)

    def logs(self, off: np.ndarray, variances: np.ndarray, reach: float) -> np.ndarray:
        """Log likelihoods (N,) of distances within a reach, over those of even ones.

        Inliers are normal, the others even.
        """
        normal = np.exp(-0.5 * off**2 / variances) / np.sqrt(2 * np.pi * variances)
        return np.log(self.inliers * 2 * reach * normal + 1 - self.inliers)


def noise_of(fit: Sim3, cloud: Cloud, scan: Scan, sigma: float) -> Noise:
    """The likeliest noise, of points within a fiftieth of the cloud's size from a surface.

    Args:
        sigma: to start from.
    """
    from scipy.optimize import minimize

    reach = reach_of(fit, cloud)
    _, nearest, off, gaps = residuals_of(fit, cloud, scan, reach + scan.reach)
    near = (np.abs(off) <= reach) & (gaps <= reach + scan.reaches[nearest])
    if near.sum() < _FEW:
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
    low, high = start - _FAR, start + _FAR
    return noise(minimize(cost, start, method="Nelder-Mead", options={"xatol": 0.01}).x)


def _own_variances(fit: Sim3, cloud: Cloud, scan: Scan, rows: np.ndarray) -> np.ndarray:
    """Variances (N,) along the scan's normals that the cloud's own noise makes."""
    turned = scan.normals[rows] @ fit.rotation
    return fit.scale**2 * np.einsum("ni,nij,nj->n", turned, cloud.covariances, turned)


def reach_of(fit: Sim3, cloud: Cloud) -> float:
    """How far off a surface a point of the cloud counts as beside it, unit of the scan."""
    return _REACH * cloud.size * fit.scale


def residuals_of(
    fit: Sim3, cloud: Cloud, scan: Scan, reach: float = np.inf
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What is nearest to a cloud that a similarity carries.

    Returns:
        carried points (N, 3), rows (N,) of the scan's points nearest to them, distances (N,) to
        their planes and to themselves; the latter infinite beyond `reach`.
    """
    carried = fit.points(cloud.points)
    gaps, nearest = scan.tree.query(carried, distance_upper_bound=reach)
    nearest = np.minimum(nearest, len(scan.points) - 1)
    offsets = carried - scan.points[nearest]
    return carried, nearest, np.einsum("ni,ni->n", scan.normals[nearest], offsets), gaps
