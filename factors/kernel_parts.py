"""Parts that several kernels are made of: tangent planes of the sphere, symmetric 3x3 matrices."""

import numpy as np

from factors.compiled import kernel_and_part

MIN_RELATIVE_DAMPING = 1e-12  # least damping, part of the trace of a landmark's Hessian

_, _part = kernel_and_part(fastmath={"contract"})


@_part
def tangent_axes(mx, my, mz):
    """Rows of factors.bearing.tangent_basis at a unit vector."""
    sign = 1.0 if mz >= 0 else -1.0
    a = -1.0 / (sign + mz)
    b = mx * my * a
    return 1.0 + sign * mx * mx * a, sign * b, -sign * mx, b, sign + my * my * a, -my


@_part
def rig_vector(pose, point):
    """Vector from the rig to a world point, in the rig frame: world_R_rig^T (X - t)."""
    x, y, z = point[0] - pose[9], point[1] - pose[10], point[2] - pose[11]
    return (
        pose[0] * x + pose[3] * y + pose[6] * z,
        pose[1] * x + pose[4] * y + pose[7] * z,
        pose[2] * x + pose[5] * y + pose[8] * z,
    )


@_part
def inverse_root(v, damping):
    """Lower triangle (6 values 00 10 20 11 21 22) whose square R^T R is the inverse of a symmetric
    3x3 (6 values 00 01 02 11 12 22), damped by its trace.

    At least `MIN_RELATIVE_DAMPING` of the trace is added, so that a direction which no observation
    constrains (one ray, no parallax) stays finite and moves no pose.
    """
    eps = (MIN_RELATIVE_DAMPING + damping) * (v[0] + v[3] + v[5]) + 1e-200
    a, b, c, d, e, f = v[0] + eps, v[1], v[2], v[3] + eps, v[4], v[5] + eps
    l00 = np.sqrt(a)
    l10, l20 = b / l00, c / l00
    l11 = np.sqrt(max(d - l10 * l10, eps))
    l21 = (e - l10 * l20) / l11
    l22 = np.sqrt(max(f - l20 * l20 - l21 * l21, eps))
    i00, i11, i22 = 1 / l00, 1 / l11, 1 / l22
    i10 = -l10 * i00 * i11
    i21 = -l21 * i11 * i22
    return i00, i10, -(l20 * i00 + l21 * i10) * i22, i11, i21, i22


@_part
def squared_root(root):
    """R^T R (6 values 00 01 02 11 12 22) of a lower triangle of `inverse_root`."""
    i00, i10, i20, i11, i21, i22 = root
    return (
        i00 * i00 + i10 * i10 + i20 * i20, i10 * i11 + i20 * i21, i20 * i22,
        i11 * i11 + i21 * i21, i21 * i22, i22 * i22,
    )  # fmt: skip


@_part
def invert_symmetric(v, damping):
    """Inverse (6 values 00 01 02 11 12 22) of a symmetric 3x3 in this form, see `inverse_root`."""
    return squared_root(inverse_root(v, damping))


@_part
def times_symmetric(v, x, y, z):
    """Product of a symmetric 3x3 (6 values) with a vector."""
    return (
        v[0] * x + v[1] * y + v[2] * z,
        v[1] * x + v[3] * y + v[4] * z,
        v[2] * x + v[4] * y + v[5] * z,
    )
