"""The reduced camera system of a graph and its blocks: assembled in 6x6 blocks, damped, solved."""

from collections.abc import Sequence
from itertools import combinations

import gtsam
import numpy as np
from scipy.sparse import csr_matrix

from factors._terms import pose_rows
from factors.block import Block
from factors.cholesky import DIM, BlockCholesky
from factors.coarse_preconditioner import Coarse, coarse_system
from factors.compiled import kernel_and_part
from factors.conjugate_gradients import conjugate_gradients, multiply_blocks
from factors.landmarks import LandmarkBlock
from factors.pose_clusters import covisible_groups
from factors.schur_complement import GroupVisits, group_visits

_kernel, _ = kernel_and_part()

GRAPH = "graph"  # family under which the cost of the native and user factors is reported
_MIN_DIAGONAL = 1e-6  # least curvature that damping is relative to, per sigma
_STEP_TOLERANCE = 1e-2  # tolerance of a step by conjugate gradients: the next linearization
# corrects the rest
_OPERATIONS_PER_BYTE = 4.0  # operations of a core on dense blocks in the time of reading a byte
_MIN_ITERATIONS = 10  # conjugate-gradient iterations that must be cheaper than half a
# factorization
_MAX_OPERATIONS = 4e9  # largest number of operations of a factorization: beyond, landmarks stay in
# factored form
_MAX_INVERSE_OPERATIONS = 1.5e11  # largest number of operations of the factorization for selected
# inversion (covariances)
_NATIVE_FACTOR_WEIGHT = 1e-3  # landmarks that a native factor counts for when groups are formed
_MAX_ITERATIONS = 300  # largest number of conjugate-gradient iterations in factored form; ten or
# twenty suffice
_DRAW_TOLERANCE = 1e-3  # tolerance of drawn errors: no motion of thousands of frames may be missed
_MIN_DRAWS = 200  # least number of draws whose spread gives a covariance
_DRAWS_AT_ONCE = 20


