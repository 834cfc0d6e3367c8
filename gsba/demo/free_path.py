"""Closed path through the free space of an unknown scene, above its floor."""

from collections.abc import Callable

import numpy as np
from scipy.ndimage import gaussian_filter1d, label
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from gsba.demo.mesh import DOWN

_EYE_RANGE = (0.25, 0.75)  # of the camera's height, part of the height from floor to ceiling


def free_path(
    low: np.ndarray,
    high: np.ndarray,
    clearance: Callable[[np.ndarray], np.ndarray],
    seen: Callable[[np.ndarray, np.ndarray], np.ndarray],
    num: int,
) -> tuple[np.ndarray | None, float]:
    """Positions spaced evenly along a closed path at one height, away from surfaces.

    The height with the largest connected free room is taken, whose floor must be level in most of
    the room. The path visits stops far from each other, by shortest paths weighted by clearance.

    Args:
        low, high: (3,) corners of the space; x right, y down, z forward.
        clearance: function from points (N, 3) to distances (N,) to the nearest surface.
        seen: function from points (N, 3) and a direction (3,) to distances (N,) to the first
            surface in that direction; inf = none.
        num: number of positions.

    Returns:
        (num, 3) positions, None if there is no free room; and the median clearance.
    """
    edge = float(np.max((high - low)[[0, 2]])) / 90
    x = np.arange(low[0] + edge / 2, high[0], edge)
    z = np.arange(low[2] + edge / 2, high[2], edge)
    best, room = 0, None
    where = at = np.zeros((0, 0, 3))
    for y in np.linspace(low[1], high[1], 26)[1:-1]:
        grid = np.stack(np.meshgrid(x, np.array([y]), z, indexing="ij"), axis=-1).reshape(-1, 3)
        free = clearance(grid)
        open_ = _walkable(free, seen(grid, DOWN), seen(grid, -DOWN), edge)
        walkable = open_.reshape(len(x), len(z))
        found = label(walkable)
        assert isinstance(found, tuple)
        cells = found[0]
        counts = np.bincount(cells.ravel())
        counts[0] = 0
        largest = int(np.argmax(counts))
        if counts[largest] > best:
            best, room = int(counts[largest]), cells == largest
            at = free.reshape(room.shape)
            where = grid.reshape(*room.shape, 3)
    if room is None or best < 60:
        return None, 0.0
    way = _round(room, at)
    points = where[way[:, 0], way[:, 1]]
    points = gaussian_filter1d(points, 3.0, axis=0, mode="wrap")  # rounds corners
    points = np.concatenate([points, points[:1]])
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    stops = np.linspace(0, length[-1], num, endpoint=False)
    even = np.stack([np.interp(stops, length, points[:, k]) for k in range(3)], axis=1)
    return even, float(np.median(clearance(even)))


def _walkable(free: np.ndarray, below: np.ndarray, above: np.ndarray, edge: float) -> np.ndarray:
    """Positions (N,) bool that a camera may take: clear of surfaces, above the prevailing floor."""
    part = np.where(np.isfinite(above), below / np.maximum(below + above, 1e-12), 0.5)
    walkable = (
        (free > 2.5 * edge) & np.isfinite(below) & (part > _EYE_RANGE[0]) & (part < _EYE_RANGE[1])
    )
    if not walkable.any():
        return walkable
    return walkable & (np.abs(below - np.median(below[walkable])) < 2 * edge)


def _round(room: np.ndarray, clearance: np.ndarray) -> np.ndarray:
    """Cells (N, 2) of a closed path through a room (X, Z) bool, by stops far from each other."""
    cells = np.argwhere(room)
    number = np.full(room.shape, -1)
    number[room] = np.arange(len(cells))
    rows, columns, costs = [], [], []
    for step in ((0, 1), (1, 0), (1, 1), (1, -1)):
        to = cells + step
        inside = (to >= 0).all(axis=1) & (to < room.shape).all(axis=1)
        there = np.full(len(cells), -1)
        there[inside] = number[to[inside, 0], to[inside, 1]]
        linked = np.flatnonzero(there >= 0)
        rows.append(linked)
        columns.append(there[linked])
        costs.append(np.hypot(*step) / clearance[cells[linked, 0], cells[linked, 1]])
    shape = (len(cells), len(cells))
    graph = coo_matrix(
        (np.concatenate(costs), (np.concatenate(rows), np.concatenate(columns))), shape=shape
    ).tocsr()
    start = int(np.argmax(clearance[room]))
    stops = [int(np.argmax(dijkstra(graph, directed=False, indices=start)))]
    for _ in range(5):  # stops that the path visits besides the first
        apart = dijkstra(graph, directed=False, indices=stops, min_only=True)
        stops.append(int(np.argmax(apart)))
    middle = cells.mean(axis=0)
    stops.sort(key=lambda n: float(np.arctan2(*(cells[n] - middle))))
    way: list[int] = []
    for here, there in zip(stops, [*stops[1:], stops[0]], strict=True):
        before = dijkstra(graph, directed=False, indices=there, return_predecessors=True)[1]
        while here != there:
            way.append(here)
            here = int(before[here])
    return cells[np.array(way)]
