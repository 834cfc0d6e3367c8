"""Normal equations of a part of a map: its own blocks are eliminated, those it shares are kept."""

from dataclasses import dataclass

import numpy as np

from factors.cholesky import DIM, BlockCholesky
from factors.normal_equations import NormalEquations, damping_of


@dataclass(frozen=True, slots=True)
class PartEquations:
    """Second-order model of a part's cost over its N blocks, the last K of them shared."""

    diagonal: np.ndarray  # (N, 6, 6) float64
    off_diagonal: np.ndarray  # (P, 6, 6) float64, blocks H[i, j] of the pairs
    pairs: np.ndarray  # (P, 2) int64, i < j, distinct
    gradient: np.ndarray  # (N, 6) float64
    num_kept: int  # K


@dataclass(frozen=True, slots=True)
class Condensed:
    """Equations of a part on its K shared blocks, its own blocks eliminated."""

    diagonal: np.ndarray  # (K, 6, 6) float64, of the Schur complement
    off_diagonal: np.ndarray  # (K (K - 1) / 2, 6, 6) float64, blocks [i, j] of all i < j by rows
    gradient: np.ndarray  # (K, 6) float64


class PartSystem(NormalEquations):
    """Assembles the equations of a part; the keys that it shares come last in the layout."""

    def equations(self, num_kept: int) -> PartEquations:
        """The equations of the last linearization, of which the last blocks are shared."""
        return PartEquations(
            self._diagonal, self._off_diagonal, self._pairs, self._gradient, num_kept
        )


class PartElimination:
    """Cholesky factor of a part's own blocks, damped; the shared ones are damped by who sums them.
    Where own blocks are not positive definite, it is not `regular`, and nothing else holds."""

    def __init__(self, equations: PartEquations, damping: float) -> None:
        """Factorize, with a part of the diagonal added to it; 0 = none, and own blocks that nothing
        constrains count as unit ones."""
        num = len(equations.diagonal)
        self._own, self._num_kept = slice(0, num - equations.num_kept), equations.num_kept
        self._gradient = equations.gradient
        self._added = damping_of(equations.diagonal, damping)[self._own]
        damped = equations.diagonal.copy()
        np.einsum("nii->ni", damped)[self._own] += self._added
        self.idle = ~np.any(equations.diagonal[self._own], axis=(1, 2))
        if damping == 0:
            damped[self._own][self.idle] = np.eye(DIM)
        self._cholesky = BlockCholesky(num, equations.pairs, equations.num_kept)
        self.regular = self._cholesky.factorize(damped, equations.off_diagonal)

    @property
    def num_bytes(self) -> int:
        """Memory of the factor."""
        return 8 * (self._cholesky.num_entries + (DIM * self._num_kept) ** 2)

    def condensed(self) -> Condensed:
        """The Schur complement on the shared blocks, and its gradient."""
        num = self._num_kept
        lower = self._cholesky.complement.reshape(num, DIM, num, DIM)
        each = np.arange(num)
        diagonal = np.tril(lower[each, :, each, :])
        diagonal += np.swapaxes(np.tril(diagonal, -1), 1, 2)
        rows, columns = np.triu_indices(num, 1)
        off_diagonal = np.swapaxes(lower[columns, :, rows, :], 1, 2).copy()
        return Condensed(diagonal, off_diagonal, -self._cholesky.reduced(-self._gradient))

    def substituted(self, kept: np.ndarray) -> tuple[np.ndarray, float]:
        """Steps (N - K, 6) of the own blocks, given those of the shared ones, (K, 6), and their
        share of the decrease that the undamped model predicts."""
        steps = self._cholesky.substituted(-self._gradient, kept)[self._own]
        gradient = self._gradient[self._own]
        return steps, 0.5 * float((steps * (self._added * steps - gradient)).sum())

    def inverse_blocks(self, pairs: np.ndarray, kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Blocks of the inverse of the whole map's system, given it at the shared blocks, kept (6
        K, 6 K): (N - K, 6, 6) diagonal ones of its own, (Q, 6, 6) blocks [i, j] of pairs (Q, 2) of
        the part's pattern, i < j, i one of its own."""
        inverse, between = self._cholesky.inverse_blocks(pairs, kept if self._num_kept else None)
        return inverse[self._own], between

    def drawn(self, kept: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Errors (D, N - K, 6) of the own blocks, of the covariance of the whole map's inverse,
        given those drawn of the shared ones, (D, K, 6)."""
        num = len(kept)
        normals = rng.normal(size=(num, len(self._gradient) - self._num_kept, DIM))
        return self._cholesky.draw(np.concatenate([normals, kept], axis=1))[:, self._own]
