"""The reduced camera system of a graph and its blocks: assembled in 6x6 blocks, damped, solved."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence

import gtsam
import numpy as np
from scipy.sparse import csr_matrix

from factors.cholesky import DIM
from factors.compiled import kernel_and_part
from factors.system_layout import SystemLayout

_kernel, _ = kernel_and_part()

GRAPH = "graph"  # family under which the cost of the native and user factors is reported
STEP_TOLERANCE = 1e-2  # tolerance of a step by conjugate gradients: the next linearization
# corrects the rest
_MIN_DIAGONAL = 1e-6  # least curvature that damping is relative to, per sigma


class ReducedSystem(ABC):
    """Normal equations over all variables that a graph and blocks name, and their solver.

    `factors.system_choice.reduced_system` chooses between the solvers `DirectSystem` and
    `IterativeSystem`, which differ in how they solve, and in which blocks they write out.
    """

    def __init__(self, layout: SystemLayout, factored: Collection[int] = ()) -> None:
        """Fix the pattern: off-diagonal blocks of the graph, and of all blocks but the `factored`
        ones (indices of the layout's)."""
        self._layout = layout
        placed = [layout.factor_pairs]
        placed += [
            rows[block.pairs].reshape(-1, 2)
            for i, (block, rows) in enumerate(zip(layout.blocks, layout.block_rows, strict=True))
            if i not in factored
        ]
        codes = [self._pair_codes(pairs) for pairs in placed]
        self._codes = np.unique(np.concatenate(codes))
        self._pairs = np.column_stack(np.divmod(self._codes, layout.num))
        self._block_slots = [
            (np.searchsorted(self._codes, code), pairs[:, 0] > pairs[:, 1])
            for code, pairs in zip(codes[1:], placed[1:], strict=True)
        ]

    @property
    def first_block(self) -> dict[int, int]:
        """The first 6x6 block of each key."""
        return self._layout.first_block

    def linearize(self, values: gtsam.Values) -> dict[str, float]:
        """Assemble H and the gradient at `values`; returns the cost of each family."""
        layout = self._layout
        self._diagonal = np.zeros((layout.num, DIM, DIM))
        self._gradient = np.zeros((layout.num, DIM))
        self._off_diagonal = np.zeros((0, DIM, DIM))  # frees the previous blocks
        self._jacobian = csr_matrix((0, len(layout.column_blocks)))  # of the graph
        costs: dict[str, float] = {}
        parts: list[np.ndarray] = []
        for i in range(len(layout.blocks)):
            _add_costs(costs, self._add_block(i, values, parts))
        self._off_diagonal = self._gathered(parts)
        if layout.graph_keys:
            self._add_graph(values)
            _add_costs(costs, {GRAPH: layout.graph.error(values)})
        self._diagonal[layout.padding[0], layout.padding[1], layout.padding[1]] = 1.0
        return costs

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
            _add_costs(costs, block.costs(values))
        if self._layout.graph_keys:
            _add_costs(costs, {GRAPH: self._layout.graph.error(values)})
        return costs

    def covariances(
        self, num_draws: int, rng: np.random.Generator, damping: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Blocks of H^-1 at the linearization point, and draws from it; None if singular.

        An unconstrained block is NaN and is left out. An iterative solver does not detect a free
        gauge: its errors are merely enormous.

        Args:
            num_draws: number of draws, D.
            rng: generator of the draws.
            damping: part of the diagonal that is added to it.

        Returns:
            (N, 6, 6) diagonal blocks, (P, 6, 6) blocks between the first blocks of the layout's
            pairs, and vectors (D, N, 6) of covariance H^-1.
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
        """What `covariances` returns, of H with diagonal blocks `diagonal (N, 6, 6)`."""

    def _add_block(
        self, i: int, values: gtsam.Values, parts: list[np.ndarray]
    ) -> Mapping[str, float]:
        """Add the i-th block's system, its off-diagonal blocks to `parts`; returns its costs."""
        rows = self._layout.block_rows[i]
        system = self._layout.blocks[i].linearize(values)
        self._diagonal[rows] += system.diagonal
        self._gradient[rows] += system.gradient
        parts.append(system.off_diagonal)
        return system.costs

    def _gathered(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        """Off-diagonal blocks (P, 6, 6) of all factors; a single block of factors that has them
        all, which may be gigabytes, is not copied."""
        if len(parts) == 1:
            slots, flip = self._block_slots[0]
            if np.array_equal(slots, np.arange(len(self._pairs))) and not flip.any():
                return parts[0]
        out = np.zeros((len(self._pairs), DIM, DIM))
        for part, (slots, flip) in zip(parts, self._block_slots, strict=True):
            _add_blocks(out, slots, flip, part)
        return out

    def _pair_codes(self, pairs: np.ndarray) -> np.ndarray:
        return pairs.min(axis=1, initial=self._layout.num) * self._layout.num + pairs.max(
            axis=1, initial=0
        )

    def _add_graph(self, values: gtsam.Values) -> None:
        """Add the native and user factors, linearized by GTSAM."""
        layout, num = self._layout, len(self._layout.column_blocks)
        rows, columns, entries = self._layout.graph.linearize(values).sparseJacobian_()
        augmented = csr_matrix(
            (entries, (rows.astype(np.int64) - 1, columns.astype(np.int64) - 1)),
            shape=(int(rows.max(initial=1)), num + 1),
        )
        self._jacobian = augmented[:, :num]
        product = (augmented.T @ augmented).tocoo()
        i, j, x = product.row, product.col, product.data
        right = (j == num) & (i < num)  # the last column is -r
        np.subtract.at(
            self._gradient,
            (layout.column_blocks[i[right]], layout.column_offsets[i[right]]),
            x[right],
        )
        inner = (i < num) & (j < num)
        i, j, x = i[inner], j[inner], x[inner]
        block_i, block_j = layout.column_blocks[i], layout.column_blocks[j]
        offset_i, offset_j = layout.column_offsets[i], layout.column_offsets[j]
        same, upper = block_i == block_j, block_i < block_j
        np.add.at(self._diagonal, (block_i[same], offset_i[same], offset_j[same]), x[same])
        slots = np.searchsorted(self._codes, block_i[upper] * layout.num + block_j[upper])
        np.add.at(self._off_diagonal, (slots, offset_i[upper], offset_j[upper]), x[upper])


def damping_of(diagonal: np.ndarray, damping: float) -> np.ndarray:
    """What a damping of part `damping` adds (N, 6) to the diagonal of blocks (N, 6, 6)."""
    return damping * np.maximum(np.einsum("nii->ni", diagonal), _MIN_DIAGONAL)


@_kernel
def _add_blocks(target, slots, flip, blocks):
    """Add blocks (Q, 6, 6), those to be flipped transposed, to the slots (Q,) of others."""
    for q in range(len(slots)):
        to, block = target[slots[q]], blocks[q]
        for r in range(DIM):
            for c in range(DIM):
                to[r, c] += block[c, r] if flip[q] else block[r, c]


def _add_costs(total: dict[str, float], costs) -> None:
    for name, cost in costs.items():
        total[name] = total.get(name, 0.0) + cost
