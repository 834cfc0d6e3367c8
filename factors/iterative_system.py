"""The reduced camera system by conjugate gradients, without assembling it."""

from collections.abc import Callable, Mapping

import gtsam
import numpy as np

from factors._terms import pose_rows
from factors.block import Products
from factors.cholesky import DIM
from factors.coarse_preconditioner import Coarse, Held, coarse_system, covisible_groups
from factors.compiled import kernel_and_part
from factors.reduced_camera_system import STEP_TOLERANCE, ReducedSystem
from factors.schur_complement import group_visits
from factors.system_layout import SystemLayout

_kernel, _ = kernel_and_part()


def conjugate_gradients(
    multiply: Callable[[np.ndarray], np.ndarray],
    right: np.ndarray,
    precondition: Callable[[np.ndarray], np.ndarray],
    tolerance: float,
    max_iterations: int,
    truncate: bool = False,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Solve H x = right (N, 6, R) for several right sides at once. Hestenes and Stiefel, 1952.

    Args:
        multiply, precondition: H and an approximate H^-1 applied to (N, 6, R), symmetric
            positive definite.
        tolerance: of each residual in the preconditioner's norm, relative to x = 0.
        truncate: return the last iterate even if the tolerance is not reached.

    Returns:
        x and the residual right - H x; None if the tolerance is not reached, or if H is not
        positive definite.
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


_DRAWS_AT_ONCE = 20


class IterativeSystem(ReducedSystem):
    """Normal equations of which blocks that offer products of their Hessian are not written out.

    Steps and covariances are computed by conjugate gradients (`factors.coarse_preconditioner`).
    """

    def __init__(self, layout: SystemLayout, products: Mapping[int, Products]) -> None:
        """Form groups of covisible frames, and the visits of landmarks by groups; products: of
        those of the layout's blocks, by index, that are not written out."""
        super().__init__(layout, products)
        self._products = products
        self._coarse: Coarse | None = None  # of an earlier system
        shares = [
            (layout.block_rows[i][layout.blocks[i].pairs], product.shared)
            for i, product in products.items()
        ]
        poses = np.zeros(layout.num, bool)
        for i in products:
            poses[layout.block_rows[i]] = True
        tied = layout.factor_pairs[poses[layout.factor_pairs].all(axis=1)]
        # of a landmark: each native factor
        self._groups = covisible_groups(layout.num, [*shares, (tied, np.full(len(tied), 1e-3))])
        self._visits = {
            i: group_visits(
                product.visits, self._groups.labels[layout.block_rows[i]], self._groups.num
            )
            for i, product in products.items()
        }

    def linearize(self, values: gtsam.Values) -> dict[str, float]:
        """Assemble what is written out, the products and the gradient; returns families' costs."""
        layout = self._layout
        self._complements: list[Held] = []
        costs = super().linearize(values)
        self._written = self._diagonal  # without the products
        self._diagonal = self._written.copy()
        for complement, rows, _ in self._complements:
            self._diagonal[rows] += complement.diagonal
        poses = np.zeros((layout.num, 12))
        for i in self._products:
            poses[layout.block_rows[i]] = pose_rows(values, layout.blocks[i].keys)
        self._bases = self._groups.bases(poses)
        return costs

    def _add_block(
        self, i: int, values: gtsam.Values, parts: list[np.ndarray]
    ) -> Mapping[str, float]:
        if i not in self._products:
            return super()._add_block(i, values, parts)
        rows = self._layout.block_rows[i]
        complement, gradient, costs = self._products[i].eliminate(values)
        self._gradient[rows] += gradient
        self._complements.append((complement, rows, self._visits[i]))
        return costs

    def _step(self, added: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Step preconditioned by an earlier groups' system, or by a new one if that is faster."""
        right = -self._gradient[..., None]
        if self._coarse is not None:
            found = self._solve_products(added, right, STEP_TOLERANCE, self._max_iterations)
            if found is not None:
                return found
            self._coarse = None
        found = self._solve_products(added, right, STEP_TOLERANCE, truncate=True)
        self._max_iterations = 2 * self._iterations
        return found

    def _solve_products(
        self,
        added: np.ndarray,
        right: np.ndarray,
        tolerance: float,
        max_iterations: int = 300,  # ten or twenty suffice
        truncate: bool = False,
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Solutions (N, 6, R) with `added` (N, 6) on the diagonal, residuals; None = unsolved."""
        diagonal, written = self._diagonal.copy(), self._written.copy()
        for blocks in (diagonal, written):
            np.einsum("nii->ni", blocks)[:] += added
        if self._coarse is None:
            given = self._off_diagonal, self._pairs, self._complements, self._groups, self._bases
            self._coarse = coarse_system(written, *given)
        try:
            inverses = np.linalg.inv(diagonal)
        except np.linalg.LinAlgError:
            return None
        coarse, self._iterations = self._coarse, 0
        if coarse is None:
            return None

        def multiply(x: np.ndarray) -> np.ndarray:
            self._iterations += 1
            out = multiply_blocks(written, self._off_diagonal, self._pairs, x)
            for complement, rows, _ in self._complements:
                out[rows] += complement.times(x[rows])
            return out

        def precondition(residual: np.ndarray) -> np.ndarray:
            return inverses @ residual + coarse.solve(residual)

        return conjugate_gradients(
            multiply, right, precondition, tolerance, max_iterations, truncate
        )

    def _inverse(
        self, diagonal: np.ndarray, num_draws: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        drawn = self._drawn(np.einsum("nii->ni", diagonal - self._diagonal), num_draws, rng)
        if drawn is None:
            return None
        i, j = self._layout.asked.T
        inverse = np.einsum("dnr,dnc->nrc", drawn, drawn) / len(drawn)
        between = np.einsum("dnr,dnc->nrc", drawn[:, i], drawn[:, j]) / len(drawn)
        return inverse, between, drawn

    def _drawn(
        self, added: np.ndarray, num_draws: int, rng: np.random.Generator
    ) -> np.ndarray | None:
        """Draws (D, N, 6) of covariance (H + added)^-1: the inverse times J^T e of all factors."""
        layout, draws, self._coarse = self._layout, [], None
        for _ in range(0, max(num_draws, 200), _DRAWS_AT_ONCE):  # whose spread gives a covariance
            right = np.sqrt(added)[..., None] * rng.normal(size=(*added.shape, _DRAWS_AT_ONCE))
            for complement, rows, _ in self._complements:
                right[rows] += complement.draw(int(rng.integers(1 << 62)), _DRAWS_AT_ONCE)
            errors = rng.normal(size=(len(self._jacobian.indptr) - 1, _DRAWS_AT_ONCE))
            forces = self._jacobian.T @ errors
            np.add.at(right, (layout.column_blocks, layout.column_offsets), forces)
            # no motion of thousands of frames may be missed
            found = self._solve_products(added, right, 1e-3)
            if found is None:
                return None
            draws.append(np.moveaxis(found[0], 2, 0))
        return np.concatenate(draws)
