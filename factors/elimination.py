"""Elimination of landmarks from linearized observations with any frame variables."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import block_array, bsr_array, csr_array

from factors._observations import covisible_pairs
from factors.compiled import kernel_and_part

_kernel, _part = kernel_and_part(fastmath={"contract"})


@_part
def _span_of_point(by_point, lo, hi, damping, Q):
    """Orthonormal columns Q of the range of a landmark's Jacobian with three rows of damping."""
    rows, squares = 2 * (hi - lo), 1e-200
    for o in range(lo, hi):
        for i in range(2):
            for c in range(3):
                x = by_point[o, i, c]
                Q[2 * (o - lo) + i, c] = x
                squares += x * x
    for r in range(3):
        for c in range(3):
            Q[rows + r, c] = np.sqrt(damping * squares) if r == c else 0.0
    for c in range(3):
        for _ in range(2):  # the second pass removes rounding errors
            for d in range(c):
                along = 0.0
                for r in range(rows + 3):
                    along += Q[r, c] * Q[r, d]
                for r in range(rows + 3):
                    Q[r, c] -= along * Q[r, d]
        norm = 0.0
        for r in range(rows + 3):
            norm += Q[r, c] * Q[r, c]
        norm = np.sqrt(norm)
        for r in range(rows + 3):
            Q[r, c] /= norm


@_part
def _add_row(row, r, q, H, g, W):
    """Add a row of a Jacobian to the normal equations and to its projection on the landmark."""
    for k in range(len(g)):
        a = row[k]
        g[k] += a * r
        W[0, k] += q[0] * a
        W[1, k] += q[1] * a
        W[2, k] += q[2] * a
        for c in range(len(g)):
            H[k, c] += a * row[c]


@_part
def _add_linear(residuals, own, common, Q, H, g, T, W, shared, shared_gradient, V, b):
    """Add an observation's Jacobians by frame variables and by shared ones; returns its cost."""
    cost = 0.0
    for i in range(2):
        r, q = residuals[i], Q[i]
        cost += 0.5 * r * r
        for d in range(3):
            b[d] += q[d] * r
        _add_row(own[i], r, q, H, g, W)
        _add_row(common[i], r, q, shared, shared_gradient, V)
        for k in range(len(g)):
            for c in range(len(shared)):
                T[k, c] += own[i, k] * common[i, c]
    return cost


@_part
def _take_products(A, B, out):
    """out -= A^T B, for A and B with three rows each."""
    for k in range(A.shape[1]):
        x, y, z = A[0, k], A[1, k], A[2, k]
        for c in range(B.shape[1]):
            out[k, c] -= x * B[0, c] + y * B[1, c] + z * B[2, c]


@_part
def _take_products_with(A, b, out):
    """out -= A^T b."""
    for k in range(A.shape[1]):
        out[k] -= A[0, k] * b[0] + A[1, k] * b[1] + A[2, k] * b[2]


@_part
def _eliminate_linear(
    j, offsets, frames, residuals, by_point, by_frame, by_shared, damping, row_starts, columns,
    diagonal, off_diagonal, to_shared, shared, gradient, shared_gradient, scratch,
):  # fmt: skip
    """`eliminate_linear_range` of landmark j; returns its cost."""
    seen, Q, W, V, b = scratch
    lo, hi = offsets[j], offsets[j + 1]
    _span_of_point(by_point, lo, hi, damping, Q)
    V[:], b[:] = 0.0, 0.0
    num, previous, cost = 0, -1, 0.0
    for o in range(lo, hi):
        f = frames[o]
        if f != previous:
            seen[num], previous = f, f
            W[num] = 0.0
            num += 1
        cost += _add_linear(
            residuals[o], by_frame[o], by_shared[o], Q[2 * (o - lo) : 2 * (o - lo) + 2],
            diagonal[f], gradient[f], to_shared[f], W[num - 1], shared, shared_gradient, V, b,
        )  # fmt: skip
    cost -= 0.5 * (b[0] * b[0] + b[1] * b[1] + b[2] * b[2])
    _take_products(V, V, shared)
    _take_products_with(V, b, shared_gradient)
    for i in range(num):
        f = seen[i]
        _take_products(W[i], W[i], diagonal[f])
        _take_products(W[i], V, to_shared[f])
        _take_products_with(W[i], b, gradient[f])
        slot = row_starts[f]
        for m in range(i + 1, num):
            while columns[slot] != seen[m]:
                slot += 1
            _take_products(W[i], W[m], off_diagonal[slot])
    return cost


