"""Whether a cloud is where a similarity puts it in a scan: what is there, and what is in between.

A point with a surface of the scan at it is explained. One whose ray meets a surface before it, or
close behind it, is contradicted; one of which the scan shows nothing says nothing.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from gsba.scans.fit import cells_of
from gsba.scans.noise import Noise, reach_of, residuals_of
from gsba.scans.types import Cloud, Scan
from gsba.similarity import Sim3

SIGMAS = 3.0  # from its surface that an explained point may be
_CELLS_ALONG = 400  # of the scan's grid along its extent, at most
_BEYOND = 1.0  # of a cloud's size: how far behind a point surfaces contradict it
_LEAST_SINE = 0.15  # of a ray to a surface that it crosses
_LEAST_ALIKE = 100  # near points whose brightness can be compared
_CELLS = (2, 4)  # to a cloud's size: points within share their luck


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a scan says of a cloud's points, at a similarity."""

    explained: np.ndarray  # (N,) bool
    contradicted: np.ndarray  # (N,) bool
    told: np.ndarray  # (N,) bool: beside a surface, or hidden by one
    logs: np.ndarray  # (N,) float64, of likelihoods of their distances over those of any others
    cells: tuple[np.ndarray, ...]  # each (N,) int64: points nearby, in the cloud's own world

    @property
    def share(self) -> float:
        """Of the cloud that is explained."""
        return float(self.explained.mean())

    @property
    def agreement(self) -> float:
        """Explained, of all that the scan says something about."""
        said = self.explained.sum() + self.contradicted.sum()
        return float(self.explained.sum() / max(said, 1))

    def doubt(self, other: "Verdict") -> float:
        """P value of the lead over another placement: its chance, were the other as good.

        Of Wilcoxon's signed ranks (Biometrics Bulletin 1, 1945) of log likelihood ratios by cell:
        no piece of furniture has more than one say, however many points it has. Points are those
        that both placements are told of, as what is missing in the scan at one place and not at
        the other tells nothing. The largest for some sizes of cells is taken, as a lead that large
        cells do not show may come from errors that small ones share.
        """
        both = self.told & other.told
        gains = (self.logs - other.logs)[both]
        return max(_chance(np.bincount(c[both], gains)) for c in self.cells)


def _chance(gains: np.ndarray) -> float:
    """P value of gains (C,) being no better than symmetric around zero."""
    from scipy.stats import wilcoxon

    gains = gains[gains != 0]
    if not len(gains):
        return 1.0
    return float(np.asarray(wilcoxon(gains, alternative="greater"))[1])


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


def verdict(fit: Sim3, cloud: Cloud, scan: Scan, grid: Grid, noise: Noise) -> Verdict:
    """What a scan says of a cloud.

    Args:
        noise: of distances from explained points to their surface.
    """
    carried, nearest, off, gaps = residuals_of(fit, cloud, scan)
    variances = noise.variances(fit, cloud, scan, nearest)
    sigmas, size = np.sqrt(variances), cloud.size * fit.scale
    along = np.sqrt(np.maximum(gaps**2 - off**2, 0))
    here = along <= scan.reaches[nearest]
    explained = here & (np.abs(off) <= SIGMAS * sigmas)
    eyes = fit.points(cloud.eyes)
    ways = carried - eyes
    lengths = np.maximum(np.linalg.norm(ways, axis=1), 1e-12)[:, None]
    first = grid.first_crossings(eyes, carried + _BEYOND * size * ways / lengths)
    first *= 1 + _BEYOND * size / lengths[:, 0]  # of the way to the point
    margins = (SIGMAS * sigmas + 2 * grid.edge) / lengths[:, 0]
    hidden = first < 1 - margins
    behind = (first > 1 + margins) & np.isfinite(first)
    reach = reach_of(fit, cloud)
    near = here & (np.abs(off) <= reach)
    contradicted = ~explained & (hidden | behind | near)
    logs = np.where(near, noise.logs(off, variances, reach), np.log(1 - noise.inliers))
    logs += _alike(cloud, scan, nearest, near)
    told = near | hidden
    cells = tuple(cells_of(cloud.points, cloud.size / part) for part in _CELLS)
    return Verdict(explained, contradicted, told, np.where(told, logs, 0.0), cells)


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
    from scipy.stats import rankdata  # takes long to import

    return ndtri((rankdata(values) - 0.5) / len(values))
