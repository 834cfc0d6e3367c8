"""The normal equations of a graph and its blocks, assembled in 6x6 blocks."""

from collections.abc import Collection, Mapping, Sequence

import gtsam
import numpy as np
from scipy.sparse import csr_matrix

from factors.cholesky import DIM
from factors.compiled import kernel_and_part
from factors.system_layout import SystemLayout

_kernel, _ = kernel_and_part()

GRAPH = "graph"  # family under which the cost of the native and user factors is reported


class NormalEquations:
    """Second-order model of the cost over all variables that a graph and blocks name."""

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
        num = layout.num
        codes = [p.min(axis=1, initial=num) * num + p.max(axis=1, initial=0) for p in placed]
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
        """Assemble H and the gradient at `values`; returns the cost of each family.

        FloatingPointError: a Jacobian of the graph is not finite where its residual is.
        """
        layout = self._layout
        self._diagonal = np.zeros((layout.num, DIM, DIM))
        self._gradient = np.zeros((layout.num, DIM))
        self._off_diagonal = np.zeros((0, DIM, DIM))  # frees the previous blocks
        self._jacobian = csr_matrix((0, len(layout.column_blocks)))  # of the graph
        costs: dict[str, float] = {}
        parts: list[np.ndarray] = []
        for i in range(len(layout.blocks)):
            add_costs(costs, self._add_block(i, values, parts))
        self._off_diagonal = self._gathered(parts)
        if layout.graph_keys:
            self._add_graph(values)
            add_costs(costs, {GRAPH: layout.graph.error(values)})
        self._diagonal[layout.padding[0], layout.padding[1], layout.padding[1]] = 1.0
        return costs

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
        """Off-diagonal blocks (P, 6, 6) of all factors; a single block's own is not copied."""
        if len(parts) == 1:
            slots, flip = self._block_slots[0]
            if np.array_equal(slots, np.arange(len(self._pairs))) and not flip.any():
                return parts[0]
        out = np.zeros((len(self._pairs), DIM, DIM))
        for part, (slots, flip) in zip(parts, self._block_slots, strict=True):
            _add_blocks(out, slots, flip, part)
        return out

    def _add_graph(self, values: gtsam.Values) -> None:
        """Add the native and user factors, linearized by GTSAM."""
        layout, num = self._layout, len(self._layout.column_blocks)
        linear = layout.graph.linearize(values)
        _check_finite(linear)
        rows, columns, entries = linear.sparseJacobian_()
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


def _check_finite(linear: gtsam.GaussianFactorGraph) -> None:
    """FloatingPointError where a Jacobian is not finite: GTSAM's sparse Jacobian has no NaN, but
    zeros in their place. Residuals that are not finite are left to the cost."""
    if np.isfinite(linear.gradientAtZero().norm()):
        return
    for factor in (linear.at(i) for i in range(linear.size())):
        jacobian, right = factor.jacobian() if factor else (np.zeros(0), np.zeros(0))
        if np.isfinite(right).all() and not np.isfinite(jacobian).all():
            keys = ", ".join(map(gtsam.DefaultKeyFormatter, factor.keys()))
            raise FloatingPointError(f"the Jacobian of the factor on {keys} is not finite")


def damping_of(diagonal: np.ndarray, damping: float) -> np.ndarray:
    """Damping (N, 6): `damping` times the diagonal of blocks (N, 6, 6)."""
    return damping * np.maximum(np.einsum("nii->ni", diagonal), 1e-6)


@_kernel
def _add_blocks(target, slots, flip, blocks):
    """Add blocks (Q, 6, 6), those to be flipped transposed, to the slots (Q,) of others."""
    for q in range(len(slots)):
        to, block = target[slots[q]], blocks[q]
        for r in range(DIM):
            for c in range(DIM):
                to[r, c] += block[c, r] if flip[q] else block[r, c]


def add_costs(total: dict[str, float], costs) -> None:
    for name, cost in costs.items():
        total[name] = total.get(name, 0.0) + cost