@_kernel
def eliminate_linear_range(
    first, last, offsets, frames, residuals, by_point, by_frame, by_shared, damping, longest,
    row_starts, columns, diagonal, off_diagonal, to_shared, shared, gradient, shared_gradient,
):  # fmt: skip
    """Add landmarks first..last of a linear least-squares problem, eliminated; returns the cost.

    A landmark's range is projected out with orthonormal columns: a landmark that its observations
    hardly constrain in some direction adds no more rounding error than they have themselves.

    Args:
        offsets (J + 1,), frames (O,): observations by landmark, those of a frame adjacent.
        residuals (O, 2), by_point (O, 2, 3), by_frame (O, 2, K), by_shared (O, 2, S): whitened.
        damping: damping of a landmark, part of the sum of squares of its Jacobian.
        row_starts (F + 1,), columns (P,): covisible frame pairs i < k as sorted CSR rows.
        diagonal (F, K, K), off_diagonal (P, K, K), to_shared (F, K, S), shared (S, S),
        gradient (F, K), shared_gradient (S,): accumulated.
    """
    seen = np.empty(longest, np.int64)
    Q, W = np.empty((2 * longest + 3, 3)), np.empty((longest, 3, by_frame.shape[2]))
    scratch = seen, Q, W, np.empty((3, by_shared.shape[2])), np.empty(3)
    cost = 0.0
    for j in range(first, last):
        cost += _eliminate_linear(
            j, offsets, frames, residuals, by_point, by_frame, by_shared, damping, row_starts,
            columns, diagonal, off_diagonal, to_shared, shared, gradient, shared_gradient, scratch,
        )  # fmt: skip
    return cost


_RELATIVE_DAMPING = 1e-12  # damping of a landmark, part of the sum of squares of its Jacobian


@dataclass(frozen=True, slots=True)
class LinearSystem:
    """Normal equations over K variables of each frame, frame after frame, then S shared ones."""

    cost: float  # at the linearization point
    gradient: np.ndarray  # (F K + S,) at the linearization point
    hessian: csr_array  # (F K + S, F K + S)


@dataclass(slots=True)
class Eliminated:
    """Sums of a linear least-squares problem whose landmarks are eliminated, run by run; variables
    are K of each frame and S of all frames."""

    starts: np.ndarray  # (F + 1,) int64 and
    columns: np.ndarray  # (P,) int64: covisible frame pairs f < g as sorted CSR rows
    diagonal: np.ndarray  # (F, K, K) float64
    off_diagonal: np.ndarray  # (P, K, K)
    to_shared: np.ndarray  # (F, K, S)
    shared: np.ndarray  # (S, S)
    gradient: np.ndarray  # (F, K)
    shared_gradient: np.ndarray  # (S,)
    cost: float = 0.0  # half the squares that no landmark takes up

    @classmethod
    def zeros(cls, starts: np.ndarray, columns: np.ndarray, own: int, common: int) -> "Eliminated":
        """Nothing added yet, of `own` variables of each frame and `common` ones of all."""
        num, pairs = len(starts) - 1, len(columns)
        sums = np.zeros((num, own, own)), np.zeros((pairs, own, own)), np.zeros((num, own, common))
        of_all = np.zeros((common, common)), np.zeros((num, own)), np.zeros(common)
        return cls(starts, columns, *sums, *of_all)

    def add(
        self,
        offsets: np.ndarray,
        frames: np.ndarray,
        residuals: np.ndarray,
        by_point: np.ndarray,
        by_frame: np.ndarray,
        by_shared: np.ndarray,
    ) -> None:
        """Add landmarks: each has observations offsets[j] to offsets[j + 1], sorted by frame; see
        `eliminate`."""
        self.cost += eliminate_linear_range(
            0, len(offsets) - 1, offsets, frames, residuals, by_point, by_frame, by_shared,
            _RELATIVE_DAMPING, int(np.diff(offsets).max(initial=0)), self.starts, self.columns,
            self.diagonal, self.off_diagonal, self.to_shared, self.shared, self.gradient,
            self.shared_gradient,
        )  # fmt: skip

    def system(self) -> LinearSystem:
        """The sums as one sparse system."""
        num, own, common = self.to_shared.shape
        size, rows = num * own, np.arange(num + 1)
        above = bsr_array((self.off_diagonal, self.columns, self.starts), shape=(size, size))
        among = above + above.T + bsr_array((self.diagonal, rows[:-1], rows), shape=(size, size))
        across = self.to_shared.reshape(size, common)
        hessian = block_array(
            [[among, csr_array(across)], [csr_array(across.T), csr_array(self.shared)]]
        )
        whole = np.concatenate([self.gradient.ravel(), self.shared_gradient])
        return LinearSystem(self.cost, whole, csr_array(hessian))


def eliminate(
    num_frames: int,
    frames: np.ndarray,
    points: np.ndarray,
    residuals: np.ndarray,
    by_point: np.ndarray,
    by_frame: np.ndarray,
    by_shared: np.ndarray,
) -> Eliminated:
    """The Schur complement of landmarks in a linear least-squares problem of whitened residuals (O,
    2), each of a frame and a landmark (O,); their Jacobians by the landmark (O, 2, 3), by the
    variables of the frame (O, 2, K) and by the shared variables (O, 2, S)."""
    own, common = by_frame.shape[2], by_shared.shape[2]
    order = np.lexsort((frames, points))
    frames, points = np.asarray(frames)[order].astype(np.int64), np.asarray(points)[order]
    offsets = np.flatnonzero(np.diff(points, prepend=-1, append=-1))
    starts, columns, _ = covisible_pairs(offsets, frames, num_frames)
    sums = Eliminated.zeros(starts, columns, own, common)
    sums.add(offsets, frames, residuals[order], by_point[order], by_frame[order], by_shared[order])
    return sums
