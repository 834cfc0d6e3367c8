"""Numerical check of a factor's analytic Jacobians."""

import gtsam
import numpy as np


def jacobian_errors(
    factor: gtsam.NonlinearFactor, values: gtsam.Values, step: float = 1e-5
) -> dict[int, float]:
    """Largest disagreement between a factor's Jacobians and central differences.

    The factor is linearized by GTSAM, so that the check covers the optimizer's input: whitened
    and, with a robust noise model, weighted. Give the factor a Gaussian noise model: robust weights
    are no part of a residual's derivative.

    Args:
        step: of the differences, in each variable's tangent space.

    Returns:
        For each key the largest entry of |analytic - numerical|, relative to the largest entry of
        that Jacobian (to 1 where all entries are smaller); inf where one is not finite.
    """
    linear = factor.linearize(values)
    jacobian = linear.jacobian()[0]
    dims = values.dims()
    errors: dict[int, float] = {}
    column = 0
    for key in linear.keys():  # noqa: SIM118  (a factor is no mapping)
        analytic = jacobian[:, column : column + dims[key]]
        numerical = np.empty_like(analytic)
        for i in range(dims[key]):
            moved = []
            for sign in (1.0, -1.0):
                delta = gtsam.VectorValues()
                delta.insert(key, sign * step * np.eye(dims[key])[i])
                # b of the linearized factor is minus the whitened residual
                moved.append(-factor.linearize(values.retract(delta)).jacobian()[1])
            numerical[:, i] = (moved[0] - moved[1]) / (2 * step)
        scale = max(1.0, float(np.abs(analytic).max(initial=0.0)))
        error = float(np.abs(analytic - numerical).max(initial=0.0)) / scale
        errors[key] = error if np.isfinite(error) else np.inf  # max() of a dictionary skips NaN
        column += dims[key]
    return errors
