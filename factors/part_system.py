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

    Attributes:
        regular: False where the own blocks are not positive definite: nothing else holds then.
    """

    def __init__(self, equations: PartEquations, damping: float) -> None:
        """Factorize.

        Args:
            equations: of the part.
            damping: part of the diagonal that is added to it.
        """
        self._equations, num = equations, len(equations.diagonal)
        self._own = slice(0, num - equations.num_kept)
        self._added = damping_of(equations.diagonal, damping)[self._own]
        damped = equations.diagonal.copy()
        np.einsum("nii->ni", damped)[self._own] += self._added
        self._cholesky = BlockCholesky(num, equations.pairs, equations.num_kept)
        self.regular = self._cholesky.factorize(damped, equations.off_diagonal)

    def condensed(self) -> Condensed:
        """The Schur complement on the shared blocks, and its gradient."""
        num = self._equations.num_kept
        lower = self._cholesky.complement.reshape(num, DIM, num, DIM)
        each = np.arange(num)
        diagonal = np.tril(lower[each, :, each, :])
        diagonal += np.swapaxes(np.tril(diagonal, -1), 1, 2)
        rows, columns = np.triu_indices(num, 1)
        off_diagonal = np.swapaxes(lower[columns, :, rows, :], 1, 2).copy()
        return Condensed(diagonal, off_diagonal, -self._cholesky.reduced(-self._equations.gradient))

    def substituted(self, kept: np.ndarray) -> tuple[np.ndarray, float]:
        """Steps (N - K, 6) of the own blocks, given those of the shared ones, (K, 6).

        Returns:
            The steps, and their share of the decrease that the undamped model predicts.
        """
        gradient = self._equations.gradient
        steps = self._cholesky.substituted(-gradient, kept)[self._own]
        return steps, 0.5 * float((steps * (self._added * steps - gradient[self._own])).sum())
