"""Compiled passes over panoramas: cubic B-spline sampling on the sphere, patches, alignment.

All of it is one file because numba renews a cached kernel when its file changes, not when a
function it calls from another file does. Images are spline coefficients (H, 2H) float32; pixels
(u, v) have the centre of the top-left one at (0.5, 0.5).
"""

import numpy as np
from numba import njit

_POLE = np.sqrt(3.0) - 2.0  # of the cubic B-spline's inverse filter
_TERMS = 16  # of its geometric series: the rest is below float32's resolution

# What became of a patch.
ALIGNED, FLAT, MASKED, FAR, UNSTEADY = 0, 1, 2, 3, 4

_kernel = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})


@_kernel
def filter_rows(image):
    """Inverse cubic B-spline filter along each row in place, rows being periodic."""
    num, length = image.shape
    pole = np.float32(_POLE)
    for r in range(num):
        row = image[r]
        start, power = np.float32(0.0), np.float32(1.0)
        for k in range(_TERMS):
            start += power * row[-k % length]
            power *= pole
        row[0] = np.float32(6.0) * start
        for k in range(1, length):
            row[k] = np.float32(6.0) * row[k] + pole * row[k - 1]
        end, power = np.float32(0.0), -pole
        for k in range(_TERMS):
            end += power * row[(length - 1 + k) % length]
            power *= pole
        row[length - 1] = end
        for k in range(length - 2, -1, -1):
            row[k] = pole * (row[k + 1] - row[k])


@_kernel
def filter_columns(image):
    """Inverse cubic B-spline filter along each column in place, columns being periodic."""
    length = len(image)
    pole = np.float32(_POLE)
    ends = np.zeros_like(image[0])
    power = np.float32(1.0)
    for k in range(_TERMS):
        ends += power * image[-k % length]
        power *= pole
    image[0] = np.float32(6.0) * ends
    for k in range(1, length):
        for c in range(image.shape[1]):
            image[k, c] = np.float32(6.0) * image[k, c] + pole * image[k - 1, c]
    ends[:] = 0.0
    power = -pole
    for k in range(_TERMS):
        ends += power * image[(length - 1 + k) % length]
        power *= pole
    image[length - 1] = ends
    for k in range(length - 2, -1, -1):
        for c in range(image.shape[1]):
            image[k, c] = pole * (image[k + 1, c] - image[k, c])


@_kernel
def erp_pixel(x, y, z, width, height):
    """Pixel (u, v) of a vector, u in [0, width]."""
    u = width * (np.arctan2(x, z) / (2 * np.pi) + 0.5)
    v = height * (0.5 + np.arctan2(y, np.sqrt(x * x + z * z)) / np.pi)
    return u, v


@_kernel
def _weights(t):
    """Cubic B-spline weights of the four samples around a place t in [0, 1) after the second."""
    s = np.float32(1.0) - t
    sixth = np.float32(1.0 / 6.0)
    w0, w3 = sixth * s * s * s, sixth * t * t * t
    w1 = np.float32(2.0 / 3.0) - t * t * (np.float32(1.0) - np.float32(0.5) * t)
    return w0, w1, np.float32(1.0) - w0 - w1 - w3, w3


@_kernel
def _slopes(t):
    """Derivatives of `_weights` by t."""
    s = np.float32(1.0) - t
    half = np.float32(0.5)
    d1 = t * (np.float32(1.5) * t - np.float32(2.0))
    return -half * s * s, d1, half * s * s - d1 - half * t * t, half * t * t


@_kernel
def _tap(coefficients, row, column):
    """Coefficient at any row and column: round the seam, and over the poles."""
    height, width = coefficients.shape
    if row < 0:
        row, column = -1 - row, column + width // 2
    elif row >= height:
        row, column = 2 * height - 1 - row, column + width // 2
    return coefficients[row, column % width]


