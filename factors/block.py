"""The interface of a block of like factors to the optimizer."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import gtsam
import numpy as np

from factors._observations import Visits
from factors.schur_complement import SchurComplement


@dataclass(frozen=True, slots=True)
class PoseSystem:
    """Second-order model of a block's cost over its variables: c + g^T x + x^T H x / 2.

    x stacks six coordinates of each variable: [rotation, translation] of a pose, right
    perturbation. A smaller variable has the first ones; the others' entries are zero.
    """

    diagonal: np.ndarray  # (F, 6, 6) float64, blocks H[f, f]
    off_diagonal: np.ndarray  # (P, 6, 6) float64, blocks H[f, g] of the block's pairs (f, g), f < g
    gradient: np.ndarray  # (F, 6) float64
    costs: Mapping[str, float]  # family -> cost at the linearization point


class Products(Protocol):
    """The Hessian of a block in factored form, for solvers that need only its products."""

    @property
    def shared(self) -> np.ndarray:
        """(P,) number of inner variables that each of the block's `pairs` shares."""
        ...

    @property
    def visits(self) -> Sequence[Visits]:
        """Which of the block's poses see which inner variables, in runs."""
        ...

    def eliminate(
        self, values: gtsam.Values
    ) -> tuple[SchurComplement, np.ndarray, dict[str, float]]:
        """Hessian in factored form, gradient (F, 6), and cost of each family: the model of
        `Block.linearize`."""
        ...


class Block(Protocol):
    """Like factors held as arrays, on variables of at most six dimensions, perhaps with inner ones.

    The optimizer calls, in this order: `refresh` and `linearize` at accepted values, then any
    number of `propose`, of which the last is followed by `accept` if its values are accepted.
    Subclass it: `refresh`, `products` and `accept` do nothing unless they are overridden.
    """

    keys: Sequence[int]  # (F,) of its variables: Pose3, or of any type with at most six dimensions
    pairs: np.ndarray  # (P, 2) int, rows f < g of keys that share a residual; fixed for a run

    def refresh(self, values: gtsam.Values) -> None:
        """Recompute data that depend on accepted values (renderings, patches)."""

    def linearize(self, values: gtsam.Values) -> PoseSystem:
        """Model of the cost at accepted values, inner variables eliminated; the caller may
        change its arrays."""
        ...

    def products(self) -> Products | None:
        """The Hessian in factored form, if all the block's variables are poses; None = it is only
        written out."""
        return None

    def propose(self, values: gtsam.Values, steps: np.ndarray) -> float:
        """Cost at tentative values, `steps (F, 6)` away from the linearization point."""
        ...

    def accept(self) -> None:
        """Keep the inner variables of the last proposal."""

    def costs(self, values: gtsam.Values) -> dict[str, float]:
        """Cost of each family, at the current inner variables."""
        ...


class QuadraticBlock(Block):
    """c + g^T x + x^T H x / 2 over steps x of variables, from where it was linearized."""

    def __init__(self, keys: Sequence[int], pairs: np.ndarray, system: PoseSystem) -> None:
        """A block's system over its `keys (V,)` and `pairs (P, 2)`."""
        self.keys, self.pairs, self._system = list(keys), pairs, system

    def linearize(self, values: gtsam.Values) -> PoseSystem:
        """The function itself, whatever the values."""
        return replace(self._system, off_diagonal=self._system.off_diagonal.copy())

    def propose(self, values: gtsam.Values, steps: np.ndarray) -> float:
        """Cost at `steps (V, 6)`."""
        system, (first, second) = self._system, self.pairs.T
        own = np.einsum("vi,vij,vj->", steps, system.diagonal, steps)
        across = np.einsum("pi,pij,pj->", steps[first], system.off_diagonal, steps[second])
        cost = sum(system.costs.values()) + np.sum(steps * system.gradient)
        return float(cost + 0.5 * own + across)

    def costs(self, values: gtsam.Values) -> dict[str, float]:
        """Cost where it was linearized."""
        return dict(self._system.costs)