class ReducedSystem:
    """Normal equations over all variables that a graph and blocks name.

    Every variable takes whole 6x6 blocks: a Pose3 takes one, smaller ones are padded by an
    uncoupled identity, larger ones are split. `first_block` maps a key to its first block.

    If covisibility would fill in a factorization, the landmarks' Schur complement is kept in
    factored form; steps and covariances are then computed by conjugate gradients
    (`factors.coarse_preconditioner`).
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
            pairs: keys of two variables each, whose joint block `covariances` returns.

        Raises:
            ValueError: a variable has no value.
        """
        self._graph, self._blocks = graph, tuple(blocks)
        factor_keys = [graph.at(i).keys() for i in range(graph.size()) if graph.exists(i)]
        self._graph_keys = sorted({key for keys in factor_keys for key in keys})
        block_keys = [key for block in self._blocks for key in block.keys]
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
            np.array([self.first_block[key] for key in block.keys], dtype=np.int64)
            for block in self._blocks
        ]
        self._padding = self._padded_entries(counts)
        self._asked = np.array([self.first_block[key] for key in paired], np.int64).reshape(-1, 2)
        self._set_columns(all_dims)
        blocks_of = dict(zip(self.keys, counts, strict=True))
        self._factor_pairs = self._pairs_of([*factor_keys, *map(list, pairs)], blocks_of)
        self._held: dict[int, list[GroupVisits]] = {}  # visits by groups, of blocks in factored
        # form
        self._coarse: Coarse | None = None  # of an earlier system
        self._cholesky: BlockCholesky | None = None
        self._factorized = False  # True if the Cholesky factor is of an earlier system
        landmarks = [block for block in self._blocks if isinstance(block, LandmarkBlock)]
        can_hold = len(landmarks) > 0 and (len(landmarks) == len(self._blocks) or not pairs)
        most = _MAX_INVERSE_OPERATIONS if pairs else _MAX_OPERATIONS
        # A factorization takes at least the squares of the rows' fill.
        fullest = max((len(block.shared) for block in landmarks), default=0)
        fills_in = can_hold and DIM**3 * fullest**2 > most * self._num
        if not fills_in:
            self._set_pairs()
            fills_in = can_hold and self._factor().num_operations > most
        if fills_in:
            self._hold_landmarks()
        else:
            self._set_cholesky()

    def _factor(self) -> BlockCholesky:
        if self._cholesky is None:
            self._cholesky = BlockCholesky(self._num, self._pairs)
        return self._cholesky

    def _set_cholesky(self) -> None:
        """Choose between factorizations, and conjugate gradients preconditioned by an earlier
        factor."""
        cholesky = self._factor()
        bytes_read = 8 * (2 * cholesky.num_entries + DIM * DIM * len(self._pairs))
        cheaper = cholesky.num_operations / (2 * _OPERATIONS_PER_BYTE * max(bytes_read, 1))
        self._max_iterations = int(cheaper) if cheaper >= _MIN_ITERATIONS else 0

    def _hold_landmarks(self) -> None:
        """Keep landmarks in factored form, with visits by groups of covisible frames."""
        landmarks = {
            i: block for i, block in enumerate(self._blocks) if isinstance(block, LandmarkBlock)
        }
        shares = [
            (self._block_rows[i][block.pairs], block.shared) for i, block in landmarks.items()
        ]
        poses = np.zeros(self._num, bool)
        for i in landmarks:
            poses[self._block_rows[i]] = True
        tied = self._factor_pairs[poses[self._factor_pairs].all(axis=1)]
        self._groups = covisible_groups(
            self._num, [*shares, (tied, np.full(len(tied), _NATIVE_FACTOR_WEIGHT))]
        )
        self._cholesky = None
        for i, block in landmarks.items():
            labels = self._groups.labels[self._block_rows[i]]
            self._held[i] = group_visits(block.visits, labels, self._groups.num)
        self._set_pairs()

    def linearize(self, values: gtsam.Values) -> dict[str, float]:
        """Assemble H and the gradient at `values`; returns the cost of each family."""
        self._diagonal = np.zeros((self._num, DIM, DIM))
        self._gradient = np.zeros((self._num, DIM))
        self._off_diagonal = np.zeros((0, DIM, DIM))  # frees the previous blocks
        self._jacobian = csr_matrix((0, len(self._column_blocks)))  # of the graph
        costs: dict[str, float] = {}
        parts, self._complements = [], []
        for i, (block, rows) in enumerate(zip(self._blocks, self._block_rows, strict=True)):
            if i in self._held and isinstance(block, LandmarkBlock):
                complement, gradient, found = block.eliminate(values)
                self._gradient[rows] += gradient
                self._complements.append((complement, rows, self._held[i]))
                _add_costs(costs, found)
                continue
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
        self._written = self._diagonal  # without landmarks in factored form
        if self._held:
            self._diagonal = self._written.copy()
            for complement, rows, _ in self._complements:
                self._diagonal[rows] += complement.diagonal
            poses = np.zeros((self._num, 12))
            for i in self._held:
                poses[self._block_rows[i]] = pose_rows(values, self._blocks[i].keys)
            self._bases = self._groups.bases(poses)
        return costs

    def solve(self, damping: float) -> np.ndarray | None:
        """Step (N, 6) of the system damped by `damping` times its diagonal; None if singular.

        If fill-in is large, the Cholesky factor of an earlier system preconditions conjugate
        gradients; it is renewed when they would take longer than a factorization.
        """
        curvature = np.einsum("nii->ni", self._diagonal)
        added = damping * np.maximum(curvature, _MIN_DIAGONAL)
        if self._held:
            found = self._step_held(added)
        else:
            damped = self._diagonal.copy()
            np.einsum("nii->ni", damped)[:] += added
            found = self._solve_by_iterations(damped) or self._solve_directly(damped)
        if found is None:
            return None
        steps, residual = (part.reshape(-1, DIM) for part in found)
        # c(0) - c(x) = -g^T x - x^T H x / 2, with (H + D) x = -g - residual
        self._predicted = 0.5 * float((steps * (added * steps - self._gradient + residual)).sum())
        return steps

    def _solve_held(
        self,
        added: np.ndarray,
        right: np.ndarray,
        tolerance: float,
        max_iterations: int = _MAX_ITERATIONS,
        truncate: bool = False,
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Solutions (N, 6, R) with `added (N, 6)` on the diagonal, and the residuals of `right`.

        None if they take too many iterations, or the groups' system is singular.
        """
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

    def _step_held(self, added: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Step preconditioned by an earlier groups' system, or by a new one if that is faster."""
        right = -self._gradient[..., None]
        if self._coarse is not None:
            found = self._solve_held(added, right, _STEP_TOLERANCE, self._max_iterations)
            if found is not None:
                return found
            self._coarse = None
        found = self._solve_held(added, right, _STEP_TOLERANCE, truncate=True)
        self._max_iterations = 2 * self._iterations
        return found

    def _solve_by_iterations(self, damped: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Step and residual of the gradient; None if a factorization is cheaper."""
        if not self._factorized or not self._max_iterations:
            return None
        factor = self._factor()

        def multiply(x: np.ndarray) -> np.ndarray:
            return multiply_blocks(damped, self._off_diagonal, self._pairs, x)

        def precondition(residual: np.ndarray) -> np.ndarray:
            return factor.solve(residual[..., 0])[..., None]

        right = -self._gradient[..., None]
        return conjugate_gradients(
            multiply, right, precondition, _STEP_TOLERANCE, self._max_iterations
        )

    def _solve_directly(self, damped: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Step and zero residual; None if singular."""
        self._factorized = self._factor().factorize(damped, self._off_diagonal)
        if not self._factorized:
            return None
        steps = self._factor().solve(-self._gradient)
        return (steps, np.zeros_like(steps)) if np.all(np.isfinite(steps)) else None

    def predicted_decrease(self) -> float:
        """Decrease of the cost that the undamped model predicts for the last step."""
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

        An unconstrained block is NaN and is left out. With landmarks in factored form, a free gauge
        is not detected: its errors are merely enormous.

        Args:
            num_draws: number of draws, D.
            rng: generator of the draws.
            damping: part of the diagonal that is added to it.

        Returns:
            (N, 6, 6) diagonal blocks, (P, 6, 6) blocks between the first blocks of `pairs`, and
            vectors (D, N, 6) of covariance H^-1.
        """
        idle = np.logical_not(np.any(self._diagonal, axis=(1, 2)))
        diagonal = np.where(idle[:, None, None], np.eye(DIM), self._diagonal)
        np.einsum("nii->ni", diagonal)[:] *= 1 + damping
        if self._held:
            found = self._drawn(np.einsum("nii->ni", diagonal - self._diagonal), num_draws, rng)
            if found is None:
                return None
            drawn = found
            i, j = self._asked.T
            inverse = np.einsum("dnr,dnc->nrc", drawn, drawn) / len(drawn)
            between = np.einsum("dnr,dnc->nrc", drawn[:, i], drawn[:, j]) / len(drawn)
        else:
            self._factorized = self._factor().factorize(diagonal, self._off_diagonal)
            if not self._factorized:
                return None
            inverse, between = self._factor().inverse_blocks(self._asked)
            drawn = self._factor().draw(rng.normal(size=(num_draws, self._num, DIM)))
        inverse[idle], drawn[:, idle] = np.nan, np.nan
        between[idle[self._asked].any(axis=1)] = np.nan
        return inverse, between, drawn

    def _drawn(
        self, added: np.ndarray, num_draws: int, rng: np.random.Generator
    ) -> np.ndarray | None:
        """Vectors (D, N, 6) of covariance (H + added)^-1: that inverse times J^T e, e of all
        factors."""
        draws, self._coarse = [], None
        for _ in range(0, max(num_draws, _MIN_DRAWS), _DRAWS_AT_ONCE):
            right = np.sqrt(added)[..., None] * rng.normal(size=(*added.shape, _DRAWS_AT_ONCE))
            for complement, rows, _ in self._complements:
                right[rows] += complement.draw(int(rng.integers(1 << 62)), _DRAWS_AT_ONCE)
            errors = rng.normal(size=(len(self._jacobian.indptr) - 1, _DRAWS_AT_ONCE))
            np.add.at(right, (self._column_blocks, self._column_offsets), self._jacobian.T @ errors)
            found = self._solve_held(added, right, _DRAW_TOLERANCE)
            if found is None:
                return None
            draws.append(np.moveaxis(found[0], 2, 0))
        return np.concatenate(draws)

    def _padded_entries(self, counts: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """(block, coordinate) of the padding entries."""
        pads = [
            (self.first_block[key] + count - 1, coordinate)
            for key, dim, count in zip(self.keys, self._dims, counts, strict=True)
            for coordinate in range(dim - DIM * (count - 1), DIM)
        ]
        table = np.array(pads, dtype=np.int64).reshape(-1, 2)
        return table[:, 0], table[:, 1]

    def _pairs_of(self, factor_keys: list[list[int]], counts: dict[int, int]) -> np.ndarray:
        """Pairs (P, 2) of blocks coupled by factors of these keys, ascending."""
        shared = {
            pair
            for keys in factor_keys
            for pair in combinations(
                sorted(self.first_block[key] + i for key in set(keys) for i in range(counts[key])),
                2,
            )
        }
        return np.array(sorted(shared), dtype=np.int64).reshape(-1, 2)

    def _set_pairs(self) -> None:
        """Pattern of the off-diagonal blocks, and the slots in it of blocks that are written
        out."""
        placed = [self._factor_pairs]
        placed += [
            rows[block.pairs].reshape(-1, 2)
            for i, (block, rows) in enumerate(zip(self._blocks, self._block_rows, strict=True))
            if i not in self._held
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
        self._jacobian = augmented[:, :num]
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