@_kernel
def sample(coefficients, u, v):
    """Value at pixel (u, v); u may lie any number of turns off, v up to a patch off the image."""
    height, width = coefficients.shape
    u, v = u - 0.5, v - 0.5
    column, row = int(np.floor(u)), int(np.floor(v))
    a0, a1, a2, a3 = _weights(np.float32(u - column))
    b0, b1, b2, b3 = _weights(np.float32(v - row))
    if column >= 1 and column < width - 2 and row >= 1 and row < height - 2:
        value = np.float32(0.0)
        for k in range(4):
            c = coefficients[row - 1 + k]
            b = b0 if k == 0 else (b1 if k == 1 else (b2 if k == 2 else b3))
            value += b * (
                a0 * c[column - 1] + a1 * c[column] + a2 * c[column + 1] + a3 * c[column + 2]
            )
        return value
    value = np.float32(0.0)
    for k in range(4):
        b = b0 if k == 0 else (b1 if k == 1 else (b2 if k == 2 else b3))
        r = row - 1 + k
        value += b * (
            a0 * _tap(coefficients, r, column - 1)
            + a1 * _tap(coefficients, r, column)
            + a2 * _tap(coefficients, r, column + 1)
            + a3 * _tap(coefficients, r, column + 2)
        )
    return value


@_kernel
def sample_gradient(coefficients, u, v):
    """Value at pixel (u, v) and its derivatives by u and v."""
    u, v = u - 0.5, v - 0.5
    column, row = int(np.floor(u)), int(np.floor(v))
    t, s = np.float32(u - column), np.float32(v - row)
    a0, a1, a2, a3 = _weights(t)
    d0, d1, d2, d3 = _slopes(t)
    b0, b1, b2, b3 = _weights(s)
    e0, e1, e2, e3 = _slopes(s)
    value = by_u = by_v = np.float32(0.0)
    for k in range(4):
        b = b0 if k == 0 else (b1 if k == 1 else (b2 if k == 2 else b3))
        e = e0 if k == 0 else (e1 if k == 1 else (e2 if k == 2 else e3))
        r = row - 1 + k
        c0, c1 = _tap(coefficients, r, column - 1), _tap(coefficients, r, column)
        c2, c3 = _tap(coefficients, r, column + 1), _tap(coefficients, r, column + 2)
        across = a0 * c0 + a1 * c1 + a2 * c2 + a3 * c3
        value += b * across
        by_v += e * across
        by_u += b * (d0 * c0 + d1 * c1 + d2 * c2 + d3 * c3)
    return value, by_u, by_v


@_kernel
def sample_vectors(coefficients, vectors, values, gradients):
    """Values (N,) and gradients (N, 3) by the vector, of vectors (N, 3) of any length."""
    height, width = coefficients.shape
    for n in range(len(vectors)):
        x, y, z = vectors[n, 0], vectors[n, 1], vectors[n, 2]
        u, v = erp_pixel(x, y, z, width, height)
        value, by_u, by_v = sample_gradient(coefficients, u, v)
        flat2 = max(x * x + z * z, 1e-18 * y * y)  # the pole's own longitude is any
        flat, squared = np.sqrt(flat2), flat2 + y * y
        lon, lat = by_u * width / (2 * np.pi) / flat2, by_v * height / np.pi / squared
        values[n] = value
        gradients[n, 0] = lon * z - lat * y * x / flat
        gradients[n, 1] = lat * flat
        gradients[n, 2] = -lon * x - lat * y * z / flat


