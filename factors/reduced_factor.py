"""A block as one ordinary GTSAM factor on its poses."""

from copy import copy

import gtsam
import numpy as np

from factors.block import Block
from factors.compiled import kernel_and_part

_kernel, _ = kernel_and_part()


def block_factor(block: Block) -> gtsam.CustomFactor:
    """A factor on a block's Pose3 variables, for any GTSAM optimizer: its error is the robust cost,
    inner variables optimised for the poses, and its linearization that cost's model, dense over all
    poses. If derivatives are requested, these inner variables become the block's current ones.

    GTSAM does not call `block.refresh`: call it at the start values, for a block that has one."""
    num, pairs = len(block.keys), np.asarray(block.pairs).reshape(-1, 2)

    def error(_factor, values: gtsam.Values, jacobians) -> np.ndarray:
        tried = copy(block) if jacobians is None else block
        polish = getattr(tried, "polish", None)  # of a block with inner variables
        cost = polish(values) if polish else sum(tried.costs(values).values())
        out = np.zeros(6 * num + 1)
        if jacobians is not None:
            system, H = block.linearize(values), np.zeros((num, 6, num, 6))
            H[np.arange(num), :, np.arange(num), :] = system.diagonal
            H[pairs[:, 0], :, pairs[:, 1], :] = system.off_diagonal
            root = H.reshape(6 * num, 6 * num)
            out[:-1] = _square_root(root, system.gradient.ravel())
            padded = np.vstack([root, np.zeros((1, 6 * num))])
            for i in range(num):
                jacobians[i] = np.asfortranarray(padded[:, 6 * i : 6 * i + 6])
        out[-1] = np.sqrt(max(2 * cost - float(out @ out), 0.0))
        return out

    noise = gtsam.noiseModel.Unit.Create(6 * num + 1)
    return gtsam.CustomFactor(noise, list(block.keys), error)


@_kernel
def _square_root(H, gradient):
    """Upper R with R^T R = H in place, from H's upper triangle, and e with R^T e = gradient.

    H is positive semidefinite (the gauge is free): a direction without curvature gets a zero row,
    and has no gradient either.
    """
    num = len(H)
    e = np.zeros(num)
    scale = np.zeros(num)
    for i in range(num):
        scale[i] = H[i, i]
        H[i, :i] = 0.0
    for i in range(num):
        if not H[i, i] > 1e-10 * scale[i]:
            H[i, i:] = 0.0
            continue
        H[i, i:] /= np.sqrt(H[i, i])
        e[i] = gradient[i]
        for k in range(i):
            e[i] -= H[k, i] * e[k]
        e[i] /= H[i, i]
        for k in range(i + 1, num):
            H[k, k:] -= H[i, k] * H[i, k:]
    return e
