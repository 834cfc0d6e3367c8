"""Sparse Cholesky of symmetric systems of 6x6 blocks: pose graphs after elimination."""

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import get_blas_funcs, get_lapack_funcs

from factors.compiled import kernel_and_part
from factors.supernodes import find_supernodes

DIM = 6

_kernel, _ = kernel_and_part()

syrk, trsm, trsv = get_blas_funcs(("syrk", "trsm", "trsv"), dtype=np.float64)
potrf, trtri = get_lapack_funcs(("potrf", "trtri"), dtype=np.float64)


def _nothing() -> np.ndarray:
    return np.empty((0, 0))


@dataclass(slots=True)
class _Front:
    """A run of columns with the rows below it: local block indices of entries, and its factor."""

    first: int  # column
    width: int  # W columns
    rows: np.ndarray  # (R,) places of the rows below
    slots: np.ndarray  # (E,) pairs of the system that lie in these columns
    places: np.ndarray  # (E, 2) local row and column of each
    flips: np.ndarray  # (E,) bool, True if the pair's block is transposed
    above: np.ndarray  # (R,) local places of the rows in the parent's front
    lower: np.ndarray = field(
        default_factory=_nothing
    )  # (6 W, 6 W) factor of the columns' own block
    below: np.ndarray = field(default_factory=_nothing)  # (6 R, 6 W) factor under it

    @property
    def own(self) -> slice:
        """Scalar columns in a vector of all places."""
        return slice(DIM * self.first, DIM * (self.first + self.width))

    @property
    def under(self) -> np.ndarray:
        """(6 R,) scalar rows in a vector of all places."""
        return (DIM * self.rows[:, None] + np.arange(DIM)).ravel()


