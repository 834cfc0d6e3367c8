"""Surfaces under the points of a scan: planes through neighbours, noise left out."""

import numpy as np
from scipy.spatial import KDTree

from gsba.scans.types import NEIGHBOURS

_CHUNK = 50_000  # points at once
_FLAT = 0.1  # of all places, at least, are flat: their scatter is noise
_ROUGH = 3.5  # times that: neighbours that scatter more share no plane


def on_planes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (N, 3) laid on the planes through their neighbours, unit normals (N, 3), and scatters.

    Noise that neighbours do not share shrinks with the square root of their number; whoever takes
    single points for surfaces inherits all of it, and is drawn to the point whose noise suits best.
    Near edges, where neighbours share no plane, points stay, and have the standard deviation (N,)
    of their neighbours about it; elsewhere that is 0.
    """
    tree = KDTree(points)
    neighbours = min(NEIGHBOURS, len(points))
    normals, offsets, scatters = [], [], []
    for start in range(0, len(points), _CHUNK):
        some = points[start : start + _CHUNK]
        around = points[tree.query(some, neighbours)[1]]
        middles = around.mean(axis=1)
        around = around - middles[:, None]
        values, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around) / neighbours)
        normals.append(axes[:, :, 0])
        offsets.append(np.einsum("ni,ni->n", axes[:, :, 0], middles - some))
        scatters.append(np.sqrt(np.maximum(values[:, 0], 0)))
    across, off, scatter = (np.concatenate(parts) for parts in (normals, offsets, scatters))
    flat = scatter <= _ROUGH * np.quantile(scatter, _FLAT)
    laid = points + np.where(flat, off, 0)[:, None] * across
    return laid, across, np.where(flat, 0, scatter)
