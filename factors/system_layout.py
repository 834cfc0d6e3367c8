"""The layout of a reduced camera system: which variable takes which 6x6 blocks."""

from collections.abc import Sequence
from itertools import combinations

import gtsam
import numpy as np

from factors.block import Block
from factors.cholesky import DIM


class SystemLayout:
    """Variables that a graph and blocks name, and the 6x6 blocks that each takes.

    A Pose3 takes one, smaller variables are padded by an uncoupled identity, larger ones are split.

    Attributes:
        graph, blocks: what the system is made of.
        keys, dims: of all variables.
        first_block: the first block of each key.
        num: number of blocks, N.
        block_rows: rows (F,) of each of `blocks`' variables.
        padding: (block, coordinate) of the padding entries.
        asked: (P, 2) first blocks of the pairs asked for.
        factor_pairs: (Q, 2) blocks coupled by the graph or asked for, ascending.
        graph_keys: keys of the graph, sorted, as its sparse Jacobian has them.
        column_blocks, column_offsets: block and coordinate of each column of that Jacobian.
    """

    def __init__(
        self,
        graph: gtsam.NonlinearFactorGraph,
        blocks: Sequence[Block],
        values: gtsam.Values,
        pairs: Sequence[tuple[int, int]] = (),
        order: Sequence[int] = (),
    ) -> None:
        """Place the variables, those of `order` first; `covariances` returns the joint blocks of
        pairs of keys. ValueError: a variable has no value, or a factor is a hard constraint."""
        self.graph, self.blocks = graph, tuple(blocks)
        for i in range(graph.size()):
            if graph.exists(i) and is_hard_constraint(graph.at(i)):
                keys = ", ".join(map(gtsam.DefaultKeyFormatter, graph.at(i).keys()))
                raise ValueError(
                    f"the factor on {keys} is a hard constraint (noiseModel.Constrained): give it "
                    "a small sigma such as 1e-6"
                )
        factor_keys = [graph.at(i).keys() for i in range(graph.size()) if graph.exists(i)]
        self.graph_keys = sorted({key for keys in factor_keys for key in keys})
        block_keys = [key for block in self.blocks for key in block.keys]
        paired = [key for pair in pairs for key in pair]
        self.keys = list(dict.fromkeys([*order, *block_keys, *self.graph_keys, *paired]))
        all_dims = values.dims()
        for key in self.keys:
            if key not in all_dims:
                raise ValueError(f"variable {gtsam.DefaultKeyFormatter(key)} has no value")
        self.dims = [all_dims[key] for key in self.keys]
        counts = [-(-dim // DIM) for dim in self.dims]
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        self.first_block = dict(zip(self.keys, starts[:-1].tolist(), strict=True))
        self.num = int(starts[-1])
        self.block_rows = [
            np.array([self.first_block[key] for key in block.keys], dtype=np.int64)
            for block in self.blocks
        ]
        pads = [
            (self.first_block[key] + count - 1, coordinate)
            for key, dim, count in zip(self.keys, self.dims, counts, strict=True)
            for coordinate in range(dim - DIM * (count - 1), DIM)
        ]
        table = np.array(pads, dtype=np.int64).reshape(-1, 2)
        self.padding = table[:, 0], table[:, 1]
        self.asked = np.array([self.first_block[key] for key in paired], np.int64).reshape(-1, 2)
        places = [
            self.first_block[key] + c // DIM
            for key in self.graph_keys
            for c in range(all_dims[key])
        ]
        self.column_blocks = np.array(places, dtype=np.int64)
        self.column_offsets = np.array(
            [c % DIM for key in self.graph_keys for c in range(all_dims[key])], dtype=np.int64
        )
        blocks_of = dict(zip(self.keys, counts, strict=True))
        shared = {
            pair
            for keys in [*factor_keys, *map(list, pairs)]
            for pair in combinations(
                sorted(
                    self.first_block[key] + i for key in set(keys) for i in range(blocks_of[key])
                ),
                2,
            )
        }
        self.factor_pairs = np.array(sorted(shared), dtype=np.int64).reshape(-1, 2)


def is_hard_constraint(factor: gtsam.NonlinearFactor) -> bool:
    """True if a residual of a factor has no noise: normal equations have no weight for it. (GTSAM
    calls a noise below 1e-8 constrained, too, and weights it rightly.)"""
    noise = factor.noiseModel() if isinstance(factor, gtsam.NoiseModelFactor) else None
    return noise is not None and noise.isConstrained() and not noise.sigmas().all()
