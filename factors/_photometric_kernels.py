"""Compiled pass over the observations of patches: sample, normalise, differentiate.

Poses are rows `(12,)` = `[world_R_rig row-major (9), rig_in_world (3)]`, or those of the lenses
that hosts and targets see patches through. A patch is a plane seen
from its host: with its bearing m and tangent axes e1, e2 as rows of `axes`, the points along
`m + x e1 + y e2` have the inverse depth `theta . (1, x, y)` (in units of that vector), so that a
target sees them along

    d = A (m + x e1 + y e2) + theta . (1, x, y) c,    A = target_R_host, c = host_in_target.

There is no division and nothing special at infinity. The tangent of an observation is the change
of theta, then of the pose of the host relative to the target: a rotation phi and a translation
tau in the target's rig frame, `dd = phi x A(...) + theta . (1, x, y) tau + c (1, x, y) . dtheta`.

The pass handles a range of patches and releases the GIL.
"""

from typing import NamedTuple

import numpy as np

from factors.compiled import kernel_and_part
from factors.robust import rho_and_weight

_kernel, _part = kernel_and_part(fastmath={"contract"})
_, _allocating = kernel_and_part(allocating=True, fastmath={"contract"})
_, _sums = kernel_and_part(fastmath={"contract", "reassoc"})

CODE_SCALE = 28.0  # steps per grey value: spline coefficients of 8-bit images fit int16
CODE_ZERO = 127.5  # grey value of code 0
DIMS = 9  # of an observation's tangent: plane (3), relative rotation (3), translation (3)


class PatchData(NamedTuple):
    """All patches of a block and their observations, sorted by patch."""

    hosts: np.ndarray  # (P,) int32, row of the poses
    axes: np.ndarray  # (P, 3, 3) float64, rows bearing, e1, e2 in the host's frame
    templates: np.ndarray  # (P, N) float32, normalised like observations
    scales: np.ndarray  # (P,) float64, residual of a unit difference of normalised patches, sigmas
    offsets: np.ndarray  # (P + 1,) int64: patch p owns observations offsets[p]:offsets[p + 1]
    targets: np.ndarray  # (O,) int32, row of the poses, never the host, once per patch
    weights: np.ndarray  # (O,) float64, weight of the observation's cost; 0 = left out
    pixels: np.ndarray  # int16, spline coefficients of all windows
    starts: np.ndarray  # (O,) int64, first pixel of the observation's window
    windows: np.ndarray  # (O, 4) int32: first column and row on the sphere image, width, height
    grid: np.ndarray  # (N, 2) float64, x and y of the patch's pixels, tangents of angles
    width: int  # of the sphere image, pixels; its height is half of it
    floor: float  # grey values added to the contrast, in quadrature
    loss: int  # code of the robust loss
    loss_scale: float  # root mean square of a patch's whitened residuals at which the loss turns
    # flat


@_part
def _spline(f):
    """Weights of four cubic B-spline coefficients at fraction f, and their derivatives."""
    g = 1.0 - f
    return (
        g * g * g / 6.0, 2 / 3 - 0.5 * f * f * (2.0 - f), 2 / 3 - 0.5 * g * g * (2.0 - g),
        f * f * f / 6.0,
        -0.5 * g * g, f * (1.5 * f - 2.0), g * (2.0 - 1.5 * g), 0.5 * f * f,
    )  # fmt: skip


@_part
def sample(pixels, start, column, row, columns, rows, width, x, y, z):
    """Grey value in a window of a sphere image along (x, y, z), and its gradient by that vector.

    The window holds `rows x columns` coefficients from `start` on, its first one belonging to the
    pixel (column, row) of the equirectangular image, which is `width` wide.

    Returns:
        inside (False outside the window), value, gradient (3).
    """
    across = x * x + z * z
    n2 = across + y * y
    across = max(across, 1e-24 * n2)
    if not n2 > 1e-200:
        return False, 0.0, 0.0, 0.0, 0.0
    r = np.sqrt(across)
    per_radian = width / (2.0 * np.pi)
    u = per_radian * np.arctan2(x, z) + 0.5 * width
    middle = column + 0.5 * columns
    u -= width * np.floor((u - middle) / width + 0.5)
    s = u - 0.5 - column
    t = per_radian * np.arctan2(y, r) + 0.25 * width - 0.5 - row
    i, j = int(np.floor(s)), int(np.floor(t))
    if i < 1 or j < 1 or i + 2 >= columns or j + 2 >= rows:
        return False, 0.0, 0.0, 0.0, 0.0
    a0, a1, a2, a3, da0, da1, da2, da3 = _spline(s - i)
    b0, b1, b2, b3, db0, db1, db2, db3 = _spline(t - j)
    value, by_u, by_v = 0.0, 0.0, 0.0
    p = start + (j - 1) * columns + i - 1
    for k in range(4):
        b = b0 if k == 0 else b1 if k == 1 else b2 if k == 2 else b3
        db = db0 if k == 0 else db1 if k == 1 else db2 if k == 2 else db3
        c0, c1 = float(pixels[p]), float(pixels[p + 1])
        c2, c3 = float(pixels[p + 2]), float(pixels[p + 3])
        along = a0 * c0 + a1 * c1 + a2 * c2 + a3 * c3
        value += b * along
        by_v += db * along
        by_u += b * (da0 * c0 + da1 * c1 + da2 * c2 + da3 * c3)
        p += columns
    by_u *= per_radian / (CODE_SCALE * across)
    by_v *= per_radian / (CODE_SCALE * n2)
    return (
        True, value / CODE_SCALE + CODE_ZERO,
        by_u * z - by_v * y * x / r, by_v * r, -by_u * x - by_v * y * z / r,
    )  # fmt: skip