@_kernel
def _pixel_map(origin, spread, half, width, height, nodes, quadratics):
    """Pixels of the rays origin + spread @ (x, y), |x|, |y| <= half, as biquadratics.

    Args:
        origin (3,), spread (3, 2): a plane patch seen from the rig; rig frame, any length.
        nodes (3, 3, 2): scratch, pixels of the patch's corners, edges and centre, x by rows.
        quadratics (2, 3, 3): of u and v; coefficient [i, j] is of (x / half)^i (y / half)^j.

    Returns:
        False where a pole is too near for the polynomial: then each ray needs its own pixel.
    """
    for i in range(3):
        for j in range(3):
            x, y = (i - 1) * half, (j - 1) * half
            u, v = erp_pixel(
                origin[0] + spread[0, 0] * x + spread[0, 1] * y,
                origin[1] + spread[1, 0] * x + spread[1, 1] * y,
                origin[2] + spread[2, 0] * x + spread[2, 1] * y,
                width, height,
            )  # fmt: skip
            nodes[i, j, 0], nodes[i, j, 1] = u, v
    for i in range(3):
        for j in range(3):
            offset = nodes[i, j, 0] - nodes[1, 1, 0]
            if offset > 0.5 * width:
                nodes[i, j, 0] -= width
            elif offset < -0.5 * width:
                nodes[i, j, 0] += width
    for k in range(2):
        q = quadratics[k]
        for j in range(3):
            before, at, after = nodes[0, j, k], nodes[1, j, k], nodes[2, j, k]
            q[0, j], q[1, j], q[2, j] = at, 0.5 * (after - before), 0.5 * (after + before) - at
        for i in range(3):
            before, at, after = q[i, 0], q[i, 1], q[i, 2]
            q[i, 0], q[i, 1], q[i, 2] = at, 0.5 * (after - before), 0.5 * (after + before) - at
    flat2 = origin[0] ** 2 + origin[2] ** 2
    size2 = 0.0
    for i in range(3):
        size2 = max(size2, spread[i, 0] ** 2 + spread[i, 1] ** 2)
    return flat2 > 64.0 * 2.0 * size2 * half * half


@_kernel
def _sample_grid(coefficients, origin, spread, reach, shift_x, shift_y, nodes, quadratics, out):
    """Values (n * n,) of an n x n grid of unit spacing on the plane patch, off by a shift.

    `out[i * n + j]` is at x = i - reach + shift_x, y = j - reach + shift_y with n = 2 reach + 1.    """
    height, width = coefficients.shape
    n = 2 * reach + 1
    half = reach + 1.0
    if not _pixel_map(origin, spread, half, width, height, nodes, quadratics):
        for i in range(n):
            for j in range(n):
                x, y = i - reach + shift_x, j - reach + shift_y
                u, v = erp_pixel(
                    origin[0] + spread[0, 0] * x + spread[0, 1] * y,
                    origin[1] + spread[1, 0] * x + spread[1, 1] * y,
                    origin[2] + spread[2, 0] * x + spread[2, 1] * y,
                    width, height,
                )  # fmt: skip
                out[i * n + j] = sample(coefficients, u, v)
        return
    p, q = quadratics[0], quadratics[1]
    for i in range(n):
        x = (i - reach + shift_x) / half
        u0, v0 = p[0, 0] + x * (p[1, 0] + x * p[2, 0]), q[0, 0] + x * (q[1, 0] + x * q[2, 0])
        u1, v1 = p[0, 1] + x * (p[1, 1] + x * p[2, 1]), q[0, 1] + x * (q[1, 1] + x * q[2, 1])
        u2, v2 = p[0, 2] + x * (p[1, 2] + x * p[2, 2]), q[0, 2] + x * (q[1, 2] + x * q[2, 2])
        for j in range(n):
            y = (j - reach + shift_y) / half
            out[i * n + j] = sample(
                coefficients, u0 + y * (u1 + y * u2), v0 + y * (v1 + y * v2)
            )


@_kernel
def _is_usable(mask, nodes):
    """Whether all nodes of the last patch lie where the mask (H, W) allows; an empty one does."""
    height, width = mask.shape
    if height == 0:
        return True
    for i in range(3):
        for j in range(3):
            row = min(max(int(np.floor(nodes[i, j, 1])), 0), height - 1)
            if not mask[row, int(np.floor(nodes[i, j, 0])) % width]:
                return False
    return True


