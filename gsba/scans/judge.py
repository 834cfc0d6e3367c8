"""Whether a cloud is where a similarity puts it in a scan: what is there, and what is in between.

A point with a surface of the scan at it is explained. One whose ray meets a surface before it, or
close behind it, is contradicted; one of which the scan shows nothing says nothing.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri
from scipy.stats import rankdata

from gsba.scans.fit import cells_of, own_variances, residuals_of
from gsba.scans.types import Cloud, Scan
from gsba.similarity import Sim3

SIGMAS = 3.0  # from its surface that an explained point may be
_CELLS_ALONG = 400  # of the scan's grid along its extent, at most
_BEYOND = 1.0  # of a cloud's size: how far behind a point surfaces contradict it
_LEAST_SINE = 0.15  # of a ray to a surface that it crosses
_REACH = 0.02  # of a cloud's size: how far surfaces count as near
_ALIKE = 0.7  # cosine between a point's normal and its surface's
_INLIERS = 0.8  # share of near points that are on their surface
_LEAST_ALIKE = 100  # near points whose brightness can be compared
_CELLS = 4  # of a cloud's size: points within share their luck


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a scan says of a cloud's points, at a similarity."""

    explained: np.ndarray  # (N,) bool
    contradicted: np.ndarray  # (N,) bool
    near: np.ndarray  # (N,) bool: beside a surface of the same normal
    logs: np.ndarray  # (N,) float64, log likelihood of its distance, times the reach; of points
    # that are not near as of such far ones
    cells: np.ndarray  # (N,) int64, of points nearby, in the cloud's own world

    @property
    def share(self) -> float:
        """Of the cloud that is explained."""
        return float(self.explained.mean())

    @property
    def agreement(self) -> float:
        """Explained, of all that the scan says something about."""
        said = self.explained.sum() + self.contradicted.sum()
        return float(self.explained.sum() / max(said, 1))

    def lead(self, other: "Verdict") -> float:
        """By how many standard errors this explains the cloud better than another placement.

        Vuong's test of models that are not nested (Econometrica 57, 1989), with cells as the
        independent draws: no single piece of furniture makes more than one. Points compared are
        those that both are judged by, as what is missing in the scan at one place and not at the
        other tells nothing; or those of them with a surface near in both, whichever tells more.
        """
        near = self.near & other.near
        judged = near | (
            (self.explained | self.contradicted) & (other.explained | other.contradicted)
        )
        return max((self._lead(other, both) for both in (near, judged)), key=abs)

    def _lead(self, other: "Verdict", both: np.ndarray) -> float:
        gains = np.bincount(self.cells[both], (self.logs - other.logs)[both])
        return float(gains.sum()) / max(float(np.linalg.norm(gains)), 1e-9)


