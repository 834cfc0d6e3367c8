"""Surfaces under the points of a scan: planes through neighbours, which average noise."""

import numpy as np
from scipy.spatial import KDTree

from gsba.scans.types import NEIGHBOURS

_POINTS_AT_ONCE = 50_000
_MIN_FLAT_SHARE = 0.1  # of points that are on planes: this quantile of the scatter is noise
_MAX_SCATTER_RATIO = 3.5  # of a point's scatter to that noise, if its neighbours share a plane


def on_planes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (N, 3) projected to their neighbours' planes, unit normals (N, 3), and scatters (N,).

    Independent noise shrinks with the square root of the number of neighbours. Without the
    projection, alignment would keep all of it and prefer points whose noise happens to fit. Near
    edges, where neighbours share no plane, points are not moved, and their scatter is the standard
    deviation of their neighbours about the plane; elsewhere it is 0.
    """
    tree = KDTree(points)
    neighbours = min(NEIGHBOURS, len(points))
    normals, offsets, scatters = [], [], []
    for start in range(0, len(points), _POINTS_AT_ONCE):
        some = points[start : start + _POINTS_AT_ONCE]
        around = points[tree.query(some, neighbours)[1]]
        middles = around.mean(axis=1)
        around = around - middles[:, None]
        values, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around) / neighbours)
        normals.append(axes[:, :, 0])
        offsets.append(np.einsum("ni,ni->n", axes[:, :, 0], middles - some))
        scatters.append(np.sqrt(np.maximum(values[:, 0], 0)))
    across, off, scatter = (np.concatenate(parts) for parts in (normals, offsets, scatters))
    flat = scatter <= _MAX_SCATTER_RATIO * np.quantile(scatter, _MIN_FLAT_SHARE)
    laid = points + np.where(flat, off, 0)[:, None] * across
    return laid, across, np.where(flat, 0, scatter)
