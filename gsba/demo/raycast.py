"""Ray casting by a stackless bounding-volume hierarchy over triangles and parallelograms."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import NamedTuple

import numba
import numpy as np

from factors.compiled import kernel_and_part

kernel, part = kernel_and_part()


class Scene(NamedTuple):
    """Faces, their hierarchy, textures and baked light. World: x right, y down, z forward.

    A face is the set corner + a edge_a + b edge_b with a, b >= 0: a parallelogram (a, b <= 1) or
    a triangle (a + b <= 1). Seen from its front, edge_a points right and edge_b down.
    """

    corners: np.ndarray  # (Q, 3) float64, units
    edges: np.ndarray  # (Q, 2, 3) float64, units: edge_a, edge_b
    duals: np.ndarray  # (Q, 2, 3) float64: a, b = duals @ (x - corner)
    normals: np.ndarray  # (Q, 3) float64, unit, to the front
    spans: np.ndarray  # (Q,) float64, bound on a + b: 2 parallelogram, 1 triangle
    textures: np.ndarray  # (Q,) int64, row of `levels`
    windows: np.ndarray  # (Q, 4) float64, texels of level 0: s, t at the corner, extent in s, t
    emissions: np.ndarray  # (Q,) float64, radiance of the face itself
    node_low: np.ndarray  # (N, 3) float64, box of a node, depth-first order
    node_high: np.ndarray  # (N, 3) float64
    node_skip: np.ndarray  # (N,) int64, next node when this box is missed
    node_face: np.ndarray  # (N,) int64, the one face of a leaf, -1 for inner nodes
    texels: np.ndarray  # (T, 3) uint8, RGB albedo, all levels of all textures
    levels: np.ndarray  # (num_textures, num_levels, 3) int64: offset into texels, width, height
    albedos: np.ndarray  # (num_textures, 3) float64, mean of each texture, 0..1
    light_grids: np.ndarray  # (Q, 3) int64: offset into light, columns along a, rows along b
    light: np.ndarray  # (M, 3) float64, irradiance / pi


@part
def face_distance(scene, q, o, d, limit):
    """Distance along the ray to face q, or `limit` if it is not hit before that."""
    n, c, w = scene.normals, scene.corners, scene.duals
    along = n[q, 0] * d[0] + n[q, 1] * d[1] + n[q, 2] * d[2]
    x, y, z = c[q, 0] - o[0], c[q, 1] - o[1], c[q, 2] - o[2]
    t = (n[q, 0] * x + n[q, 1] * y + n[q, 2] * z) / along
    if not (1e-6 < t < limit):
        return limit
    x, y, z = t * d[0] - x, t * d[1] - y, t * d[2] - z
    a = w[q, 0, 0] * x + w[q, 0, 1] * y + w[q, 0, 2] * z
    b = w[q, 1, 0] * x + w[q, 1, 1] * y + w[q, 1, 2] * z
    e = 1e-9
    if a < -e or b < -e or a > 1 + e or b > 1 + e or a + b > scene.spans[q] + e:
        return limit
    return t


@part
def nearest(scene, o, d, limit):
    """Distance and index of the first face on the ray o + t d; (limit, -1) if there is none.

    Args:
        o, d: three numbers each, origin and direction (any length; t is in its units).
        limit: largest distance of interest.
    """
    best, found = limit, -1
    ix, iy, iz = 1 / d[0], 1 / d[1], 1 / d[2]
    low, high = scene.node_low, scene.node_high
    i = 0
    while i < len(scene.node_skip):
        x0, x1 = (low[i, 0] - o[0]) * ix, (high[i, 0] - o[0]) * ix
        y0, y1 = (low[i, 1] - o[1]) * iy, (high[i, 1] - o[1]) * iy
        z0, z1 = (low[i, 2] - o[2]) * iz, (high[i, 2] - o[2]) * iz
        near = max(min(x0, x1), min(y0, y1), min(z0, z1), 0.0)
        far = min(max(x0, x1), max(y0, y1), max(z0, z1), best)
        if near > far:
            i = scene.node_skip[i]
            continue
        q = scene.node_face[i]
        if q >= 0:
            t = face_distance(scene, q, o, d, best)
            if t < best:
                best, found = t, q
        i += 1
    return best, found


@part
def coordinates(scene, q, o, d, t):
    """Face coordinates a, b of the point o + t d."""
    c, w = scene.corners, scene.duals
    x, y, z = o[0] + t * d[0] - c[q, 0], o[1] + t * d[1] - c[q, 1], o[2] + t * d[2] - c[q, 2]
    return (
        w[q, 0, 0] * x + w[q, 0, 1] * y + w[q, 0, 2] * z,
        w[q, 1, 0] * x + w[q, 1, 1] * y + w[q, 1, 2] * z,
    )


def in_bands(kernel: Callable[..., None], count: int, *args: object) -> None:
    """Run kernel(start, stop, *args) over bands of range(count) in numba's number of threads.

    The kernels release the GIL; plain threads spare them the compile time of parallel=True.
    """
    # 64 bands, whatever the number of threads
    bounds = np.unique(np.linspace(0, count, 65).astype(np.int64))
    with ThreadPoolExecutor(numba.get_num_threads()) as pool:
        list(pool.map(lambda band: kernel(*band, *args), pairwise(bounds.tolist())))


@kernel
def _trace(start, stop, scene, origin, directions, out):
    o = (origin[0], origin[1], origin[2])
    for i in range(start, stop):
        d = (directions[i, 0], directions[i, 1], directions[i, 2])
        t, q = nearest(scene, o, d, np.inf)
        if q >= 0:
            out[i] = t


def ranges(scene: Scene, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distances (N,) float64 along unit directions (N, 3) to the first face; 0 = nothing."""
    origin = np.ascontiguousarray(origin, dtype=np.float64)
    directions = np.ascontiguousarray(directions, dtype=np.float64)
    out = np.zeros(len(directions))
    in_bands(_trace, len(directions), scene, origin, directions, out)
    return out