@_kernel
def make_templates(
    coefficients, mask, rows, origins, spreads, window, prior, least_contrast, grey, by_x, by_y,
    inverses, states,
):  # fmt: skip
    """Cut the templates of one frame and prepare their alignment.

    Args:
        rows (R,): templates of this frame.
        origins (J, 3), spreads (J, 3, 2): their plane patches in this frame.
        window (n * n,): weight of each pixel, at most 1.
        prior: weight of a deviation of the affine part, against a grey value squared.
        least_contrast: standard deviation in grey values below which there is no texture.
        grey, by_x, by_y (J, n * n) float32: written; mean removed.
        inverses (J, 8, 8) float32: written; of the normal matrix of [shift, affine, gain, offset].
        states (J,) uint8: written.
    """
    num = len(window)
    reach = (int(np.round(np.sqrt(num))) - 1) // 2
    nodes, quadratics = np.empty((3, 3, 2)), np.empty((2, 3, 3))
    ahead, behind = np.empty(num, np.float32), np.empty(num, np.float32)
    column = np.empty(8)
    for t in rows:
        origin, spread = origins[t], spreads[t]
        for axis in range(2):
            sx, sy = (0.5, 0.0) if axis == 0 else (0.0, 0.5)
            _sample_grid(coefficients, origin, spread, reach, sx, sy, nodes, quadratics, ahead)
            _sample_grid(coefficients, origin, spread, reach, -sx, -sy, nodes, quadratics, behind)
            slopes = by_x[t] if axis == 0 else by_y[t]
            for k in range(num):
                slopes[k] = ahead[k] - behind[k]
        values = grey[t]
        _sample_grid(coefficients, origin, spread, reach, 0.0, 0.0, nodes, quadratics, values)
        if not _is_usable(mask, nodes):
            states[t] = MASKED
            continue
        mass = mean = square = 0.0
        for k in range(num):
            mass += window[k]
            mean += window[k] * values[k]
        mean /= mass
        for k in range(num):
            values[k] -= mean
            square += window[k] * values[k] * values[k]
        if not square > mass * least_contrast * least_contrast:
            states[t] = FLAT
            continue
        normal = np.zeros((8, 8))
        for k in range(num):
            _columns(k, reach, by_x[t, k], by_y[t, k], values[k], column)
            for r in range(8):
                for c in range(r + 1):
                    normal[r, c] += window[k] * column[r] * column[c]
        for r in range(8):
            if 2 <= r < 6:
                normal[r, r] += prior
            normal[r, r] *= 1 + 1e-6
            for c in range(r):
                normal[c, r] = normal[r, c]
        if not normal[0, 0] * normal[1, 1] - normal[0, 1] ** 2 > 1e-4 * (
            normal[0, 0] + normal[1, 1]
        ) ** 2:
            states[t] = FLAT  # an edge: it can slide
            continue
        inverses[t] = np.linalg.inv(normal)
        states[t] = ALIGNED


@_kernel
def _columns(k, reach, dx, dy, value, out):
    """Derivatives of pixel k by shift (2), affine (4, by columns), gain and offset."""
    n = 2 * reach + 1
    x, y = k // n - reach, k % n - reach
    out[0], out[1] = dx, dy
    out[2], out[3], out[4], out[5] = dx * x, dy * x, dx * y, dy * y
    out[6], out[7] = value, 1.0


