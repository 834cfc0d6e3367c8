"""Preconditioned conjugate gradients on symmetric systems of 6x6 blocks."""

from collections.abc import Callable

import numpy as np

from factors.cholesky import DIM
from factors.compiled import kernel_and_part

_kernel, _ = kernel_and_part()


def conjugate_gradients(
    diagonal: np.ndarray,
    off_diagonal: np.ndarray,
    pairs: np.ndarray,
    right: np.ndarray,
    precondition: Callable[[np.ndarray], np.ndarray],
    tolerance: float,
    max_iterations: int,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Solve H x = right. Hestenes and Stiefel, 1952.

    Args:
        diagonal: (N, 6, 6), symmetric blocks H[i, i].
        off_diagonal: (P, 6, 6), blocks H[i, j] of the pairs.
        pairs: (P, 2) int64, i < j.
        right: (N, 6).
        precondition: about H^-1 applied to (N, 6), symmetric positive definite.
        tolerance: of the residual in the preconditioner's norm, part of what it is at x = 0.
        max_iterations: products with H.

    Returns:
        x (N, 6) and the residual right - H x; None where they do not get that far, or where H turns
        out not to be positive definite.
    """
    x, residual = np.zeros_like(right), right.copy()
    better = precondition(residual)
    direction, product = better.copy(), np.empty_like(right)
    squared = float(np.vdot(residual, better))
    enough = tolerance**2 * squared
    if not squared > 0:  # also where it is not a number
        return (x, residual) if squared == 0 else None
    for _ in range(max_iterations):
        _multiply(diagonal, off_diagonal, pairs, direction, product)
        curvature = float(np.vdot(direction, product))
        if not curvature > 0:
            return None
        step = squared / curvature
        x += step * direction
        residual -= step * product
        better = precondition(residual)
        before, squared = squared, float(np.vdot(residual, better))
        if squared <= enough:
            return x, residual
        direction *= squared / before
        direction += better
    return None


@_kernel
def _multiply(diagonal, off_diagonal, pairs, x, out):
    """out = H x."""
    for n in range(len(diagonal)):
        for r in range(DIM):
            total = 0.0
            for c in range(DIM):
                total += diagonal[n, r, c] * x[n, c]
            out[n, r] = total
    for p in range(len(pairs)):
        i, j, block = pairs[p, 0], pairs[p, 1], off_diagonal[p]
        xi, xj, yi, yj = x[i], x[j], out[i], out[j]
        for r in range(DIM):
            total, a = 0.0, xi[r]
            for c in range(DIM):
                total += block[r, c] * xj[c]
                yj[c] += block[r, c] * a
            yi[r] += total
