"""Sparse Cholesky of symmetric systems of 6x6 blocks: pose graphs after elimination."""

import numpy as np

from factors.compiled import kernel_and_part

DIM = 6

_kernel, _part = kernel_and_part()


class BlockCholesky:
    """Factorization of one block pattern, for any number of systems that share it."""

    def __init__(self, num_blocks: int, pairs: np.ndarray) -> None:
        """Choose an elimination order (minimum degree) and find the fill.

        Args:
            num_blocks: N block rows.
            pairs: (P, 2) int, i < j, distinct: where off-diagonal blocks may be nonzero.
        """
        self.num_blocks = num_blocks
        self._pairs = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
        self.order = _minimum_degree(num_blocks, self._pairs)  # elimination place -> block
        self._place = np.empty(num_blocks, dtype=np.int64)
        self._place[self.order] = np.arange(num_blocks)
        placed = np.sort(self._place[self._pairs], axis=1)
        self._flip = self._place[self._pairs[:, 0]] < self._place[self._pairs[:, 1]]
        sort = np.lexsort((placed[:, 1], placed[:, 0]))
        starts = np.zeros(num_blocks + 1, dtype=np.int64)
        np.cumsum(np.bincount(placed[:, 0], minlength=num_blocks), out=starts[1:])
        self._starts, self._rows = _fill(num_blocks, starts, placed[sort, 1])
        self._slots = _find(self._starts, self._rows, placed)
        self._diagonal = np.empty((num_blocks, DIM, DIM))
        self._below = np.empty((len(self._rows), DIM, DIM))

    def factorize(self, diagonal: np.ndarray, off_diagonal: np.ndarray) -> bool:
        """Factorize H; False (and unusable) where it is not positive definite.

        Args:
            diagonal: (N, 6, 6), symmetric blocks H[i, i].
            off_diagonal: (P, 6, 6), blocks H[i, j] of the pairs.
        """
        np.take(diagonal, self.order, axis=0, out=self._diagonal)
        self._below[:] = 0.0
        # stored: block (row, column) below the diagonal, in elimination order
        oriented = off_diagonal.copy()
        oriented[self._flip] = np.swapaxes(off_diagonal[self._flip], 1, 2)
        self._below[self._slots] = oriented
        return bool(_factorize(self._starts, self._rows, self._diagonal, self._below))

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solve H x = right, both (N, 6)."""
        x = np.ascontiguousarray(right[self.order])
        _solve(self._starts, self._rows, self._diagonal, self._below, x)
        out = np.empty_like(x)
        out[self.order] = x
        return out

    def draw(self, normals: np.ndarray) -> np.ndarray:
        """Vectors (D, N, 6) of covariance H^-1 from as many independent unit normals."""
        x = np.ascontiguousarray(normals[:, self.order])
        _solve_each_upper(self._starts, self._rows, self._diagonal, self._below, x)
        out = np.empty_like(x)
        out[:, self.order] = x
        return out

    def inverse_blocks(self, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Blocks of the inverse of H (Takahashi's selected inversion).

        Args:
            pairs: (Q, 2) int, of the pattern, either index first.

        Returns:
            (N, 6, 6) those on the diagonal, (Q, 6, 6) those [i, j] of the pairs.
        """
        inverse = np.zeros_like(self._diagonal)
        inverse_below = np.zeros_like(self._below)
        _selected_inverse(
            self._starts, self._rows, self._diagonal, self._below, inverse, inverse_below
        )
        out = np.empty_like(inverse)
        out[self.order] = inverse
        placed = self._place[np.asarray(pairs, dtype=np.int64).reshape(-1, 2)]
        between = inverse_below[_find(self._starts, self._rows, np.sort(placed, axis=1))]
        flip = placed[:, 0] < placed[:, 1]
        between[flip] = np.swapaxes(between[flip], 1, 2)
        return out, between


def _minimum_degree(num: int, pairs: np.ndarray) -> np.ndarray:
    """Elimination order (N,) of a symmetric pattern: SuperLU's multiple minimum degree."""
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
    return np.argsort(factor.perm_c)


