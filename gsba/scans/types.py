"""What is registered: a run's cloud, and a scan of the same place."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.spatial import KDTree

from gsba.log import GsbaError
from gsba.types import Reconstruction

NEIGHBOURS = 24  # of a scan's point, that tell of the surface around it
MIN_POINTS = 300  # of a cloud that can be registered
_CHUNK = 50_000  # points looked up at once
_RAYS = 3  # of a point: two meet anywhere
_SURE = 0.02  # of the cloud's size: standard deviation of a point beyond which it is left out


@dataclass(frozen=True)
class Scan:
    """Points on surfaces; world of the scan's file = points + offset."""

    points: np.ndarray  # (M, 3) float64, unit of the scan
    normals: np.ndarray  # (M, 3) float64, unit, of either sign
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))  # (3,) float64
    brightness: np.ndarray | None = None  # (M,) float64, of any scale; None = it has no colours
    scatters: np.ndarray | None = None  # (M,) float64, standard deviations of neighbours about the
    # plane of a point where they share none, else 0; None = 0 everywhere

    @cached_property
    def tree(self) -> KDTree:
        """Of the points."""
        return KDTree(self.points)

    @cached_property
    def reaches(self) -> np.ndarray:
        """How far (M,) around each point its plane holds: as far as its neighbours are."""
        parts = np.array_split(self.points, -(-len(self.points) // _CHUNK))
        some = min(NEIGHBOURS, len(self.points))
        return np.concatenate([self.tree.query(part, some)[0][:, -1] for part in parts])

    @cached_property
    def reach(self) -> float:
        """That of all but the few sparsest places."""
        return float(np.quantile(self.reaches, 0.99))

    def variances(self, rows: np.ndarray) -> np.ndarray:
        """Of the planes at points, by index (N,), along their normals: where there is none."""
        return np.zeros(len(rows)) if self.scatters is None else self.scatters[rows] ** 2

    @cached_property
    def spacing(self) -> float:
        """Median distance of a point to its next."""
        some = self.points[:: max(1, len(self.points) // 5000)]
        return float(np.median(self.tree.query(some, 2)[0][:, 1]))


@dataclass(frozen=True)
class Cloud:
    """A run's points that rays determine well."""

    points: np.ndarray  # (N, 3) float64, map units
    covariances: np.ndarray  # (N, 3, 3) float64, squared map units, poses being exact
    eyes: np.ndarray  # (N, 3) float64: where a frame that sees each point was
    rows: np.ndarray  # (N,) int64: which points of the reconstruction they are
    normals: np.ndarray  # (N, 3) float64, unit, of either sign
    brightness: np.ndarray  # (N,) float64, of any scale

    @cached_property
    def size(self) -> float:
        """See `size_of`."""
        return size_of(self.points)

    def at(self, points: np.ndarray) -> "Cloud":
        """The same with its points elsewhere (N, 3)."""
        return replace(self, points=points)

    def mirrored(self) -> "Cloud":
        """The same with x the other way: of a place that no turn makes into this one."""
        flip = np.array([-1.0, 1, 1])
        return replace(
            self,
            points=self.points * flip,
            covariances=self.covariances * np.outer(flip, flip),
            eyes=self.eyes * flip,
            normals=self.normals * flip,
        )

    def taken(self, rows: np.ndarray) -> "Cloud":
        """Some of the points, by index (N',)."""
        parts = ("points", "covariances", "eyes", "rows", "normals", "brightness")
        return replace(self, **{name: getattr(self, name)[rows] for name in parts})


def size_of(points: np.ndarray) -> float:
    """Root mean square distance of points (N, 3) from their middle, but for the outermost."""
    off = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return float(np.sqrt(np.mean(off[off <= np.quantile(off, 0.95)] ** 2)))


def cloud_of(
    reconstruction: Reconstruction, normals_of: Callable[[np.ndarray], np.ndarray]
) -> Cloud:
    """The points that rays determine to a fiftieth of the cloud's size.

    A point's information is the sum over its rays of what is square to them, the noise of the
    observation times the distance being the standard deviation.

    Args:
        normals_of: unit normals (N, 3) of points (N, 3), by their neighbours.

    Raises:
        GsbaError: too few such points.
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
    seen = counts >= _RAYS
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
        cloud = cloud.taken(1 / np.sqrt(values[every, 0]) <= _SURE * cloud.size)
    if len(cloud.points) < MIN_POINTS:
        raise GsbaError(
            f"the run has {len(cloud.points)} points that its rays determine well; a scan needs "
            f"{MIN_POINTS}"
        )
    return replace(cloud, normals=normals_of(cloud.points))
