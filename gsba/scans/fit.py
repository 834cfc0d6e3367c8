"""Point to plane with scale: a cloud onto a scan, robust, with covariance."""

from dataclasses import dataclass

import numpy as np

from gsba.scans.types import Cloud, Scan
from gsba.similarity import Sim3

_TIGHTER = 0.7  # of the width, from round to round
_SETTLED = 1e-6  # of the size: a smaller step ends a round
_FEW_STEPS, _MAX_STEPS = 3, 6  # of a width
_LAST = 6  # rounds of the whole cloud, the width being what the residuals scatter by
_SOME = 1200  # points before
_CELLS = 4  # of a cloud's size: within, errors count as one
_MEDIAN_NORMAL = 0.6745  # of |x|, x unit normal


@dataclass(frozen=True, slots=True)
class Fit:
    """A similarity that carries a cloud onto a scan."""

    similarity: Sim3  # scan = similarity of the cloud
    sigma: float  # of the residuals beyond the points' own noise, unit of the scan
    covariance: np.ndarray  # (7, 7): turn (radians, axes of the scan), shift of the middle (unit of
    # the scan), log scale
    middle: np.ndarray  # (3,) float64, scan: what the turn and the scale leave in place

    @property
    def sigmas(self) -> np.ndarray:
        """Standard deviations (7,), see `covariance`."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0))


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


def own_variances(fit: Sim3, cloud: Cloud, normals: np.ndarray) -> np.ndarray:
    """Variances (N,) along normals (N, 3) of the scan that the cloud's own noise makes."""
    turned = normals @ fit.rotation
    return fit.scale**2 * np.einsum("ni,nij,nj->n", turned, cloud.covariances, turned)


def approach(start: Sim3, cloud: Cloud, scan: Scan, width: float) -> tuple[Sim3, float]:
    """Some of the cloud onto the scan, and what the distances left scatter by.

    Least squares of distances to the planes at the nearest points by Gauss-Newton, under
    Geman-McClure's loss; it tightens from `width` to the scatter, so that what only one of both
    shows loses its say.

    Args:
        start: near the answer: within some widths.
        width: of the loss at first, unit of the scan.
    """
    least = 0.1 * scan.spacing
    fit, some = start, cloud.taken(np.arange(0, len(cloud.points), -(-len(cloud.points) // _SOME)))
    while True:
        fit = _settle(fit, some, scan, width, _FEW_STEPS)
        sigma = max(scatter(fit, some, scan, width), least)
        if width <= 1.5 * sigma:
            return fit, sigma
        width = max(_TIGHTER * width, 1.2 * sigma)


def settle(start: Sim3, cloud: Cloud, scan: Scan, sigma: float) -> Fit:
    """The whole cloud onto the scan, from nearby; see `approach`."""
    fit = start
    for _ in range(_LAST):
        sigma = max(scatter(fit, cloud, scan, sigma), 0.1 * scan.spacing)
        fit = _settle(fit, cloud, scan, sigma, _MAX_STEPS)
    return _with_covariance(fit, cloud, scan, sigma)


def _settle(fit: Sim3, cloud: Cloud, scan: Scan, sigma: float, most: int) -> Sim3:
    """Steps of one width, until they no longer move anything."""
    for _ in range(most):
        fit, moved = _step(fit, cloud, scan, sigma)
        if moved < _SETTLED * cloud.size * fit.scale:
            break
    return fit


def scatter(fit: Sim3, cloud: Cloud, scan: Scan, width: float) -> float:
    """Standard deviation of the distances to the planes, of points within three widths."""
    reach = 3 * width + 3 * scan.spacing
    _, nearest, off, gaps = residuals_of(fit, cloud, scan, reach)
    near = (np.abs(off) < 3 * width) & (gaps < reach)
    near &= own_variances(fit, cloud, scan.normals[nearest]) < width**2
    return float(np.median(np.abs(off[near])) / _MEDIAN_NORMAL) if near.sum() > 20 else width


def _weighted(
    fit: Sim3, cloud: Cloud, scan: Scan, sigma: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Jacobians (N, 7), residuals, weights, carried points and their middle."""
    reach = 4 * sigma + 3 * scan.spacing
    carried, nearest, off, gaps = residuals_of(fit, cloud, scan, reach)
    normals = scan.normals[nearest]
    variances = sigma**2 + own_variances(fit, cloud, normals)
    weights = 1 / variances / (1 + off**2 / variances) ** 2
    weights[gaps >= reach] = 0.0
    total = max(weights.sum(), 1e-300)
    middle = weights @ carried / total
    arms = carried - middle
    along = np.einsum("ni,ni->n", normals, arms)
    jacobians = np.column_stack([np.cross(arms, normals), normals, along])
    return jacobians, off, weights, carried, middle


def _step(fit: Sim3, cloud: Cloud, scan: Scan, sigma: float) -> tuple[Sim3, float]:
    """One step of Gauss-Newton, and how far it moves points at most."""
    jacobians, off, weights, _, middle = _weighted(fit, cloud, scan, sigma)
    size = cloud.size * fit.scale
    units = np.array([1 / size] * 3 + [1.0] * 3 + [1 / size])
    jacobians = jacobians * units
    hessian = (jacobians * weights[:, None]).T @ jacobians
    hessian += 1e-9 * max(np.trace(hessian), 1e-300) * np.eye(7)
    step = units * np.linalg.solve(hessian, -jacobians.T @ (weights * off))
    moved = float(np.linalg.norm(step / units))
    if moved > 0.3 * size:
        step, moved = step * 0.3 * size / moved, 0.3 * size
    return moved_by(fit, step, middle), moved


def moved_by(fit: Sim3, step: np.ndarray, middle: np.ndarray) -> Sim3:
    """The similarity followed by a turn (3), shift (3) and log scale around a point (3,)."""
    from scipy.spatial.transform import Rotation

    turn, stretch = Rotation.from_rotvec(step[:3]).as_matrix(), float(np.exp(step[6]))
    shift = stretch * turn @ (fit.translation - middle) + middle + step[3:6]
    return Sim3(stretch * fit.scale, turn @ fit.rotation, shift)


def _with_covariance(fit: Sim3, cloud: Cloud, scan: Scan, sigma: float) -> Fit:
    """With the sandwich of clustered errors (Liang and Zeger, Biometrika 73, 1986).

    What neighbours have in common (a piece of wall, a mistaken normal) is no independent evidence:
    residuals of a cell count as one.
    """
    jacobians, off, weights, carried, middle = _weighted(fit, cloud, scan, sigma)
    normals = jacobians[:, 3:6]
    gradients = jacobians * (weights * off)[:, None]
    cells = cells_of(carried, fit.scale * cloud.size / _CELLS)
    sums = np.zeros((cells.max() + 1, 7))
    np.add.at(sums, cells, gradients)
    variances = sigma**2 + own_variances(fit, cloud, normals)
    slopes = weights * (1 - 3 * off**2 / variances) / (1 + off**2 / variances)
    hessian = (jacobians * slopes[:, None]).T @ jacobians
    inverse = np.linalg.pinv(hessian, rcond=1e-14, hermitian=True)
    return Fit(fit, sigma, inverse @ (sums.T @ sums) @ inverse, middle)


def cells_of(points: np.ndarray, edge: float) -> np.ndarray:
    """Number (N,) of the cube of an edge that each point is in, from 0 on."""
    cubes = np.floor(points / edge).astype(np.int64)
    return np.unique(cubes, axis=0, return_inverse=True)[1].reshape(-1)