def _fill(num: int, starts: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Column structure of the factor: a column passes its rows on to its parent in the tree."""
    columns = [set(rows[starts[k] : starts[k + 1]].tolist()) for k in range(num)]
    for column in columns:
        if column:
            parent = min(column)
            columns[parent] |= column
            columns[parent].discard(parent)
    out = np.zeros(num + 1, dtype=np.int64)
    np.cumsum([len(column) for column in columns], out=out[1:])
    flat = [row for column in columns for row in sorted(column)]
    return out, np.array(flat, dtype=np.int64)


def _find(starts: np.ndarray, rows: np.ndarray, placed: np.ndarray) -> np.ndarray:
    """Slots in the factor of entries (column, row)."""
    num = len(starts) - 1
    keys = np.repeat(np.arange(num), np.diff(starts)) * num + rows
    return np.searchsorted(keys, placed[:, 0] * num + placed[:, 1])


@_part
def _factorize_block(a):
    """Lower Cholesky factor in place; False if not positive definite."""
    for j in range(DIM):
        for k in range(j):
            for i in range(j, DIM):
                a[i, j] -= a[i, k] * a[j, k]
        if not a[j, j] > 0:
            return False
        root = np.sqrt(a[j, j])
        for i in range(j, DIM):
            a[i, j] /= root
        for i in range(j):
            a[i, j] = 0.0
    return True


@_kernel
def _factorize(starts, rows, diagonal, below):
    """Right-looking block Cholesky in place: each column updates those that its rows name."""
    for k in range(len(diagonal)):
        D = diagonal[k]
        if not _factorize_block(D):
            return False
        first, last = starts[k], starts[k + 1]
        for s in range(first, last):  # B <- B D^-T
            B = below[s]
            for j in range(DIM):
                for i in range(DIM):
                    x = B[i, j]
                    for c in range(j):
                        x -= B[i, c] * D[j, c]
                    B[i, j] = x / D[j, j]
        for s in range(first, last):
            column, A = rows[s], below[s]
            _subtract_product(diagonal[column], A, A)
            slot = starts[column]
            for t in range(s + 1, last):
                while rows[slot] != rows[t]:
                    slot += 1
                _subtract_product(below[slot], below[t], A)
    return True


@_part
def _subtract_product(target, a, b):
    """target -= a b^T."""
    for i in range(DIM):
        for j in range(DIM):
            x = 0.0
            for c in range(DIM):
                x += a[i, c] * b[j, c]
            target[i, j] -= x


@_kernel
def _solve(starts, rows, diagonal, below, x):
    """Forward and back substitution in place."""
    num = len(diagonal)
    for k in range(num):
        for i in range(DIM):
            for c in range(i):
                x[k, i] -= diagonal[k, i, c] * x[k, c]
            x[k, i] /= diagonal[k, i, i]
        for s in range(starts[k], starts[k + 1]):
            for i in range(DIM):
                for c in range(DIM):
                    x[rows[s], i] -= below[s, i, c] * x[k, c]
    _solve_upper(starts, rows, diagonal, below, x)


@_kernel
def _solve_each_upper(starts, rows, diagonal, below, many):
    """Back substitution of vectors (D, N, 6) in place."""
    for d in range(len(many)):
        _solve_upper(starts, rows, diagonal, below, many[d])


@_part
def _solve_upper(starts, rows, diagonal, below, x):
    """Back substitution in place: x <- L^-T x."""
    for k in range(len(diagonal) - 1, -1, -1):
        for s in range(starts[k], starts[k + 1]):
            for c in range(DIM):
                for i in range(DIM):
                    x[k, i] -= below[s, c, i] * x[rows[s], c]
        for i in range(DIM - 1, -1, -1):
            for c in range(i + 1, DIM):
                x[k, i] -= diagonal[k, c, i] * x[k, c]
            x[k, i] /= diagonal[k, i, i]


@_kernel
def _selected_inverse(starts, rows, diagonal, below, inverse, inverse_below):
    """Entries of H^-1 on the pattern of the factor, last column first.

    With G = B D^-1 (unit lower factor), Z[rows, k] = -Z[rows, rows] G and
    Z[k, k] = D^-T D^-1 - G^T Z[rows, k]. Takahashi, Fagan, Chen, 1973.
    """
    longest = 0
    for k in range(len(diagonal)):
        longest = max(longest, starts[k + 1] - starts[k])
    G = np.empty((longest, DIM, DIM))
    eye = np.empty((DIM, DIM))
    for k in range(len(diagonal) - 1, -1, -1):
        D = diagonal[k]
        first, last = starts[k], starts[k + 1]
        eye[:] = 0.0
        for i in range(DIM):  # eye <- D^-1
            eye[i, i] = 1 / D[i, i]
            for j in range(i):
                x = 0.0
                for c in range(j, i):
                    x -= D[i, c] * eye[c, j]
                eye[i, j] = x / D[i, i]
        for s in range(first, last):
            for i in range(DIM):
                for j in range(DIM):
                    x = 0.0
                    for c in range(j, DIM):
                        x += below[s, i, c] * eye[c, j]
                    G[s - first, i, j] = x
        for s in range(first, last):
            column, g = rows[s], G[s - first]
            for i in range(DIM):
                for j in range(DIM):
                    for c in range(DIM):
                        inverse_below[s, i, j] -= inverse[column, i, c] * g[c, j]
            slot = starts[column]
            for t in range(s + 1, last):
                while rows[slot] != rows[t]:
                    slot += 1
                Z, h = inverse_below[slot], G[t - first]
                for i in range(DIM):
                    for j in range(DIM):
                        for c in range(DIM):
                            inverse_below[s, i, j] -= Z[c, i] * h[c, j]
                            inverse_below[t, i, j] -= Z[i, c] * g[c, j]
        for i in range(DIM):
            for j in range(DIM):
                x = 0.0
                for c in range(max(i, j), DIM):
                    x += eye[c, i] * eye[c, j]
                for s in range(first, last):
                    for c in range(DIM):
                        x -= G[s - first, c, i] * inverse_below[s, c, j]
                inverse[k, i, j] = x
