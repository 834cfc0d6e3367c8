"""Point-to-plane alignment of a cloud to a scan: a similarity by a robust loss, with covariance."""

from dataclasses import dataclass

import numpy as np

from gsba.scans.types import Cloud, Scan
from gsba.significance import MEDIAN_ABS_NORMAL
from gsba.similarity import Sim3
from gsba.types.records import with_rows

_FEW_STEPS, _MAX_STEPS = 3, 6  # Gauss-Newton steps at one width, at first and at the end
LEAST_SIGMA = 0.1  # smallest sigma, part of the scan's spacing
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
    """Maximum-likelihood noise, from points within a fiftieth of the cloud's size of a surface."""
    from scipy.optimize import minimize

    reach = reach_of(fit, cloud)
    _, nearest, off, gaps = residuals_of(fit, cloud, scan, reach + scan.reach)
    near = (np.abs(off) <= reach) & (gaps <= reach + scan.reaches[nearest])
    if near.sum() < _MIN_POINTS:
        return Noise(sigma)
    some, off, rows = with_rows(cloud, np.flatnonzero(near)), off[near], nearest[near]
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
    """Largest distance of a point that counts as near a surface, unit of the scan: a fiftieth of
    the cloud's size."""
    return 0.02 * cloud.size * fit.scale


