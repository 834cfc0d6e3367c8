"""A block whose cost is a quadratic function, linearized elsewhere."""

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np

from factors.block import PoseSystem


class QuadraticBlock:
    """c + g^T x + x^T H x / 2 over steps x of variables, from where it was linearized."""

    def __init__(self, keys: Sequence[int], pairs: np.ndarray, system: PoseSystem) -> None:
        """A block's system over its `keys (V,)` and `pairs (P, 2)`."""
        self.keys, self.pairs, self._system = list(keys), pairs, system

    def refresh(self, values: gtsam.Values) -> None:
        """Do nothing: the function is fixed."""

    def linearize(self, values: gtsam.Values) -> PoseSystem:
        """The function itself, whatever the values."""
        return replace(self._system, off_diagonal=self._system.off_diagonal.copy())

    def products(self) -> None:
        """None: the Hessian is only written out."""

    def propose(self, values: gtsam.Values, steps: np.ndarray) -> float:
        """Cost at `steps (V, 6)`."""
        system, (first, second) = self._system, self.pairs.T
        own = np.einsum("vi,vij,vj->", steps, system.diagonal, steps)
        across = np.einsum("pi,pij,pj->", steps[first], system.off_diagonal, steps[second])
        cost = sum(system.costs.values()) + np.sum(steps * system.gradient)
        return float(cost + 0.5 * own + across)

    def accept(self) -> None:
        """Do nothing: there are no inner variables."""

    def costs(self, values: gtsam.Values) -> dict[str, float]:
        """Cost where it was linearized."""
        return dict(self._system.costs)
