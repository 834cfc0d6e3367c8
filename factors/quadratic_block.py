"""A block whose cost is a quadratic function, linearized elsewhere."""

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
from scipy.sparse import csr_matrix

from factors.block import PoseSystem
from factors.cholesky import DIM


class QuadraticBlock:
    """c + g^T x + x^T H x / 2 over steps x of variables, from the linearization point.

    A variable takes six coordinates; one of fewer dimensions uses the first of them.
    """

    def __init__(
        self, keys: Sequence[int], hessian: csr_matrix, gradient: np.ndarray, cost: float
    ) -> None:
        """H (6 V, 6 V) and g (6 V,) of variables `keys (V,)`, and c."""
        self.keys = list(keys)
        num = len(self.keys)
        blocks = hessian.tobsr((DIM, DIM))
        rows = np.repeat(np.arange(num), np.diff(blocks.indptr))
        upper, same = rows < blocks.indices, rows == blocks.indices
        self.pairs = np.column_stack([rows[upper], blocks.indices[upper]]).astype(np.int64)
        diagonal = np.zeros((num, DIM, DIM))
        diagonal[rows[same]] = blocks.data[same]
        self._hessian, self._gradient, self._cost = hessian, gradient, cost
        self._system = PoseSystem(
            diagonal, blocks.data[upper], gradient.reshape(num, DIM), self.costs(gtsam.Values())
        )

    def refresh(self, values: gtsam.Values) -> None:
        """Do nothing: the function is fixed."""

    def linearize(self, values: gtsam.Values) -> PoseSystem:
        """The function itself, at any values."""
        system = self._system
        return replace(system, off_diagonal=system.off_diagonal.copy())

    def propose(self, values: gtsam.Values, steps: np.ndarray) -> float:
        """Cost at `steps (V, 6)`."""
        x = steps.ravel()
        return self._cost + float(x @ (self._gradient + 0.5 * (self._hessian @ x)))

    def accept(self) -> None:
        """Do nothing: there are no inner variables."""

    def costs(self, values: gtsam.Values) -> dict[str, float]:
        """Cost at the linearization point."""
        return {"quadratic": self._cost}
