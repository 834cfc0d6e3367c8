"""The choice between the solvers of a reduced camera system."""

from collections.abc import Sequence

import gtsam

from factors.block import Block
from factors.cholesky import DIM
from factors.direct_system import DirectSystem
from factors.iterative_system import IterativeSystem
from factors.reduced_camera_system import ReducedSystem
from factors.system_layout import SystemLayout

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
    """The normal equations of a graph and blocks, with the cheaper solver.

    Conjugate gradients take over where covisibility would fill in a factorization.

    Args:
        pairs: keys of two variables each, whose joint block `covariances` returns.

    Raises:
        ValueError: a variable has no value.
    """
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
