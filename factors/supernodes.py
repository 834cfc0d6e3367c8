"""Supernodes of a sparse Cholesky factor: runs of columns with common rows below."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from factors.compiled import kernel_and_part

_kernel, _ = kernel_and_part()

# A run may absorb the one before it if few zeros arise: up to a number of columns, a share of the
# entries (columns here are blocks of 6).
_RELAXED = ((2, 0.8), (6, 0.2), (np.inf, 0.05))


@dataclass(frozen=True, slots=True)
class Supernodes:
    """Columns in elimination order, cut into runs; a run comes after its children in the tree."""

    order: np.ndarray  # (N,) elimination place -> block
    starts: np.ndarray  # (S + 1,) first column of each run
    rows: tuple[np.ndarray, ...]  # S times (r,) places of the rows below a run, ascending
    parents: np.ndarray  # (S,) run that receives the update of each, -1 = none


def find_supernodes(num: int, pairs: np.ndarray, num_kept: int = 0) -> Supernodes:
    """Order a symmetric pattern, pairs (P, 2) int64, i < j, distinct, by minimum degree and find
    the supernodes of its factor. The last num_kept rows come last in the order, as they are, and
    are a supernode of their own; `pairs` must pair each of them with each. What is found of small
    patterns is kept, as models of short walks share a few.

    Liu, "The role of elimination trees in sparse factorization", 1990; runs are relaxed as in
    Ashcraft and Grimes, 1989.
    """
    if len(pairs) > 2048:  # 32 kB
        return _supernodes_of(num, pairs, num_kept)
    return _kept_supernodes(num, pairs.tobytes(), num_kept)


@lru_cache(maxsize=64)
def _kept_supernodes(num: int, pairs: bytes, num_kept: int) -> Supernodes:
    return _supernodes_of(num, np.frombuffer(pairs, np.int64).reshape(-1, 2), num_kept)


def _supernodes_of(num: int, pairs: np.ndarray, num_kept: int) -> Supernodes:
    from scipy.sparse import coo_matrix, identity
    from scipy.sparse.linalg import splu

    ones = np.ones(len(pairs))
    upper = coo_matrix((ones, (pairs[:, 0], pairs[:, 1])), shape=(num, num))
    dominant = (upper + upper.T) * (0.5 / max(num, 1)) + identity(num)
    factor = splu(
        dominant.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    order, cut = np.argsort(factor.perm_c), num - num_kept
    if num_kept:
        order = np.concatenate([order[order < cut], np.arange(cut, num)])
    order = order[_postorder(_tree(*_upper(num, pairs, order)))]
    starts, columns = _upper(num, pairs, order)
    firsts, rows = _fundamental(starts, columns, cut)
    return Supernodes(order, *_relaxed(firsts, rows, num, cut))


def _upper(num: int, pairs: np.ndarray, order: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Offsets (N + 1,) and, row by row, the later places that each place is paired with."""
    place = np.empty(num, dtype=np.int64)
    place[order] = np.arange(num)
    placed = np.sort(place[pairs], axis=1)
    placed = placed[np.lexsort((placed[:, 1], placed[:, 0]))]
    starts = np.zeros(num + 1, dtype=np.int64)
    np.cumsum(np.bincount(placed[:, 0], minlength=num), out=starts[1:])
    return starts, np.ascontiguousarray(placed[:, 1])


@_kernel
def _tree(starts, columns):
    """Parents (N,) in the elimination tree, -1 for a root, of a pattern given by `_upper`."""
    num = len(starts) - 1
    offsets, filled = np.empty(num + 1, np.int64), np.empty(num, np.int64)
    parents, ancestors = np.empty(num, np.int64), np.empty(num, np.int64)
    earlier = np.empty(len(columns), np.int64)
    for j in range(num + 1):
        offsets[j] = 0
    for s in range(len(columns)):
        offsets[columns[s] + 1] += 1
    for j in range(num):
        offsets[j + 1] += offsets[j]
        filled[j], parents[j], ancestors[j] = offsets[j], -1, -1
    for i in range(num):
        for s in range(starts[i], starts[i + 1]):
            earlier[filled[columns[s]]] = i
            filled[columns[s]] += 1
    for j in range(num):
        for s in range(offsets[j], offsets[j + 1]):
            node = earlier[s]
            while node != -1 and node < j:
                following = ancestors[node]
                ancestors[node] = j
                if following == -1:
                    parents[node] = j
                node = following
    return parents


@_kernel
def _postorder(parents):
    """Nodes (N,) of a tree, children before parents and each with its subtree in one run."""
    num = len(parents)
    first, following = np.empty(num, np.int64), np.empty(num, np.int64)
    out, stack, count = np.empty(num, np.int64), np.empty(num, np.int64), 0
    for k in range(num):
        first[k] = following[k] = -1
    for k in range(num - 1, -1, -1):
        if parents[k] != -1:
            following[k] = first[parents[k]]
            first[parents[k]] = k
    for root in range(num):
        if parents[root] != -1:
            continue
        depth, stack[0] = 1, root
        while depth:
            node = stack[depth - 1]
            child = first[node]
            if child == -1:
                out[count] = node
                count += 1
                depth -= 1
            else:
                first[node] = following[child]
                stack[depth] = child
                depth += 1
    return out


def _fundamental(
    starts: np.ndarray, columns: np.ndarray, cut: int
) -> tuple[list[int], list[np.ndarray]]:
    """First columns of a postordered pattern's runs (one at `cut`), and the rows below each end."""
    num = len(starts) - 1
    firsts: list[int] = []
    rows: list[np.ndarray] = []  # of each run so far; of the last one from its last column on
    waiting: dict[int, list[np.ndarray]] = {}  # rows that children pass on to a column
    for k in range(num):
        own = columns[starts[k] : starts[k + 1]]
        handed = waiting.pop(k, [])
        if len(handed) == 1 and np.isin(own, handed[0], assume_unique=True).all():
            merged = handed[0][1:]
        else:
            merged = np.unique(np.concatenate([own, *(rest[1:] for rest in handed)]))
        joins = firsts and k != cut and len(rows[-1]) and rows[-1][0] == k
        if joins and len(merged) == len(rows[-1]) - 1:
            rows[-1] = merged
        else:
            firsts.append(k)
            rows.append(merged)
        if len(merged):
            waiting.setdefault(int(merged[0]), []).append(merged)
    return firsts, rows


def _relaxed(
    firsts: list[int], rows: list[np.ndarray], num: int, cut: int
) -> tuple[np.ndarray, tuple[np.ndarray, ...], np.ndarray]:
    """Starts, rows and parents of runs, small ones absorbed by the next (not over `cut`)."""
    kept: list[tuple[int, int, np.ndarray, int]] = []  # first, end, rows, zeros
    for first, end, below in zip(firsts, [*firsts, num][1:], rows, strict=True):
        zeros = 0
        while kept and first != cut:
            start, stop, under, hidden = kept[-1]
            if not len(under) or not first <= under[0] < end:
                break
            more = hidden + zeros + (stop - start) * (end - first + len(below) - len(under))
            width = end - start
            entries = width * (width + 1) // 2 + width * len(below)
            if not any(width <= most and more <= part * entries for most, part in _RELAXED):
                break
            first, zeros = start, more
            kept.pop()
        kept.append((first, end, below, zeros))
    starts = np.array([*(run[0] for run in kept), num], dtype=np.int64)
    below = tuple(run[2] for run in kept)
    nexts = np.array([r[0] if len(r) else num for r in below], dtype=np.int64)
    parents = np.searchsorted(starts, nexts, side="right") - 1
    return starts, below, np.where(nexts < num, parents, -1)