class Grid:
    """Surfaces of a scan by cell: one point and normal in each."""

    def __init__(self, scan: Scan) -> None:
        extent = float(np.ptp(scan.points, axis=0).max())
        self.edge = max(extent / _CELLS_ALONG, 5 * scan.spacing)
        self.low = scan.points.min(axis=0) - 1.5 * self.edge  # around it nothing
        self.shape = np.ceil((np.ptp(scan.points, axis=0)) / self.edge).astype(int) + 4
        self.rows = np.full(self.shape, -1, np.int32)
        at = self._cells(scan.points)
        self.rows[at[:, 0], at[:, 1], at[:, 2]] = np.arange(len(at))
        self.scan = scan

    def _cells(self, points: np.ndarray) -> np.ndarray:
        return np.clip(((points - self.low) / self.edge).astype(np.int64), 0, self.shape - 1)

    def first_crossings(self, eyes: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Part (N,) of each way from an eye to an end at which it first crosses a surface.

        Infinite where it crosses none.
        """
        ways = ends - eyes
        lengths = np.linalg.norm(ways, axis=1)
        first = np.full(len(eyes), np.inf)
        steps = int(min(np.ceil(lengths.max(initial=0) / (0.7 * self.edge)), 4 * _CELLS_ALONG))
        for k in range(1, steps + 1):
            part = np.minimum(k * 0.7 * self.edge / np.maximum(lengths, 1e-12), 1.0)
            open_ = np.flatnonzero(np.isinf(first) & (k * 0.7 * self.edge <= lengths))
            at = self._cells(eyes[open_] + part[open_, None] * ways[open_])
            rows = self.rows[at[:, 0], at[:, 1], at[:, 2]]
            met, rows = open_[rows >= 0], rows[rows >= 0]
            normals = self.scan.normals[rows]
            along = np.einsum("ni,ni->n", normals, ways[met])
            before = np.einsum("ni,ni->n", normals, self.scan.points[rows] - eyes[met])
            steep = np.abs(along) > _LEAST_SINE * lengths[met]
            met, crossing = met[steep], before[steep] / along[steep]
            here = np.abs(crossing - part[met]) * lengths[met] <= 2 * self.edge
            first[met[here]] = crossing[here]
        return first


def verdict(fit: Sim3, cloud: Cloud, scan: Scan, grid: Grid, sigma: float) -> Verdict:
    """What a scan says of a cloud.

    Args:
        sigma: of distances from explained points to their surface, beside their own noise.
    """
    carried, nearest, off, gaps = residuals_of(fit, cloud, scan)
    normals = scan.normals[nearest]
    sigmas = np.sqrt(sigma**2 + own_variances(fit, cloud, normals))
    turned = np.einsum("ni,ni->n", normals, cloud.normals @ fit.rotation.T)
    off = np.where(gaps > 4 * scan.spacing, gaps, np.abs(off))
    explained = off <= SIGMAS * sigmas
    eyes = fit.points(cloud.eyes)
    ways = carried - eyes
    lengths = np.maximum(np.linalg.norm(ways, axis=1), 1e-12)[:, None]
    first = grid.first_crossings(eyes, carried + _BEYOND * cloud.size * fit.scale * ways / lengths)
    first *= 1 + _BEYOND * cloud.size * fit.scale / lengths[:, 0]  # of the way to the point
    margins = (SIGMAS * sigmas + 2 * grid.edge) / lengths[:, 0]
    crossed = (first < 1 - margins) | ((first > 1 + margins) & np.isfinite(first))
    reach = max(_REACH * cloud.size * fit.scale, 3 * scan.spacing)
    near = (gaps <= reach) & (np.abs(turned) > _ALIKE)
    likely = _INLIERS * np.exp(-0.5 * (off / sigmas) ** 2) / (np.sqrt(2 * np.pi) * sigmas)
    return Verdict(
        explained,
        ~explained & (crossed | (gaps <= reach)),
        near,
        np.log(np.where(near, likely * reach, 0) + (1 - _INLIERS) / 2)
        + _alike(cloud, scan, nearest, near),
        cells_of(cloud.points, cloud.size / _CELLS),
    )


def _alike(cloud: Cloud, scan: Scan, nearest: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Log likelihood ratio (N,) of how alike near points and their surfaces are in brightness.

    Ranks of both, made normal, either are of one bivariate normal distribution or independent.
    """
    logs = np.zeros(len(near))
    if scan.brightness is None or near.sum() < _LEAST_ALIKE:
        return logs
    a, b = _normal(cloud.brightness[near]), _normal(scan.brightness[nearest[near]])
    rho = float(np.clip(np.mean(a * b), 0.0, 0.95))
    gain = (rho * a * b - 0.5 * rho**2 * (a * a + b * b)) / (1 - rho**2)
    logs[near] = gain - 0.5 * np.log(1 - rho**2)
    return logs


def _normal(values: np.ndarray) -> np.ndarray:
    """Values (N,) made normal by their ranks, those alike sharing theirs."""
    return ndtri((rankdata(values) - 0.5) / len(values))
