"""Point to plane with scale: a cloud onto a scan, robust, with covariance."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gsba.scans.noise import LEAST_SIGMA, Noise, noise_of, residuals_of
from gsba.scans.types import Cloud, Scan
from gsba.similarity import Sim3

_TIGHTER = 0.7  # of the width, from round to round
_SETTLED = 1e-6  # of the size: a smaller step ends a round
_FEW_STEPS, _MAX_STEPS = 3, 6  # of a width
_LAST = 6  # rounds of the whole cloud, the width being what the residuals scatter by
_SOME = 1200  # points before
_CELLS = (8, 4, 2, 1)  # of a cloud's size: within, errors count as one
_MEDIAN_NORMAL = 0.6745  # of |x|, x unit normal


@dataclass(frozen=True, slots=True)
class Fit:
    """A similarity that carries a cloud onto a scan."""

    similarity: Sim3  # scan = similarity of the cloud
    noise: Noise
    covariance: np.ndarray  # (7, 7): turn (radians, axes of the scan), shift of the middle (unit of
    # the scan), log scale
    middle: np.ndarray  # (3,) float64, scan: what the turn and the scale leave in place

    @property
    def sigmas(self) -> np.ndarray:
        """Standard deviations (7,), see `covariance`."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0))


def approach(start: Sim3, cloud: Cloud, scan: Scan, width: float) -> tuple[Sim3, float]:
    """Some of the cloud onto the scan, and what the distances left scatter by.

    Least squares of distances to the planes at the nearest points by Gauss-Newton, under
    Geman-McClure's loss; it tightens from `width` to the scatter, so that what only one of both
    shows loses its say.

    Args:
        start: near the answer: within some widths.
        width: of the loss at first, unit of the scan.
    """
    least = LEAST_SIGMA * scan.spacing
    fit, some = start, cloud.taken(np.arange(0, len(cloud.points), -(-len(cloud.points) // _SOME)))
    while True:
        fit = _settle(fit, some, scan, Noise(width), _FEW_STEPS)
        sigma = max(scatter(fit, some, scan, width), least)
        if width <= 1.5 * sigma:
            return fit, sigma
        width = max(_TIGHTER * width, 1.2 * sigma)


def settle(start: Sim3, cloud: Cloud, scan: Scan, sigma: float) -> Fit:
    """The whole cloud onto the scan, from nearby; see `approach`."""
    fit = start
    for _ in range(_LAST):
        noise = noise_of(fit, cloud, scan, sigma)
        fit, sigma = _settle(fit, cloud, scan, noise, _MAX_STEPS), noise.sigma
    return _with_covariance(fit, cloud, scan, noise)


def _settle(fit: Sim3, cloud: Cloud, scan: Scan, noise: Noise, most: int) -> Sim3:
    """Steps of one width, until they no longer move anything."""
    for _ in range(most):
        fit, moved = _step(fit, cloud, scan, noise)
        if moved < _SETTLED * cloud.size * fit.scale:
            break
    return fit


def scatter(fit: Sim3, cloud: Cloud, scan: Scan, width: float) -> float:
    """Standard deviation of the distances to the planes, of points within three widths."""
    _, nearest, off, gaps = residuals_of(fit, cloud, scan, 3 * width + scan.reach)
    near = (np.abs(off) < 3 * width) & (gaps < 3 * width + scan.reaches[nearest])
    near &= Noise(0.0).variances(fit, cloud, scan, nearest) < width**2
    return float(np.median(np.abs(off[near])) / _MEDIAN_NORMAL) if near.sum() > 20 else width


class _Weighted(NamedTuple):
    """A step's equations."""

    jacobians: np.ndarray  # (N, 7)
    off: np.ndarray  # (N,) residuals
    variances: np.ndarray  # (N,)
    weights: np.ndarray  # (N,)
    carried: np.ndarray  # (N, 3)
    middle: np.ndarray  # (3,)


def _weighted(fit: Sim3, cloud: Cloud, scan: Scan, noise: Noise) -> _Weighted:
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
    return _Weighted(jacobians, off, variances, weights, carried, middle)


def _step(fit: Sim3, cloud: Cloud, scan: Scan, noise: Noise) -> tuple[Sim3, float]:
    """One step of Gauss-Newton, and how far it moves points at most."""
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
    return moved_by(fit, step, middle), moved


def moved_by(fit: Sim3, step: np.ndarray, middle: np.ndarray) -> Sim3:
    """The similarity followed by a turn (3), shift (3) and log scale around a point (3,)."""
    from scipy.spatial.transform import Rotation

    turn, stretch = Rotation.from_rotvec(step[:3]).as_matrix(), float(np.exp(step[6]))
    shift = stretch * turn @ (fit.translation - middle) + middle + step[3:6]
    return Sim3(stretch * fit.scale, turn @ fit.rotation, shift)


def _with_covariance(fit: Sim3, cloud: Cloud, scan: Scan, noise: Noise) -> Fit:
    """With the sandwich of clustered errors (Liang and Zeger, Biometrika 73, 1986).

    What neighbours have in common (a piece of wall, a mistaken normal) is no independent evidence:
    residuals of a cell count as one. How large cells must be is found by making them larger, as
    Flyvbjerg and Petersen do (J. Chem. Phys. 91, 1989): the largest variances are taken.
    """
    jacobians, off, variances, weights, carried, middle = _weighted(fit, cloud, scan, noise)
    gradients = jacobians * (weights * off)[:, None]
    slopes = weights * (1 - 3 * off**2 / variances) / (1 + off**2 / variances)
    hessian = (jacobians * slopes[:, None]).T @ jacobians
    inverse = np.linalg.pinv(hessian, rcond=1e-14, hermitian=True)
    found = []
    for part in _CELLS:
        cells = cells_of(carried, fit.scale * cloud.size / part)
        sums = np.zeros((cells.max() + 1, 7))
        np.add.at(sums, cells, gradients)
        found.append(inverse @ (sums.T @ sums) @ inverse)
    return Fit(fit, noise, max(found, key=lambda c: float(np.trace(c[3:6, 3:6]))), middle)


def cells_of(points: np.ndarray, edge: float) -> np.ndarray:
    """Number (N,) of the cube of an edge that each point is in, from 0 on."""
    cubes = np.floor(points / edge).astype(np.int64)
    return np.unique(cubes, axis=0, return_inverse=True)[1].reshape(-1)
