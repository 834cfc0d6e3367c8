"""Point cloud of a run, and scan of the same place, for registration."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from gsba.log import GsbaError
from gsba.types import Reconstruction
from gsba.types.records import with_rows

NEIGHBOURS = 24  # of a scan's point, through which its plane is fitted
MIN_POINTS = 300  # of a cloud that can be registered
POINTS_AT_ONCE = 50_000
_MAX_POINT_SIGMA = 0.02  # of a used point, part of the cloud's size


@dataclass(frozen=True)
class Scan:
    """Points on surfaces; world of the scan's file = points + offset."""

    points: np.ndarray  # (M, 3) float64, unit of the scan
    normals: np.ndarray  # (M, 3) float64, unit, of either sign
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))  # (3,) float64
    brightness: np.ndarray | None = None  # (M,) float64, of any scale; None = it has no colours
    scatters: np.ndarray | None = None  # (M,) float64, standard deviation of neighbours about a
    # point's plane if they share none, else 0; None = 0 everywhere

    @cached_property
    def tree(self) -> KDTree:
        """Tree of the points."""
        return KDTree(self.points)

    @cached_property
    def reaches(self) -> np.ndarray:
        """Radius (M,) of the plane around each point: the distance of its furthest neighbour."""
        parts = np.array_split(self.points, -(-len(self.points) // POINTS_AT_ONCE))
        some = min(NEIGHBOURS, len(self.points))
        return np.concatenate([self.tree.query(part, some)[0][:, -1] for part in parts])

    @cached_property
    def reach(self) -> float:
        """99th percentile of `reaches`."""
        return float(np.quantile(self.reaches, 0.99))

    def variances(self, rows: np.ndarray) -> np.ndarray:
        """Variances (N,) along the normal of the planes at points `rows` (N,)."""
        return np.zeros(len(rows)) if self.scatters is None else self.scatters[rows] ** 2

    @cached_property
    def spacing(self) -> float:
        """Median distance of a point to its nearest neighbour."""
        some = self.points[:: max(1, len(self.points) // 5000)]
        return float(np.median(self.tree.query(some, 2)[0][:, 1]))


@dataclass(frozen=True)
class Cloud:
    """Points of a run with small covariances."""

    points: np.ndarray  # (N, 3) float64, map units
    covariances: np.ndarray  # (N, 3, 3) float64, squared map units, for exact poses
    eyes: np.ndarray  # (N, 3) float64, position of a frame that observes each point, map units
    rows: np.ndarray  # (N,) int64, rows of these points in the reconstruction
    normals: np.ndarray  # (N, 3) float64, unit, of either sign
    brightness: np.ndarray  # (N,) float64, of any scale

    @cached_property
    def size(self) -> float:
        """Size of the cloud, see `size_of`."""
        return size_of(self.points)

    def mirrored(self) -> "Cloud":
        """Cloud mirrored along x, which no rotation maps to this one."""
        flip = np.array([-1.0, 1, 1])
        return replace(
            self,
            points=self.points * flip,
            covariances=self.covariances * np.outer(flip, flip),
            eyes=self.eyes * flip,
            normals=self.normals * flip,
        )


def size_of(points: np.ndarray) -> float:
    """RMS distance of points (N, 3) from their median, without the 5 % furthest."""
    off = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return float(np.sqrt(np.mean(off[off <= np.quantile(off, 0.95)] ** 2)))


def cloud_of(
    reconstruction: Reconstruction, normals_of: Callable[[np.ndarray], np.ndarray]
) -> Cloud:
    """Cloud of the points whose sigma is below a fiftieth of the cloud's size.

    A point's information is summed over its rays: each adds that of its two perpendicular
    directions, with the noise of the observation times the distance as standard deviation.

    Args:
        normals_of: computes unit normals (N, 3) of points (N, 3) from their neighbours.

    Raises:
        GsbaError: there are too few such points.
    """
    result, owners = reconstruction, reconstruction.observation_points
    centres = result.world_T_rigs[result.observation_frames, :3, 3]
    rays = result.points_world[owners] - centres
    lengths = np.maximum(np.linalg.norm(rays, axis=1), 1e-12)
    rays = rays / lengths[:, None]
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    information = np.zeros((len(result.points_world), 3, 3))
    sigmas = result.observation_sigmas * lengths
    np.add.at(information, owners, across / sigmas[:, None, None] ** 2)
    values, axes = np.linalg.eigh(information)
    values = np.maximum(values, 1e-12 * values[:, 2:].clip(1e-300))
    covariances = np.einsum("nij,nj,nkj->nik", axes, 1 / values, axes)
    first = np.searchsorted(owners, np.arange(len(result.points_world)))
    counts = np.bincount(owners, minlength=len(result.points_world))
    seen = counts >= 3  # two wrong rays may also meet
    middle = np.minimum(first + counts // 2, max(len(owners) - 1, 0))
    every = np.flatnonzero(seen)
    cloud = Cloud(
        result.points_world[every],
        covariances[every],
        centres[middle[every]],
        every,
        np.zeros((len(every), 3)),
        result.point_colors[every].mean(axis=1),
    )
    if len(every) >= MIN_POINTS:
        cloud = with_rows(cloud, 1 / np.sqrt(values[every, 0]) <= _MAX_POINT_SIGMA * cloud.size)
    if len(cloud.points) < MIN_POINTS:
        raise GsbaError(
            f"the run has {len(cloud.points)} points with a sigma below "
            f"{100 * _MAX_POINT_SIGMA:.0f} % of its size; alignment to a scan needs {MIN_POINTS}"
        )
    return replace(cloud, normals=normals_of(cloud.points))


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

    def to_json(self, furthest: float) -> dict[str, Any]:
        """Plain values for JSON; the histogram spans distances up to `furthest`, and its last count
        is of those beyond."""
        edges = np.linspace(0, furthest, 31)
        counts = np.append(np.histogram(self.values, edges)[0], np.sum(self.values > furthest))
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
