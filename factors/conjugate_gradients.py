"""Preconditioned conjugate gradients on symmetric systems of 6x6 blocks."""

from collections.abc import Callable

import numpy as np

from factors.cholesky import DIM
from factors.compiled import kernel_and_part

_kernel, _ = kernel_and_part()


def conjugate_gradients(
    multiply: Callable[[np.ndarray], np.ndarray],
    right: np.ndarray,
    precondition: Callable[[np.ndarray], np.ndarray],
    tolerance: float,
    max_iterations: int,
    truncate: bool = False,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Solve H x = right for several right sides at once. Hestenes and Stiefel, 1952.

    Args:
        multiply: H applied to (N, 6, R), symmetric positive definite.
        right: (N, 6, R).
        precondition: approximate H^-1 applied to (N, 6, R), symmetric positive definite.
        tolerance: of each residual in the preconditioner's norm, relative to x = 0.
        truncate: return the last iterate even if the tolerance is not reached.

    Returns:
        x (N, 6, R) and the residual right - H x; None if the tolerance is not reached, or if H is
        not positive definite.
    """
    x, residual = np.zeros_like(right), right.copy()
    better = precondition(residual)
    direction = better.copy()
    squared = _products(residual, better)
    enough = tolerance**2 * squared
    if not np.all(squared > 0):  # also where it is not a number
        return (x, residual) if not np.any(right) else None
    for _ in range(max_iterations):
        product = multiply(direction)
        curvature = _products(direction, product)
        if not np.all(curvature > 0):
            return None
        step = squared / curvature
        x += step * direction
        residual -= step * product
        better = precondition(residual)
        before, squared = squared, _products(residual, better)
        if np.all(squared <= enough):
            return x, residual
        direction *= squared / before
        direction += better
    return (x, residual) if truncate else None


def _products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Inner products (R,) of two sets of R vectors."""
    return np.einsum("nir,nir->r", a, b)


@_kernel
def multiply_blocks(diagonal, off_diagonal, pairs, x):
    """H x of blocks H[i, i] (N, 6, 6) and H[i, j] (P, 6, 6) of pairs (P, 2), i < j; x (N, 6, R)."""
    out = np.zeros_like(x)
    for s in range(x.shape[2]):
        for n in range(len(diagonal)):
            for r in range(DIM):
                total = 0.0
                for c in range(DIM):
                    total += diagonal[n, r, c] * x[n, c, s]
                out[n, r, s] = total
        for p in range(len(pairs)):
            i, j, block = pairs[p, 0], pairs[p, 1], off_diagonal[p]
            xi, xj, yi, yj = x[i], x[j], out[i], out[j]
            for r in range(DIM):
                total, a = 0.0, xi[r, s]
                for c in range(DIM):
                    total += block[r, c] * xj[c, s]
                    yj[c, s] += block[r, c] * a
                yi[r, s] += total
    return out