class BlockCholesky:
    """Factorization of one block pattern, for any number of systems that share it.

    Multifrontal over supernodes (Duff and Reid, 1983), so that dense kernels of BLAS and LAPACK do
    the arithmetic, however many blocks fill in.

    Attributes:
        complement: (6 K, 6 K) the Schur complement of the system on the blocks that were kept, in
            the lower triangle; after `factorize`.
    """

    def __init__(self, num_blocks: int, pairs: np.ndarray, num_kept: int = 0) -> None:
        """Choose an elimination order (minimum degree) and find the fill, of off-diagonal blocks of
        pairs (P, 2), i < j, distinct, that may be nonzero. The last num_kept blocks are not
        eliminated: `factorize` then leaves their Schur complement, and `reduced` and `substituted`
        replace `solve`."""
        self.num_blocks, self.num_kept = num_blocks, num_kept
        self.complement = _nothing()
        pairs = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
        pattern = pairs
        if num_kept:
            clique = np.column_stack(np.triu_indices(num_kept, 1)) + (num_blocks - num_kept)
            pattern = np.unique(np.concatenate([pairs, clique]), axis=0)
        runs = find_supernodes(num_blocks, pattern, num_kept)
        self.order = runs.order  # elimination place -> block
        self._place = np.empty(num_blocks, dtype=np.int64)
        self._place[self.order] = np.arange(num_blocks)
        self._starts, self._parents = runs.starts, runs.parents
        columns, rows = np.sort(self._place[pairs], axis=1).T
        flips = self._place[pairs[:, 0]] < self._place[pairs[:, 1]]
        by_column = np.argsort(columns, kind="stable")
        bounds = np.searchsorted(columns[by_column], runs.starts)
        self._fronts: list[_Front] = []
        for s, below in enumerate(runs.rows):
            first, width = int(runs.starts[s]), int(runs.starts[s + 1] - runs.starts[s])
            slots = by_column[bounds[s] : bounds[s + 1]]
            local = _local(rows[slots], first, width, below)
            places = np.column_stack([local, columns[slots] - first])
            front = _Front(first, width, below, slots, places, flips[slots], below)
            self._fronts.append(front)
        for front, parent in zip(self._fronts, self._parents, strict=True):
            if parent >= 0:
                over = self._fronts[parent]
                front.above = _local(front.rows, over.first, over.width, over.rows)

    @property
    def num_operations(self) -> int:
        """Floating-point operations of a factorization, about."""
        sizes = [(DIM * (f.width + len(f.rows)), DIM * len(f.rows)) for f in self._fronts]
        return sum((whole**3 - rest**3) // 3 for whole, rest in sizes)

    @property
    def num_entries(self) -> int:
        """Number of entries of the factor."""
        widths = [(DIM * f.width, DIM * len(f.rows)) for f in self._fronts]
        return sum(width * (width + 1) // 2 + width * rest for width, rest in widths)

    def factorize(self, diagonal: np.ndarray, off_diagonal: np.ndarray) -> bool:
        """Factorize H of symmetric blocks H[i, i] (N, 6, 6) and blocks H[i, j] (P, 6, 6) of the
        pairs; False (and unusable) if it is not positive definite."""
        for front in self._fronts:  # the factor before is not held beside the new one
            front.lower = front.below = _nothing()
        updates: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
        for s, front in enumerate(self._fronts):
            width, num = DIM * front.width, DIM * len(front.rows)
            lower = np.zeros((width, width), order="F")
            below, rest = np.zeros((num, width), order="F"), np.zeros((num, num), order="F")
            blocks = diagonal[self.order[front.first : front.first + front.width]]
            _fill(lower, below, blocks, off_diagonal, front.slots, front.places, front.flips)
            for update, above in updates.pop(s, []):
                _extend(lower, below, rest, update, above)
            if self.num_kept and s == len(self._fronts) - 1:
                self.complement = lower
                break
            lower, failed = potrf(lower, lower=1, clean=1, overwrite_a=1)
            if failed or not np.isfinite(lower[-1, -1]):
                return False
            if num:
                below = trsm(1.0, lower, below, side=1, lower=1, trans_a=1, overwrite_b=1)
                rest = syrk(-1.0, below, beta=1.0, c=rest, lower=1, overwrite_c=1)
                updates.setdefault(int(self._parents[s]), []).append((rest, front.above))
            front.lower, front.below = lower, below
        return True

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solve H x = right, both (N, 6)."""
        return self._backward(self._forward(right))

    def solve_all(self, rights: np.ndarray) -> np.ndarray:
        """Solve H x = right for several right sides at once, both (D, N, 6)."""
        x = self._by_place(rights)
        for front in self._fronts:
            x[front.own] = trsm(1.0, front.lower, x[front.own], lower=1)
            x[front.under] -= front.below @ x[front.own]
        return self._all_backward(x)

    def reduced(self, right: np.ndarray) -> np.ndarray:
        """Right side (K, 6) of the complement's system, given that of the whole one, (N, 6)."""
        return self._forward(right).reshape(-1, DIM)[self.num_blocks - self.num_kept :]

    def substituted(self, right: np.ndarray, kept: np.ndarray) -> np.ndarray:
        """Solve H x = right, both (N, 6), given x at the blocks that were kept, (K, 6)."""
        x = self._forward(right)
        x[DIM * (self.num_blocks - self.num_kept) :] = kept.ravel()
        return self._backward(x)

    @property
    def _eliminated(self) -> list[_Front]:
        return self._fronts[:-1] if self.num_kept else self._fronts

    def _forward(self, right: np.ndarray) -> np.ndarray:
        """L^-1 right (6 N,), by elimination place."""
        x = right[self.order].ravel()
        for front in self._eliminated:
            x[front.own] = trsv(front.lower, x[front.own], lower=1)
            x[front.under] -= front.below @ x[front.own]
        return x

    def _backward(self, x: np.ndarray) -> np.ndarray:
        """L^-T x (N, 6), by block, of x (6 N,) by elimination place, which changes."""
        for front in reversed(self._eliminated):
            rest = x[front.own] - front.below.T @ x[front.under]
            x[front.own] = trsv(front.lower, rest, lower=1, trans=1)
        out = np.empty((self.num_blocks, DIM))
        out[self.order] = x.reshape(-1, DIM)
        return out

    def draw(self, normals: np.ndarray) -> np.ndarray:
        """Vectors (D, N, 6) of covariance H^-1 from as many independent unit normals; where blocks
        were kept, these hold what was drawn of them, from the covariance of their own system."""
        return self._all_backward(self._by_place(normals))

    def _by_place(self, vectors: np.ndarray) -> np.ndarray:
        """Columns (6 N, D), by elimination place, of vectors (D, N, 6)."""
        rows = vectors[:, self.order].reshape(len(vectors), DIM * self.num_blocks)
        return np.ascontiguousarray(rows.T)

    def _all_backward(self, x: np.ndarray) -> np.ndarray:
        """L^-T x (D, N, 6), by block, of columns x (6 N, D) by elimination place, which change."""
        for front in reversed(self._eliminated):
            rest = x[front.own] - front.below.T @ x[front.under]
            x[front.own] = trsm(1.0, front.lower, rest, lower=1, trans_a=1)
        out = np.empty((x.shape[1], self.num_blocks, DIM))
        out[:, self.order] = x.T.reshape(out.shape)
        return out

    def inverse_blocks(
        self, pairs: np.ndarray, kept: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Diagonal blocks (N, 6, 6) of the inverse of H, and its blocks [i, j] (Q, 6, 6) of pairs
        (Q, 2) of the pattern, in either order; kept: (6 K, 6 K) the inverse at the blocks that were
        kept.

        Takahashi's selected inversion, front by front: with G = L21 L11^-1, Z21 = -Z22 G and Z11 =
        (L11 L11^T)^-1 - G^T Z21. Takahashi, Fagan, Chen, 1973.
        """
        pairs = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
        placed = np.sort(self._place[pairs], axis=1)
        owners = np.searchsorted(self._starts, placed[:, 0], side="right") - 1
        inverse = np.empty((self.num_blocks, DIM, DIM))
        between = np.empty((len(pairs), DIM, DIM))
        waiting = np.bincount(self._parents[self._parents >= 0], minlength=len(self._fronts))
        whole: dict[int, np.ndarray] = {}  # of fronts with unprocessed children
        for s in range(len(self._fronts) - 1, -1, -1):
            front, parent = self._fronts[s], int(self._parents[s])
            if kept is not None and s == len(self._fronts) - 1:
                Z = kept
            else:
                width, num = DIM * front.width, DIM * len(front.rows)
                Z = np.empty((width + num, width + num))
                root, _ = trtri(front.lower, lower=1)
                Z[:width, :width] = root.T @ root
                if num:
                    at = (DIM * front.above[:, None] + np.arange(DIM)).ravel()
                    Z[width:, width:] = whole.get(parent, _nothing())[at[:, None], at]
                    G = front.below @ root
                    Z[width:, :width] = -Z[width:, width:] @ G
                    Z[:width, width:] = Z[width:, :width].T
                    Z[:width, :width] -= G.T @ Z[width:, :width]
            if parent >= 0:
                waiting[parent] -= 1
                if not waiting[parent]:
                    del whole[parent]
            if waiting[s]:
                whole[s] = Z
            tiles = Z.reshape(Z.shape[0] // DIM, DIM, -1, DIM)
            own = np.arange(front.width)
            inverse[self.order[front.first + own]] = tiles[own, :, own]
            asked = np.flatnonzero(owners == s)
            rows = _local(placed[asked, 1], front.first, front.width, front.rows)
            between[asked] = tiles[rows, :, placed[asked, 0] - front.first]
        flip = self._place[pairs[:, 0]] < self._place[pairs[:, 1]]
        between[flip] = np.swapaxes(between[flip], 1, 2)
        return inverse, between


def _local(places: np.ndarray, first: int, width: int, rows: np.ndarray) -> np.ndarray:
    """Local places of a front, given places that belong to it: its columns', then its rows'."""
    return np.where(places < first + width, places - first, width + np.searchsorted(rows, places))


@_kernel
def _fill(lower, below, diagonal, off_diagonal, slots, places, flips):
    """Copy the blocks of a system into a front of zeros."""
    for k in range(len(diagonal)):
        for c in range(DIM):
            for r in range(DIM):
                lower[DIM * k + r, DIM * k + c] = diagonal[k, r, c]
    for e in range(len(slots)):
        block, row, column = off_diagonal[slots[e]], places[e, 0] * DIM, places[e, 1] * DIM
        target = lower
        if row >= lower.shape[0]:
            target, row = below, row - lower.shape[0]
        for c in range(DIM):
            for r in range(DIM):
                target[row + r, column + c] = block[c, r] if flips[e] else block[r, c]


@_kernel
def _extend(lower, below, rest, update, above):
    """Add a child's update, in its lower triangle, to a front."""
    width = lower.shape[0]
    for k in range(len(above)):
        for i in range(k, len(above)):
            row, column = above[i] * DIM, above[k] * DIM
            target = lower
            if column >= width:
                target, row, column = rest, row - width, column - width
            elif row >= width:
                target, row = below, row - width
            for c in range(DIM):
                for r in range(DIM):
                    target[row + r, column + c] += update[DIM * i + r, DIM * k + c]
