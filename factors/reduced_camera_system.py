"""The reduced camera system of a graph and its blocks: normal equations, damped and solved."""

from abc import ABC, abstractmethod

import gtsam
import numpy as np

from factors.cholesky import DIM
from factors.normal_equations import GRAPH, NormalEquations, add_costs, damping_of

STEP_TOLERANCE = 1e-2  # tolerance of a step by conjugate gradients: the next linearization
# corrects the rest


class ReducedSystem(NormalEquations, ABC):
    """Normal equations and their solver.

    `factors.direct_system.reduced_system` chooses between the solvers `DirectSystem` and
    `IterativeSystem`, which differ in how they solve, and in which blocks they write out.
    """

    def solve(self, damping: float) -> np.ndarray | None:
        """Step (N, 6) of the system damped by `damping` times its diagonal; None if singular."""
        added = damping_of(self._diagonal, damping)
        found = self._step(added)
        if found is None:
            return None
        steps, residual = (part.reshape(-1, DIM) for part in found)
        # c(0) - c(x) = -g^T x - x^T H x / 2, with (H + D) x = -g - residual
        self._predicted = 0.5 * float((steps * (added * steps - self._gradient + residual)).sum())
        return steps

    @abstractmethod
    def _step(self, added: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Step and residual of the gradient, `added (N, 6)` on the diagonal; None if singular."""

    def predicted_decrease(self) -> float:
        """Decrease of the cost that the undamped model predicts for the last step."""
        return self._predicted

    def retract(self, values: gtsam.Values, steps: np.ndarray) -> gtsam.Values:
        """Values moved by steps (N, 6)."""
        layout, delta = self._layout, gtsam.VectorValues()
        flat = steps.ravel()
        for key, dim in zip(layout.keys, layout.dims, strict=True):
            start = DIM * layout.first_block[key]
            delta.insert(key, flat[start : start + dim])
        return values.retract(delta)

    def propose(self, values: gtsam.Values, steps: np.ndarray) -> float:
        """Total cost at tentative values, `steps (N, 6)` from the linearization point."""
        layout = self._layout
        cost = layout.graph.error(values) if layout.graph_keys else 0.0
        for block, rows in zip(layout.blocks, layout.block_rows, strict=True):
            cost += block.propose(values, steps[rows])
        return cost

    def accept(self, values: gtsam.Values) -> None:
        """Keep the inner variables of the last proposal, and renew what depends on `values`."""
        for block in self._layout.blocks:
            block.accept()
            block.refresh(values)

    def costs(self, values: gtsam.Values) -> dict[str, float]:
        """Cost of each family at accepted values."""
        costs: dict[str, float] = {}
        for block in self._layout.blocks:
            add_costs(costs, block.costs(values))
        if self._layout.graph_keys:
            add_costs(costs, {GRAPH: self._layout.graph.error(values)})
        return costs

    def covariances(
        self, num_draws: int, rng: np.random.Generator, damping: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Blocks of H^-1 at the linearization point, damped by part of its diagonal, and draws from
        it; None if singular: (N, 6, 6) diagonal blocks, (P, 6, 6) blocks between the first blocks
        of the layout's pairs, and vectors (D, N, 6) of covariance H^-1.

        An unconstrained block is NaN and is left out. An iterative solver does not detect a free
        gauge: its errors are merely enormous.
        """
        idle = np.logical_not(np.any(self._diagonal, axis=(1, 2)))
        diagonal = np.where(idle[:, None, None], np.eye(DIM), self._diagonal)
        np.einsum("nii->ni", diagonal)[:] *= 1 + damping
        found = self._inverse(diagonal, num_draws, rng)
        if found is None:
            return None
        inverse, between, drawn = found
        inverse[idle], drawn[:, idle] = np.nan, np.nan
        between[idle[self._layout.asked].any(axis=1)] = np.nan
        return inverse, between, drawn

    @abstractmethod
    def _inverse(
        self, diagonal: np.ndarray, num_draws: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """The results of `covariances` for H with the diagonal blocks `diagonal` (N, 6, 6)."""
