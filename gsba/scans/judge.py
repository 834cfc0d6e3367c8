"""Evidence of a scan for and against a cloud's placement: points on a surface are explained, those
whose ray crosses one before them or close behind are contradicted, others are neutral."""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from gsba.scans.fit import Noise, cells_of, reach_of, residuals_of
from gsba.scans.types import Cloud, Scan
from gsba.similarity import Sim3

SIGMAS = 3.0  # largest distance of an explained point from its surface, standard deviations
_MAX_GRID_CELLS = 400  # along the scan's extent
_MAX_BEHIND = 1.0  # part of the cloud's size: surfaces so far behind a point contradict it
_MIN_SINE = 0.15  # of the angle between a ray and a surface that it crosses


@dataclass(frozen=True, slots=True)
class ScanVerdict:
    """Evidence of a scan on a cloud's points, at one similarity."""

    explained: np.ndarray  # (N,) bool, points on a surface
    contradicted: np.ndarray  # (N,) bool, points that surfaces contradict
    informed: np.ndarray  # (N,) bool, points with evidence: near a surface, or hidden by one
    logs: np.ndarray  # (N,) float64, log likelihood ratios of their distances over uniform ones
    cells: tuple[np.ndarray, ...]  # each (N,) int64: cell of each point, in the cloud's world

    @property
    def share(self) -> float:
        """Share of the cloud's points that are explained."""
        return float(self.explained.mean())

    @property
    def agreement(self) -> float:
        """Share of explained points among explained and contradicted ones."""
        known = self.explained.sum() + self.contradicted.sum()
        return float(self.explained.sum() / max(known, 1))

    def doubt(self, other: "ScanVerdict") -> float:
        """P value of the lead over another placement, if the other were as good.

        It is by Wilcoxon's signed-rank test (Biometrics Bulletin 1, 1945) of log likelihood ratios,
        summed by cell, so that a piece of furniture with many points counts once. Only points with
        evidence in both placements count, as the scan may miss surfaces at one of them. The largest
        p value over several sizes of cells is taken: a lead that large cells do not show may come
        from errors that small cells share.
        """
        from scipy.stats import wilcoxon

        both = self.informed & other.informed
        gains = (self.logs - other.logs)[both]
        sums = [np.bincount(c[both], gains) for c in self.cells]
        sums = [some[some != 0] for some in sums]
        return max(
            float(np.asarray(wilcoxon(some, alternative="greater"))[1]) if len(some) else 1.0
            for some in sums
        )


class CellGrid:
    """Grid of a scan's surfaces: one point with its normal in each occupied cell."""

    def __init__(self, scan: Scan) -> None:
        extent = float(np.ptp(scan.points, axis=0).max())
        self.edge = max(extent / _MAX_GRID_CELLS, 5 * scan.spacing)
        self.low = scan.points.min(axis=0) - 1.5 * self.edge  # empty cells surround the scan
        self.shape = np.ceil((np.ptp(scan.points, axis=0)) / self.edge).astype(int) + 4
        self.rows = np.full(self.shape, -1, np.int32)
        at = self._cells(scan.points)
        self.rows[at[:, 0], at[:, 1], at[:, 2]] = np.arange(len(at))
        self.scan = scan

    def _cells(self, points: np.ndarray) -> np.ndarray:
        return np.clip(((points - self.low) / self.edge).astype(np.int64), 0, self.shape - 1)

    def first_crossings(self, eyes: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Part (N,) of each segment at its first crossing of a surface; infinite if it crosses
        none."""
        ways = ends - eyes
        lengths = np.linalg.norm(ways, axis=1)
        first = np.full(len(eyes), np.inf)
        steps = int(min(np.ceil(lengths.max(initial=0) / (0.7 * self.edge)), 4 * _MAX_GRID_CELLS))
        for k in range(1, steps + 1):
            part = np.minimum(k * 0.7 * self.edge / np.maximum(lengths, 1e-12), 1.0)
            open_ = np.flatnonzero(np.isinf(first) & (k * 0.7 * self.edge <= lengths))
            at = self._cells(eyes[open_] + part[open_, None] * ways[open_])
            rows = self.rows[at[:, 0], at[:, 1], at[:, 2]]
            met, rows = open_[rows >= 0], rows[rows >= 0]
            normals = self.scan.normals[rows]
            along = np.einsum("ni,ni->n", normals, ways[met])
            before = np.einsum("ni,ni->n", normals, self.scan.points[rows] - eyes[met])
            steep = np.abs(along) > _MIN_SINE * lengths[met]
            met, crossing = met[steep], before[steep] / along[steep]
            here = np.abs(crossing - part[met]) * lengths[met] <= 2 * self.edge
            first[met[here]] = crossing[here]
        return first


def verdict(fit: Sim3, cloud: Cloud, scan: Scan, grid: CellGrid, noise: Noise) -> ScanVerdict:
    """Evidence of a scan on a cloud at a similarity; `noise` of explained points' distances."""
    carried, nearest, off, gaps = residuals_of(fit, cloud, scan)
    variances = noise.variances(fit, cloud, scan, nearest)
    sigmas, size = np.sqrt(variances), cloud.size * fit.scale
    along = np.sqrt(np.maximum(gaps**2 - off**2, 0))
    here = along <= scan.reaches[nearest]
    explained = here & (np.abs(off) <= SIGMAS * sigmas)
    eyes = fit.points(cloud.eyes)
    ways = carried - eyes
    lengths = np.maximum(np.linalg.norm(ways, axis=1), 1e-12)[:, None]
    first = grid.first_crossings(eyes, carried + _MAX_BEHIND * size * ways / lengths)
    first *= 1 + _MAX_BEHIND * size / lengths[:, 0]  # relative to the distance of the point
    margins = (SIGMAS * sigmas + 2 * grid.edge) / lengths[:, 0]
    hidden = first < 1 - margins
    behind = (first > 1 + margins) & np.isfinite(first)
    reach = reach_of(fit, cloud)
    near = here & (np.abs(off) <= reach)
    contradicted = ~explained & (hidden | behind | near)
    logs = np.where(near, noise.logs(off, variances, reach), np.log(1 - noise.inliers))
    logs += _brightness_logs(cloud, scan, nearest, near)
    informed = near | hidden
    cells = tuple(cells_of(cloud.points, cloud.size / part) for part in (2, 4))
    return ScanVerdict(explained, contradicted, informed, np.where(informed, logs, 0.0), cells)


def _brightness_logs(cloud: Cloud, scan: Scan, nearest: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Log likelihood ratio (N,) of correlated brightness: bivariate normal scores or none."""
    logs = np.zeros(len(near))
    if scan.brightness is None or near.sum() < 100:
        return logs
    a, b = _normal(cloud.brightness[near]), _normal(scan.brightness[nearest[near]])
    rho = float(np.clip(np.mean(a * b), 0.0, 0.95))
    gain = (rho * a * b - 0.5 * rho**2 * (a * a + b * b)) / (1 - rho**2)
    logs[near] = gain - 0.5 * np.log(1 - rho**2)
    return logs


def _normal(values: np.ndarray) -> np.ndarray:
    """Normal scores (N,) of values by their ranks; ties share their mean rank."""
    from scipy.stats import rankdata  # takes long to import

    return ndtri((rankdata(values) - 0.5) / len(values))
