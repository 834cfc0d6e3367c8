"""The reduced camera system by Cholesky factorization, which may precondition later steps."""

from collections.abc import Sequence

import gtsam
import numpy as np

from factors.block import Block
from factors.cholesky import DIM, BlockCholesky
from factors.iterative_system import IterativeSystem, conjugate_gradients, multiply_blocks
from factors.reduced_camera_system import STEP_TOLERANCE, ReducedSystem
from factors.system_layout import SystemLayout


class DirectSystem(ReducedSystem):
    """Normal equations that are written out and factorized.

    If fill-in is large, the Cholesky factor of an earlier system preconditions conjugate
    gradients; it is renewed when they would take longer than a factorization.
    """

    def __init__(self, layout: SystemLayout) -> None:
        """Fix the pattern and that of its Cholesky factor."""
        super().__init__(layout)
        self._cholesky = BlockCholesky(layout.num, self._pairs)
        self._factorized = False  # True if the Cholesky factor is of an earlier system
        bytes_read = 8 * (2 * self._cholesky.num_entries + DIM * DIM * len(self._pairs))
        # a core does 4 operations on dense blocks in the time of reading a byte
        cheaper = self.num_operations / (8.0 * max(bytes_read, 1))
        self._max_iterations = int(cheaper) if cheaper >= 10 else 0

    @property
    def num_operations(self) -> float:
        """Number of operations of a factorization."""
        return self._cholesky.num_operations

    def _step(self, added: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        damped = self._diagonal.copy()
        np.einsum("nii->ni", damped)[:] += added
        found = self._step_by_iterations(damped)
        if found is not None:
            return found
        self._factorized = self._cholesky.factorize(damped, self._off_diagonal)
        if not self._factorized:
            return None
        steps = self._cholesky.solve(-self._gradient)
        return (steps, np.zeros_like(steps)) if np.all(np.isfinite(steps)) else None

    def _step_by_iterations(self, damped: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Step and residual of the gradient; None if a factorization is cheaper."""
        if not self._factorized or not self._max_iterations:
            return None

        def multiply(x: np.ndarray) -> np.ndarray:
            return multiply_blocks(damped, self._off_diagonal, self._pairs, x)

        def precondition(residual: np.ndarray) -> np.ndarray:
            return self._cholesky.solve(residual[..., 0])[..., None]

        right = -self._gradient[..., None]
        return conjugate_gradients(
            multiply, right, precondition, STEP_TOLERANCE, self._max_iterations
        )

    def _inverse(
        self, diagonal: np.ndarray, num_draws: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        self._factorized = self._cholesky.factorize(diagonal, self._off_diagonal)
        if not self._factorized:
            return None
        inverse, between = self._cholesky.inverse_blocks(self._layout.asked)
        drawn = self._cholesky.draw(rng.normal(size=(num_draws, self._layout.num, DIM)))
        return inverse, between, drawn


_MAX_OPERATIONS = 4e9  # largest number of operations of a factorization: beyond, blocks that offer
# products of their Hessian are not written out
_MAX_INVERSE_OPERATIONS = 1.5e11  # largest number of operations of the factorization for selected
# inversion (covariances)


def reduced_system(
    graph: gtsam.NonlinearFactorGraph,
    blocks: Sequence[Block],
    values: gtsam.Values,
    pairs: Sequence[tuple[int, int]] = (),
) -> ReducedSystem:
    """The normal equations of a graph and blocks, with the cheaper solver: conjugate gradients take
    over where covisibility would fill in a factorization. `covariances` returns the joint blocks of
    `pairs` of keys. ValueError: a variable has no value, or a factor is a hard constraint."""
    layout = SystemLayout(graph, blocks, values, pairs)
    offered = {i: block.products() for i, block in enumerate(layout.blocks)}
    products = {i: product for i, product in offered.items() if product is not None}
    most = _MAX_INVERSE_OPERATIONS if pairs else _MAX_OPERATIONS
    if not products or (pairs and len(products) < len(layout.blocks)):
        return DirectSystem(layout)
    # A factorization takes at least the squares of the rows' fill.
    fullest = max(len(product.shared) for product in products.values())
    if DIM**3 * fullest**2 > most * layout.num:
        return IterativeSystem(layout, products)
    direct = DirectSystem(layout)
    return direct if direct.num_operations <= most else IterativeSystem(layout, products)
