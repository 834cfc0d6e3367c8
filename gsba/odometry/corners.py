"""New features of a keyframe: corners, spread evenly over the sphere."""

import cv2
import numpy as np

from gsba.camera.rig import cells_of, owner_faces
from gsba.odometry.atlas import Atlas, AtlasLayout

_PER_SIDE = 11  # cells along a side of a cube face, 8 degrees each
_BLOCK = 5  # pixels across the patch of which gradients are summed
_APART_PX = 5  # least distance between features
_MIN_EIGENVALUE = 3e-5  # least eigenvalue of a patch's gradients, in OpenCV's normalisation: less
# is noise
_NOISES = 4.0  # least response of a corner, in median responses of a picture's flattest quarter


def new_corners(
    layout: AtlasLayout, atlas: Atlas, usable: np.ndarray | None, known: np.ndarray
) -> np.ndarray:
    """Bearings (N, 3), rig frame, of corners in cells with too few features.

    Args:
        usable: (2 s, 3 s) bool, pixels of the scene; None = all.
        known: (M, 3) bearings, rig frame, of features followed so far.
    """
    response = cv2.cornerMinEigenVal(atlas.image, _BLOCK)
    allowed = layout.owned if usable is None else layout.owned & usable
    floor = max(_MIN_EIGENVALUE, _NOISES * _flat(response, allowed))
    peaks = (response == cv2.dilate(response, np.ones((5, 5)))) & (response > floor) & allowed
    taken = np.zeros(6 * _PER_SIDE**2, int)
    if len(known):
        along = known @ atlas.cut_R_rig.T
        np.add.at(taken, cells_of(along, _PER_SIDE), 1)
        _block(peaks, layout, along)
    v, u = np.nonzero(peaks)
    order = np.argsort(-response[v, u], kind="stable")
    v, u = v[order], u[order]
    faces = (v // layout.rig.size) * 3 + u // layout.rig.size
    bearings = layout.bearings(np.stack([u, v], axis=1).astype(float), faces)
    cells = cells_of(bearings, _PER_SIDE)
    kept = _strongest(cells, 1 - taken)  # features in a cell, including followed ones
    kept = kept[_apart(np.stack([u, v], axis=1)[kept])]
    return bearings[kept] @ atlas.cut_R_rig


def _flat(response: np.ndarray, allowed: np.ndarray) -> float:
    """Median response of the flattest quarter of a picture: that of noise, if walls are bare."""
    some = response[::4, ::4][allowed[::4, ::4]]
    return float(np.quantile(some, 0.125)) if len(some) else 0.0


def _block(peaks: np.ndarray, layout: AtlasLayout, along: np.ndarray) -> None:
    """Clear `peaks` around known features, bearings (M, 3) along the axes of the cut."""
    faces = owner_faces(along).astype(np.int64)
    for u, v in np.rint(layout.pixels(along, faces)).astype(int):
        top, left = max(v - _APART_PX, 0), max(u - _APART_PX, 0)
        peaks[top : v + _APART_PX + 1, left : u + _APART_PX + 1] = False


def _strongest(cells: np.ndarray, room: np.ndarray) -> np.ndarray:
    """Rows (N',) of the first `room[cell]` entries of each cell (N,), given in falling order."""
    order = np.argsort(cells, kind="stable")
    starts = np.searchsorted(cells[order], np.arange(len(room)))
    rank = np.empty(len(cells), int)
    rank[order] = np.arange(len(cells)) - starts[cells[order]]
    return np.flatnonzero(rank < room[cells])


def _apart(pixels: np.ndarray) -> np.ndarray:
    """Rows of pixels (N, 2), in falling order, at least `_APART_PX` from all earlier ones."""
    from scipy.spatial import KDTree

    if len(pixels) < 2:
        return np.arange(len(pixels))
    pairs = KDTree(pixels).query_pairs(_APART_PX, output_type="ndarray")
    out = np.zeros(len(pixels), bool)
    out[pairs.max(axis=1)] = True
    return np.flatnonzero(~out)
