"""Distances of a run's cloud to a scan."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from gsba.scans.types import Scan

_NUM_BINS = 30  # of a histogram


@dataclass(frozen=True, slots=True)
class Distances:
    """Distances of a cloud's points to the surfaces of a scan."""

    values: np.ndarray  # (N,) float64, unit of the scan
    explained: float  # share of points on a surface, see `gsba.scans.judge`

    @property
    def median(self) -> float:
        """Median distance."""
        return float(np.median(self.values))

    @property
    def percentile90(self) -> float:
        """90th percentile of the distances."""
        return float(np.quantile(self.values, 0.9))

    def histogram(self, furthest: float) -> tuple[np.ndarray, np.ndarray]:
        """Counts (B + 1,), the last one of distances beyond `furthest`, and edges (B + 1,)."""
        edges = np.linspace(0, furthest, _NUM_BINS + 1)
        counts = np.histogram(self.values, edges)[0]
        return np.append(counts, np.sum(self.values > furthest)), edges

    def to_json(self, furthest: float) -> dict[str, Any]:
        """Plain values for JSON; the histogram spans distances up to `furthest`."""
        counts, edges = self.histogram(furthest)
        return {
            "points": len(self.values),
            "median": self.median,
            "percentile90": self.percentile90,
            "explained": self.explained,
            "histogram": {"edges": edges.tolist(), "counts": counts.tolist()},
        }


def distances_to(scan: Scan, points: np.ndarray) -> np.ndarray:
    """Distances (N,) of points (N, 3) to a scan's surfaces.

    The distance is to the plane of the nearest scan point if its foot is within the range of that
    point's neighbours, so that the scan's spacing adds no error; else to the scan point.
    """
    gaps, nearest = scan.tree.query(points)
    off = np.einsum("ni,ni->n", scan.normals[nearest], points - scan.points[nearest])
    along = np.sqrt(np.maximum(gaps**2 - off**2, 0))
    return np.where(along <= scan.reaches[nearest], np.abs(off), gaps)
