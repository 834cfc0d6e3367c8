"""The reduced system of a graph and its blocks: assembled in 6x6 blocks, damped, solved."""

from collections.abc import Sequence
from itertools import combinations

import gtsam
import numpy as np
from scipy.sparse import csr_matrix

from factors.block import Block
from factors.cholesky import DIM, BlockCholesky
from factors.compiled import kernel_and_part
from factors.conjugate_gradients import conjugate_gradients

_kernel, _ = kernel_and_part()

GRAPH = "graph"  # family under which the cost of the native and user factors is reported
_MIN_DIAGONAL = 1e-6  # least curvature that damping is proportional to, per sigma
_STEP_TOLERANCE = 1e-2  # of a step by conjugate gradients: the next step is from there anyway
_OPERATIONS_PER_BYTE = 4.0  # that a core does on dense blocks while it reads one from memory
_LEAST_ITERATIONS = 10  # of conjugate gradients that must be cheaper than half a factorization


class ReducedSystem:
    """Normal equations over all variables that a graph and blocks name.

    Every variable takes whole 6x6 blocks: a Pose3 one, smaller ones are filled up with an
    identity that stays apart, larger ones are split. `first_block` maps a key to its first block.
    """

    def __init__(
        self,
        graph: gtsam.NonlinearFactorGraph,
        blocks: Sequence[Block],
        values: gtsam.Values,
        pairs: Sequence[tuple[int, int]] = (),
    ) -> None:
        """Fix the pattern.

        Args:
            graph: native and user factors.
            blocks: batched ones.
            values: of all variables.
            pairs: keys of two variables each, whose common block `covariances` is to give.

        Raises:
            ValueError: a variable has no value.
        """
        self._graph, self._blocks = graph, tuple(blocks)
        factor_keys = [graph.at(i).keys() for i in range(graph.size()) if graph.exists(i)]
        self._graph_keys = sorted({key for keys in factor_keys for key in keys})
        block_keys = [key for block in self._blocks for key in block.pose_keys]
        paired = [key for pair in pairs for key in pair]
        self.keys = list(dict.fromkeys([*block_keys, *self._graph_keys, *paired]))
        all_dims = values.dims()
        for key in self.keys:
            if key not in all_dims:
                raise ValueError(f"variable {gtsam.DefaultKeyFormatter(key)} has no value")
        self._dims = [all_dims[key] for key in self.keys]
        counts = [-(-dim // DIM) for dim in self._dims]
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        self.first_block = dict(zip(self.keys, starts[:-1].tolist(), strict=True))
        self._num = int(starts[-1])
        self._block_rows = [
            np.array([self.first_block[key] for key in block.pose_keys], dtype=np.int64)
            for block in self._blocks
        ]
        self._padding = self._padded_entries(counts)
        self._asked = np.array([self.first_block[key] for key in paired], np.int64).reshape(-1, 2)
        self._set_pairs(
            [*factor_keys, *map(list, pairs)], dict(zip(self.keys, counts, strict=True))
        )
        self._set_columns(all_dims)
        self._cholesky = BlockCholesky(self._num, self._pairs)
        self._factorized = False  # whether the Cholesky factor is of some system met before
        bytes_read = 8 * (2 * self._cholesky.num_entries + DIM * DIM * len(self._pairs))
        cheaper = self._cholesky.num_operations / (2 * _OPERATIONS_PER_BYTE * max(bytes_read, 1))
        self._max_iterations = int(cheaper) if cheaper >= _LEAST_ITERATIONS else 0

    def linearize(self, values: gtsam.Values) -> dict[str, float]:
        """Assemble H and the gradient at `values`; returns the cost of each family."""
        self._diagonal = np.zeros((self._num, DIM, DIM))
        self._gradient = np.zeros((self._num, DIM))
        self._off_diagonal = np.zeros((0, DIM, DIM))  # frees that of before
        costs: dict[str, float] = {}
        parts = []
        for block, rows in zip(self._blocks, self._block_rows, strict=True):
            system = block.linearize(values)
            self._diagonal[rows] += system.diagonal
            self._gradient[rows] += system.gradient
            parts.append(system.off_diagonal)
            _add_costs(costs, system.costs)
        self._off_diagonal = self._gathered(parts)
        if self._graph_keys:
            self._add_graph(values)
            _add_costs(costs, {GRAPH: self._graph.error(values)})
        self._diagonal[self._padding[0], self._padding[1], self._padding[1]] = 1.0
        return costs

    def solve(self, damping: float) -> np.ndarray | None:
        """Step (N, 6) of the system damped by `damping` times its diagonal; None if singular.

        Where much fills in, the Cholesky factor of a system before it preconditions conjugate
        gradients; it is renewed when they take longer than that would.
        """
        curvature = np.einsum("nii->ni", self._diagonal)
        added = damping * np.maximum(curvature, _MIN_DIAGONAL)
        damped = self._diagonal.copy()
        np.einsum("nii->ni", damped)[:] += added
        found = self._solve_by_iterations(damped) or self._solve_directly(damped)
        if found is None:
            return None
        steps, residual = found
        # c(0) - c(x) = -g^T x - x^T H x / 2, with (H + D) x = -g - residual
        self._predicted = 0.5 * float((steps * (added * steps - self._gradient + residual)).sum())
        return steps

    def _solve_by_iterations(self, damped: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Step and what it leaves of the gradient; None where a factorization is cheaper."""
        if not self._factorized or not self._max_iterations:
            return None
        return conjugate_gradients(
            damped, self._off_diagonal, self._pairs, -self._gradient, self._cholesky.solve,
            _STEP_TOLERANCE, self._max_iterations,
        )  # fmt: skip

    def _solve_directly(self, damped: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Step, leaving nothing; None if singular."""
        self._factorized = self._cholesky.factorize(damped, self._off_diagonal)
        if not self._factorized:
            return None
        steps = self._cholesky.solve(-self._gradient)
        return (steps, np.zeros_like(steps)) if np.all(np.isfinite(steps)) else None

    def predicted_decrease(self) -> float:
        """Decrease of the cost that the undamped model expects of the last step."""
        return self._predicted

    def retract(self, values: gtsam.Values, steps: np.ndarray) -> gtsam.Values:
        """Values moved by steps (N, 6)."""
        delta = gtsam.VectorValues()
        flat = steps.ravel()
        for key, dim in zip(self.keys, self._dims, strict=True):
            start = DIM * self.first_block[key]
            delta.insert(key, flat[start : start + dim])
        return values.retract(delta)

    def _gathered(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        """Off-diagonal blocks (P, 6, 6) of all; those of one block of factors that has them all,
        gigabytes of many laps, are not copied."""
        if len(parts) == 1:
            slots, flip = self._block_slots[0]
            if len(slots) == len(self._pairs) and not flip.any():
                return parts[0]
        out = np.zeros((len(self._pairs), DIM, DIM))
        for part, (slots, flip) in zip(parts, self._block_slots, strict=True):
            _add_blocks(out, slots, flip, part)
        return out

    def propose(self, values: gtsam.Values, steps: np.ndarray) -> float:
        """Total cost at tentative values, `steps (N, 6)` from the linearization point."""
        cost = self._graph.error(values) if self._graph_keys else 0.0
        for block, rows in zip(self._blocks, self._block_rows, strict=True):
            cost += block.propose(values, steps[rows])
        return cost

    def costs(self, values: gtsam.Values) -> dict[str, float]:
        """Cost of each family at accepted values."""
        costs: dict[str, float] = {}
        for block in self._blocks:
            _add_costs(costs, block.costs(values))
        if self._graph_keys:
            _add_costs(costs, {GRAPH: self._graph.error(values)})
        return costs

    def covariances(
        self, num_draws: int, rng: np.random.Generator, damping: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Blocks of H^-1 at the linearization point, and draws from it; None if singular.

        A block that nothing constrains is NaN and does not count.

        Args:
            num_draws: D.
            rng: of these.
            damping: part of the diagonal that is added to it.

        Returns:
            (N, 6, 6) those on the diagonal, (P, 6, 6) those between the first blocks of `pairs`,
            and vectors (D, N, 6) of covariance H^-1.
        """
        idle = np.logical_not(np.any(self._diagonal, axis=(1, 2)))
        diagonal = np.where(idle[:, None, None], np.eye(DIM), self._diagonal)
        np.einsum("nii->ni", diagonal)[:] *= 1 + damping
        self._factorized = self._cholesky.factorize(diagonal, self._off_diagonal)
        if not self._factorized:
            return None
        inverse, between = self._cholesky.inverse_blocks(self._asked)
        drawn = self._cholesky.draw(rng.normal(size=(num_draws, self._num, DIM)))
        inverse[idle], drawn[:, idle] = np.nan, np.nan
        between[idle[self._asked].any(axis=1)] = np.nan
        return inverse, between, drawn

    def _padded_entries(self, counts: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """(block, coordinate) of the entries that belong to no variable."""
        pads = [
            (self.first_block[key] + count - 1, coordinate)
            for key, dim, count in zip(self.keys, self._dims, counts, strict=True)
            for coordinate in range(dim - DIM * (count - 1), DIM)
        ]
        table = np.array(pads, dtype=np.int64).reshape(-1, 2)
        return table[:, 0], table[:, 1]

    def _set_pairs(self, factor_keys: list[list[int]], counts: dict[int, int]) -> None:
        """Pattern of the off-diagonal blocks, and where each block's pairs lie in it."""
        shared = {
            pair
            for keys in factor_keys
            for pair in combinations(
                sorted(self.first_block[key] + i for key in set(keys) for i in range(counts[key])),
                2,
            )
        }
        placed = [np.array(sorted(shared), dtype=np.int64).reshape(-1, 2)]
        placed += [
            rows[block.pairs].reshape(-1, 2)
            for block, rows in zip(self._blocks, self._block_rows, strict=True)
        ]
        codes = [self._pair_codes(pairs) for pairs in placed]
        self._codes = np.unique(np.concatenate(codes))
        self._pairs = np.column_stack(np.divmod(self._codes, self._num))
        self._block_slots = [
            (np.searchsorted(self._codes, code), pairs[:, 0] > pairs[:, 1])
            for code, pairs in zip(codes[1:], placed[1:], strict=True)
        ]

    def _pair_codes(self, pairs: np.ndarray) -> np.ndarray:
        return pairs.min(axis=1, initial=self._num) * self._num + pairs.max(axis=1, initial=0)

    def _set_columns(self, dims: dict[int, int]) -> None:
        """Place of each column of the graph's sparse Jacobian (keys in sorted order)."""
        blocks = [
            self.first_block[key] + c // DIM for key in self._graph_keys for c in range(dims[key])
        ]
        self._column_blocks = np.array(blocks, dtype=np.int64)
        self._column_offsets = np.array(
            [c % DIM for key in self._graph_keys for c in range(dims[key])], dtype=np.int64
        )

    def _add_graph(self, values: gtsam.Values) -> None:
        """Add the native and user factors, linearized by GTSAM."""
        num = len(self._column_blocks)
        rows, columns, entries = self._graph.linearize(values).sparseJacobian_()
        augmented = csr_matrix(
            (entries, (rows.astype(np.int64) - 1, columns.astype(np.int64) - 1)),
            shape=(int(rows.max(initial=1)), num + 1),
        )
        product = (augmented.T @ augmented).tocoo()
        i, j, x = product.row, product.col, product.data
        right = (j == num) & (i < num)  # the last column is -r
        np.subtract.at(
            self._gradient,
            (self._column_blocks[i[right]], self._column_offsets[i[right]]),
            x[right],
        )
        inner = (i < num) & (j < num)
        i, j, x = i[inner], j[inner], x[inner]
        block_i, block_j = self._column_blocks[i], self._column_blocks[j]
        offset_i, offset_j = self._column_offsets[i], self._column_offsets[j]
        same, upper = block_i == block_j, block_i < block_j
        np.add.at(self._diagonal, (block_i[same], offset_i[same], offset_j[same]), x[same])
        slots = np.searchsorted(self._codes, block_i[upper] * self._num + block_j[upper])
        np.add.at(self._off_diagonal, (slots, offset_i[upper], offset_j[upper]), x[upper])


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