@_part
def _relative(host, target, A, c):
    """A = target_R_host and c = host_in_target."""
    for i in range(3):
        for k in range(3):
            A[i, k] = (
                target[i] * host[k] + target[3 + i] * host[3 + k] + target[6 + i] * host[6 + k]
            )
        c[i] = (
            target[i] * (host[9] - target[9])
            + target[3 + i] * (host[10] - target[10])
            + target[6 + i] * (host[11] - target[11])
        )


@_allocating
def _look(data, p, o, plane, A, c, dims, Z):
    """Write rows of Z (10, N): derivatives by the tangent (the first `dims`), grey values (row 9).

    Returns False if a pixel lies outside the window.
    """
    axes, window = data.axes[p], data.windows[o]
    D = np.empty((3, 3))
    for k in range(3):  # images of bearing, e1, e2 under the rotation
        for i in range(3):
            D[k, i] = A[i, 0] * axes[k, 0] + A[i, 1] * axes[k, 1] + A[i, 2] * axes[k, 2]
    for n in range(len(data.grid)):
        x, y = data.grid[n, 0], data.grid[n, 1]
        ax = D[0, 0] + x * D[1, 0] + y * D[2, 0]
        ay = D[0, 1] + x * D[1, 1] + y * D[2, 1]
        az = D[0, 2] + x * D[1, 2] + y * D[2, 2]
        near = plane[0] + x * plane[1] + y * plane[2]
        inside, value, gx, gy, gz = sample(
            data.pixels, data.starts[o], window[0], window[1], window[2], window[3], data.width,
            ax + near * c[0], ay + near * c[1], az + near * c[2],
        )  # fmt: skip
        if not inside:
            return False
        Z[9, n] = value
        if dims:
            slope = gx * c[0] + gy * c[1] + gz * c[2]
            Z[0, n], Z[1, n], Z[2, n] = slope, slope * x, slope * y
        if dims > 3:
            Z[3, n], Z[4, n], Z[5, n] = ay * gz - az * gy, az * gx - ax * gz, ax * gy - ay * gx
            Z[6, n], Z[7, n], Z[8, n] = near * gx, near * gy, near * gz
    return True


@_sums
def _normalise(Z, row, floor):
    """Row of Z less its mean over its contrast; returns the contrast's norm."""
    num = Z.shape[1]
    mean = 0.0
    for n in range(num):
        mean += Z[row, n]
    mean /= num
    squared = num * floor * floor
    for n in range(num):
        Z[row, n] -= mean
        squared += Z[row, n] * Z[row, n]
    norm = np.sqrt(squared)
    for n in range(num):
        Z[row, n] /= norm
    return norm


@_sums
def _squared_error(Z, template, scale):
    """Squared norm of the whitened residual scale (Z[9] - template)."""
    total = 0.0
    for n in range(Z.shape[1]):
        difference = Z[9, n] - template[n]
        total += difference * difference
    return scale * scale * total


@_sums
def _gauss_newton(Z, template, scale, norm, dims, weight, G, g):
    """Weighted Hessian G and gradient g of half the squared error; Z[9] is normalised already.

    The normalised patch I = (z - mean) / norm moves by dI = (dz - mean(dz) - I (I . dz)) / norm.
    """
    num = Z.shape[1]
    factor = scale / norm
    for a in range(dims):
        mean, along = 0.0, 0.0
        for n in range(num):
            mean += Z[a, n]
            along += Z[a, n] * Z[9, n]  # Z[9] has no mean
        mean /= num
        down = 0.0
        for n in range(num):
            Z[a, n] = factor * (Z[a, n] - mean - along * Z[9, n])
            down += Z[a, n] * (Z[9, n] - template[n])
        g[a] = weight * scale * down
    for a in range(dims):
        for b in range(a, dims):
            total = 0.0
            for n in range(num):
                total += Z[a, n] * Z[b, n]
            G[a, b] = G[b, a] = weight * total


@_kernel
def observe_range(
    first, last, data, planes, host_poses, target_poses, dims, hessians, gradients, errors
):  # fmt: skip
    """Model every observation of the patches first..last.

    Args:
        planes (P, 3), host_poses (P, 12), target_poses (O, 12): inverse-depth planes and poses.
        dims: 9 for the whole tangent, 3 for the plane alone, 0 for the errors alone.
        hessians (O, 9, 9), gradients (O, 9): written in their first `dims`, robust weights and
            those of the observations included; zero for observations left out or lost.
        errors (O,): mean square of whitened residuals; 2 scale^2 / N, that of an image uncorrelated
            with the template, outside a window or if an observation is left out.
    """
    num = len(data.grid)
    A, c, Z = np.empty((3, 3)), np.empty(3), np.empty((10, num))
    for p in range(first, last):
        scale, template = data.scales[p], data.templates[p]
        for o in range(data.offsets[p], data.offsets[p + 1]):
            errors[o] = 2.0 * scale * scale / num
            if dims:
                hessians[o, :dims, :dims] = 0.0
                gradients[o, :dims] = 0.0
            if data.weights[o] <= 0:
                continue
            _relative(host_poses[p], target_poses[o], A, c)
            if not _look(data, p, o, planes[p], A, c, dims, Z):
                continue
            norm = _normalise(Z, 9, data.floor)
            errors[o] = _squared_error(Z, template, scale) / num
            if dims:
                weight = rho_and_weight(data.loss, data.loss_scale, errors[o])[1]
                _gauss_newton(
                    Z, template, scale, norm, dims, data.weights[o] * weight, hessians[o],
                    gradients[o],
                )  # fmt: skip