def residuals_of(
    fit: Sim3, cloud: Cloud, scan: Scan, reach: float = np.inf
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of a transformed cloud: points (N, 3), rows (N,) of the nearest scan points, distances (N,)
    to their planes, and distances (N,) to them, infinite beyond `reach`."""
    carried = fit.points(cloud.points)
    gaps, nearest = scan.tree.query(carried, distance_upper_bound=reach)
    nearest = np.minimum(nearest, len(scan.points) - 1)
    offsets = carried - scan.points[nearest]
    return carried, nearest, np.einsum("ni,ni->n", scan.normals[nearest], offsets), gaps


@dataclass(frozen=True, slots=True)
class Fit:
    """Similarity from a cloud to a scan, with noise and covariance."""

    similarity: Sim3  # scan = similarity of the cloud
    noise: Noise
    covariance: np.ndarray  # (7, 7): rotation (radians, axes of the scan), translation of `middle`
    # (unit of the scan), log scale
    middle: np.ndarray  # (3,) float64, scan: fixed point of the covariance's rotation and scale

    @property
    def sigmas(self) -> np.ndarray:
        """Standard deviations (7,), see `covariance`."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0))


def approach(start: Sim3, cloud: Cloud, scan: Scan, width: float) -> tuple[Sim3, float]:
    """Align a part of the cloud to the scan; returns the similarity and the residuals' sigma.

    Gauss-Newton minimises the distances to the planes at the nearest points under Geman-McClure's
    loss. The loss narrows from `width` to the residuals' sigma, so that surfaces which only one of
    both shows are outliers.

    Args:
        width: initial width of the loss, unit of the scan.
    """
    least = LEAST_SIGMA * scan.spacing
    every = np.arange(len(cloud.points))
    fit, some = start, with_rows(cloud, every[:: -(-len(every) // 1200)])
    while True:
        fit = _settle(fit, some, scan, Noise(width), _FEW_STEPS)
        sigma = max(scatter(fit, some, scan, width), least)
        if width <= 1.5 * sigma:
            return fit, sigma
        width = max(0.7 * width, 1.2 * sigma)


def settle(start: Sim3, cloud: Cloud, scan: Scan, sigma: float) -> Fit:
    """Align the whole cloud to the scan, from a start by `approach` with its `sigma`."""
    fit = start
    for _ in range(6):
        noise = noise_of(fit, cloud, scan, sigma)
        fit, sigma = _settle(fit, cloud, scan, noise, _MAX_STEPS), noise.sigma
    # Sandwich covariance of clustered errors (Liang and Zeger, Biometrika 73, 1986): neighbours'
    # errors are correlated. Of several sizes of cells the one with the largest variances is taken
    # (Flyvbjerg and Petersen, J. Chem. Phys. 91).
    jacobians, off, variances, weights, carried, middle = _weighted(fit, cloud, scan, noise)
    gradients = jacobians * (weights * off)[:, None]
    slopes = weights * (1 - 3 * off**2 / variances) / (1 + off**2 / variances)
    hessian = (jacobians * slopes[:, None]).T @ jacobians
    inverse = np.linalg.pinv(hessian, rcond=1e-14, hermitian=True)
    found = []
    for part in (8, 4, 2, 1):  # cells along the size of the cloud
        cells = cells_of(carried, fit.scale * cloud.size / part)
        sums = np.zeros((cells.max() + 1, 7))
        np.add.at(sums, cells, gradients)
        found.append(inverse @ (sums.T @ sums) @ inverse)
    return Fit(fit, noise, max(found, key=lambda c: float(np.trace(c[3:6, 3:6]))), middle)


def _settle(fit: Sim3, cloud: Cloud, scan: Scan, noise: Noise, most: int) -> Sim3:
    """Gauss-Newton steps at one noise, at most `most`, until they are negligible."""
    for _ in range(most):
        fit, moved = _step(fit, cloud, scan, noise)
        if moved < 1e-6 * cloud.size * fit.scale:
            break
    return fit


def scatter(fit: Sim3, cloud: Cloud, scan: Scan, width: float) -> float:
    """Robust standard deviation of the distances to the planes, of points within three widths."""
    _, nearest, off, gaps = residuals_of(fit, cloud, scan, 3 * width + scan.reach)
    near = (np.abs(off) < 3 * width) & (gaps < 3 * width + scan.reaches[nearest])
    near &= Noise(0.0).variances(fit, cloud, scan, nearest) < width**2
    return float(np.median(np.abs(off[near])) / MEDIAN_ABS_NORMAL) if near.sum() > 20 else width


def _weighted(fit: Sim3, cloud: Cloud, scan: Scan, noise: Noise) -> tuple[np.ndarray, ...]:
    """Equations of a Gauss-Newton step: Jacobians (N, 7) of residuals by the step, residuals (N,),
    their variances, weights of the robust loss over variances, the cloud's transformed points (N,
    3), and the weighted mean (3,) of these."""
    reach = 4 * noise.sigma
    carried, nearest, off, gaps = residuals_of(fit, cloud, scan, reach + scan.reach)
    normals = scan.normals[nearest]
    variances = noise.variances(fit, cloud, scan, nearest)
    weights = 1 / variances / (1 + off**2 / variances) ** 2
    weights[gaps >= reach + scan.reaches[nearest]] = 0.0
    middle = weights @ carried / max(weights.sum(), 1e-300)
    arms = carried - middle
    along = np.einsum("ni,ni->n", normals, arms)
    jacobians = np.column_stack([np.cross(arms, normals), normals, along])
    return jacobians, off, variances, weights, carried, middle


def _step(fit: Sim3, cloud: Cloud, scan: Scan, noise: Noise) -> tuple[Sim3, float]:
    """Similarity after a Gauss-Newton step, and a bound of the points' motion by it."""
    jacobians, off, _, weights, _, middle = _weighted(fit, cloud, scan, noise)
    size = cloud.size * fit.scale
    units = np.array([1 / size] * 3 + [1.0] * 3 + [1 / size])
    jacobians = jacobians * units
    hessian = (jacobians * weights[:, None]).T @ jacobians
    hessian += 1e-9 * max(np.trace(hessian), 1e-300) * np.eye(7)
    step = units * np.linalg.solve(hessian, -jacobians.T @ (weights * off))
    moved = float(np.linalg.norm(step / units))
    if moved > 0.3 * size:
        step, moved = step * 0.3 * size / moved, 0.3 * size
    return fit.moved(step, middle), moved


def cells_of(points: np.ndarray, edge: float) -> np.ndarray:
    """Number (N,), from 0, of the cubic cell with this edge that holds each point (N, 3)."""
    cubes = np.floor(points / edge).astype(np.int64)
    return np.unique(cubes, axis=0, return_inverse=True)[1].reshape(-1)
