"""Parts of a map, bisected again and again (nested dissection: George, 1973). Each cut is the
smallest set of frames that covers all pairs between two halves: a minimum vertex cover of a
bipartite graph, found from a maximum matching (Koenig, 1931)."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, maximum_bipartite_matching


@dataclass(frozen=True, slots=True)
class Partition:
    """The part of each frame; no pair of frames lies in two parts unless one is on a cut."""

    homes: np.ndarray  # (F,) int64, part of each frame; of one on a cut, a part that it adjoins
    on_cut: np.ndarray  # (F,) bool

    @property
    def num_parts(self) -> int:
        """Number of parts."""
        return int(self.homes.max(initial=-1)) + 1

    def owners(self, frames: np.ndarray, items: np.ndarray, num_items: int) -> np.ndarray:
        """The part (I,) that owns each item: the one in which its frames (O,) lie, off the cuts;
        the first part owns an item without frames."""
        num = max(self.num_parts, 1)
        codes = self.homes[frames] + num * self.on_cut[frames]
        least = np.full(num_items, 2 * num)
        np.minimum.at(least, items, codes)
        return least % num


def partition(
    num_frames: int, pairs: np.ndarray, most: int, positions: np.ndarray | None = None
) -> Partition:
    """Cut frames into parts of at most `most` frames off the cuts, by tied pairs (P, 2) and rough
    positions (F, 3); None = by pairs alone."""
    on_cut, homes, num_parts = np.zeros(num_frames, bool), np.full(num_frames, -1), 0
    waiting = [(np.arange(num_frames), np.asarray(pairs, np.int64).reshape(-1, 2))]
    while waiting:
        rows, inner = waiting.pop()
        if len(rows) <= most:
            if len(rows):
                homes[rows], num_parts = num_parts, num_parts + 1
            continue
        sides = _bisected(len(rows), inner, None if positions is None else positions[rows])
        on_cut[rows[sides == 2]] = True
        for side in (1, 0):
            chosen = sides == side
            local = np.cumsum(chosen) - 1
            waiting.append((rows[chosen], local[inner[chosen[inner].all(axis=1)]]))
    return Partition(_homes_of_cuts(homes, on_cut, pairs), on_cut)


def _homes_of_cuts(homes: np.ndarray, on_cut: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Homes (F,); frames on cuts get the first part that they adjoin, perhaps through others."""
    far = np.iinfo(np.int64).max
    found = np.where(on_cut, far, homes)
    i, j = np.asarray(pairs).reshape(-1, 2).T
    while True:
        nearest = found.copy()
        np.minimum.at(nearest, i, found[j])
        np.minimum.at(nearest, j, found[i])
        nearest = np.where(found == far, nearest, found)
        if np.array_equal(nearest, found):
            return np.where(found == far, 0, found)
        found = nearest


def _bisected(num: int, pairs: np.ndarray, positions: np.ndarray | None) -> np.ndarray:
    """Side (N,) of each frame: 0, 1, or 2 on the cut; the smallest cut of some orders' best."""
    tied = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(num, num))
    best = None
    for order in _orders(num, (tied + tied.T).tocsr(), positions):
        sides = _cut(order, pairs)
        size = np.count_nonzero(sides == 2)
        if best is None or size < np.count_nonzero(best == 2):
            best = sides
    assert best is not None
    return best


def _orders(num: int, tied: csr_array, positions: np.ndarray | None) -> list[np.ndarray]:
    """Orders (N,) of frames along which a cut is looked for."""
    first, _ = breadth_first_order(tied, 0, return_predecessors=True)
    far, _ = breadth_first_order(tied, int(first[-1]), return_predecessors=True)
    others = np.setdiff1d(np.arange(num), far)  # what has no tie with these
    orders = [np.concatenate([far, others])]
    if positions is not None:
        centred = positions - positions.mean(axis=0)
        _, axes = np.linalg.eigh(centred.T @ centred)
        across, along = axes[:, 1], axes[:, 2]
        for axis in (along, across, along + across, along - across):
            orders.append(np.argsort(np.round(centred @ axis, 6), kind="stable"))
    return orders


def _cut(order: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Sides (N,) of a cut across an order, where the fewest pairs cross it."""
    num = len(order)
    rank = np.empty(num, np.int64)
    rank[order] = np.arange(num)
    low, high = np.sort(rank[pairs], axis=1).T
    change = np.bincount(low + 1, minlength=num + 2) - np.bincount(high + 1, minlength=num + 2)
    crossing = np.cumsum(change)  # pairs between the first c frames and the rest, for each c
    least = max(1, int(0.35 * num))  # frames on the smaller side of a cut
    places = np.arange(least, max(num - least, least) + 1)
    places = places[np.lexsort((np.abs(2 * places - num), crossing[places]))]
    where = int(places[0])
    across = (low < where) & (high >= where)
    sides = (rank >= where).astype(np.int64)
    covered = _cover(low[across], high[across] - where, where, num - where)
    sides[order[covered]] = 2
    return sides


def _cover(left: np.ndarray, right: np.ndarray, num_left: int, num_right: int) -> np.ndarray:
    """Fewest vertices that touch all edges of a bipartite graph, right ones behind left ones."""
    edges = coo_array((np.ones(len(left)), (left, right)), shape=(num_left, num_right)).tocsr()
    match = maximum_bipartite_matching(edges, perm_type="column")  # of each left vertex
    partner = np.full(num_right, -1)
    partner[match[match >= 0]] = np.flatnonzero(match >= 0)
    reached_left, reached_right = match < 0, np.zeros(num_right, bool)
    front = np.flatnonzero(reached_left)
    while len(front):
        seen = edges[front].indices
        seen = np.unique(seen[~reached_right[seen]])
        reached_right[seen] = True
        front = partner[seen]
        front = front[(front >= 0) & ~reached_left[front]]
        reached_left[front] = True
    kept = np.flatnonzero(~reached_left), num_left + np.flatnonzero(reached_right)
    return np.concatenate(kept)
