"""A block's reduced system as one ordinary GTSAM factor on its poses."""

from collections.abc import Callable, Sequence

import gtsam
import numpy as np

from factors.block import PoseSystem
from factors.compiled import kernel_and_part

_kernel, _ = kernel_and_part()

Evaluate = Callable[[gtsam.Values, bool], tuple[float, PoseSystem | None]]


def reduced_factor(
    keys: Sequence[int], pairs: np.ndarray, evaluate: Evaluate
) -> gtsam.CustomFactor:
    """A factor on Pose3 variables, keys (F,), whose error is a robust cost, and whose linearization
    is that cost's model, with off-diagonal blocks of rows f < g of keys, pairs (P, 2); evaluate:
    cost at values, with inner variables optimised for them; and, if requested, the model there."""
    num, columns = len(keys), np.asarray(pairs).reshape(-1, 2)

    def error(_factor, values: gtsam.Values, jacobians) -> np.ndarray:
        cost, system = evaluate(values, jacobians is not None)
        out = np.zeros(6 * num + 1)
        if system is not None:
            H = np.zeros((num, 6, num, 6))
            H[np.arange(num), :, np.arange(num), :] = system.diagonal
            H[columns[:, 0], :, columns[:, 1], :] = system.off_diagonal
            root = H.reshape(6 * num, 6 * num)
            out[:-1] = _square_root(root, system.gradient.ravel())
            padded = np.vstack([root, np.zeros((1, 6 * num))])
            for i in range(num):
                jacobians[i] = np.asfortranarray(padded[:, 6 * i : 6 * i + 6])
        out[-1] = np.sqrt(max(2 * cost - float(out @ out), 0.0))
        return out

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(6 * num + 1), list(keys), error)


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