@_kernel
def align_patches(
    coefficients, mask, rows, templates, origins, spreads, window, prior, max_shift, max_steps,
    tolerance, grey, by_x, by_y, inverses, warps, scores, variances, states,
):  # fmt: skip
    """Align templates to one frame by inverse-compositional Gauss-Newton.

    The template's point q = (x, y) is looked for at origin + spread @ (shift + (1 + affine) q),
    with a gain and an offset. Baker & Matthews, "Lucas-Kanade 20 Years On", IJCV 56(3), 2004.

    Args:
        rows (R,): observations of this frame.
        templates (O,): template of each.
        origins (O, 3), spreads (O, 3, 2): where the template's plane patch should be seen.
        max_shift: in template pixels.
        tolerance: on the shift's last step, template pixels.
        grey, by_x, by_y, inverses: as left by `make_templates`.
        warps (O, 6): start, and written: shift (2), affine by columns (4).
        scores (O,), variances (O,): written; ZNCC, and residual variance after gain and offset.
        states (O,) uint8: written.
    """
    num = len(window)
    reach = (int(np.round(np.sqrt(num))) - 1) // 2
    n = 2 * reach + 1
    nodes, quadratics = np.empty((3, 3, 2)), np.empty((2, 3, 3))
    values = np.empty(num, np.float32)
    origin, spread = np.empty(3), np.empty((3, 2))
    b, step = np.empty(8), np.empty(8)
    mass = 0.0
    for k in range(num):
        mass += window[k]
    for o in rows:
        t = templates[o]
        template, slope_x, slope_y, inverse = grey[t], by_x[t], by_y[t], inverses[t]
        power = 0.0
        for k in range(num):
            power += window[k] * template[k] * template[k]
        warp = warps[o]
        gain = offset = 0.0
        converged = False
        states[o] = UNSTEADY
        for number in range(max_steps + 1):
            for i in range(3):
                p, q = spreads[o, i, 0], spreads[o, i, 1]
                origin[i] = origins[o, i] + p * warp[0] + q * warp[1]
                spread[i, 0] = p * (1.0 + warp[2]) + q * warp[3]
                spread[i, 1] = p * warp[4] + q * (1.0 + warp[5])
            _sample_grid(coefficients, origin, spread, reach, 0.0, 0.0, nodes, quadratics, values)
            if number == 0 or converged:
                mean = square = cross = 0.0
                for k in range(num):
                    mean += window[k] * values[k]
                mean /= mass
                for k in range(num):
                    centred = values[k] - mean
                    square += window[k] * centred * centred
                    cross += window[k] * centred * template[k]
                if not square > 1e-3 * mass:
                    states[o] = FLAT
                    break
                if converged:
                    scores[o] = cross / np.sqrt(square * power)
                    # residual of regressing the frame on the template, in the template's units
                    ratio = cross / power
                    rest = max(square - cross * ratio, 1e-3 * mass)
                    variances[o] = rest / (ratio * ratio) / (mass * (1.0 - 8.0 / num))
                    states[o] = ALIGNED if _is_usable(mask, nodes) else MASKED
                    break
                gain, offset = np.sqrt(square / power), mean
            b[:] = 0.0
            for i in range(n):
                x = i - reach
                for j in range(n):
                    k = i * n + j
                    y = j - reach
                    e = window[k] * ((values[k] - offset) / gain - template[k])
                    ex, ey = e * slope_x[k], e * slope_y[k]
                    b[0] += ex
                    b[1] += ey
                    b[2] += ex * x
                    b[3] += ey * x
                    b[4] += ex * y
                    b[5] += ey * y
                    b[6] += e * template[k]
                    b[7] += e
            for r in range(2, 6):
                b[r] += prior * warp[r]
            for r in range(8):
                total = 0.0
                for c in range(8):
                    total += inverse[r, c] * b[c]
                step[r] = total
            offset += gain * step[7]
            gain *= max(1.0 + step[6], 0.2)
            if not _compose(warp, step):
                break
            if not warp[0] * warp[0] + warp[1] * warp[1] < max_shift * max_shift:
                states[o] = FAR
                break
            converged = step[0] * step[0] + step[1] * step[1] < tolerance * tolerance


@_kernel
def _compose(warp, step):
    """warp := warp after the inverse of the step's warp; False where that has none."""
    a, c, b, d = 1.0 + step[2], step[3], step[4], 1.0 + step[5]
    determinant = a * d - b * c
    if not determinant > 0.1:
        return False
    ia, ib, ic, id_ = d / determinant, -b / determinant, -c / determinant, a / determinant
    p, r, q, s = 1.0 + warp[2], warp[3], warp[4], 1.0 + warp[5]
    na, nb, nc, nd = p * ia + q * ic, p * ib + q * id_, r * ia + s * ic, r * ib + s * id_
    warp[0] -= na * step[0] + nb * step[1]
    warp[1] -= nc * step[0] + nd * step[1]
    warp[2], warp[3], warp[4], warp[5] = na - 1.0, nc, nb, nd - 1.0
    return True
