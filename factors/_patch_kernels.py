"""Compiled passes over patches of panoramas: cut templates, and align them to other frames.

A patch is a plane piece of scene: the rays origin + spread @ (x, y) of an n x n grid of unit
spacing, row-major in (x, y), x and y from -reach to reach. Images are spline coefficients
(H, 2H) float32.
"""

import numpy as np

from factors._patch_records import ALIGNED, FAR, FLAT, MASKED, UNLIKE, UNSTEADY
from factors.compiled import kernel_and_part

_TRIAL_STEPS = 4  # steps after which a patch must correlate somewhat to go on
_POLE_HALF_PATCHES = 8.0  # distance from a pole, in half patches, within which each ray needs its
# own pixel
_MIN_CORNER_DETERMINANT = 1e-4  # least determinant of the shift's information over its squared
# trace: excludes edges
_MIN_GREY_VARIANCE = 1e-3  # variance in grey values squared below which a patch is empty

_FAST = {"contract", "reassoc", "nsz"}
_kernel, _part = kernel_and_part(fastmath=_FAST)
_, _allocating = kernel_and_part(allocating=True, fastmath=_FAST)


@_part
def _ray_pixel(origin, spread, x, y, width, height):
    """Pixel (u, v) of the ray through (x, y) of a plane patch, u in [0, width]."""
    a = origin[0] + spread[0, 0] * x + spread[0, 1] * y
    b = origin[1] + spread[1, 0] * x + spread[1, 1] * y
    c = origin[2] + spread[2, 0] * x + spread[2, 1] * y
    u = width * (np.arctan2(a, c) / (2 * np.pi) + 0.5)
    return u, height * (0.5 + np.arctan2(b, np.sqrt(a * a + c * c)) / np.pi)


@_part
def _weights(t):
    """Cubic B-spline weights of the four samples around a position t in [0, 1) after the second."""
    s = np.float32(1.0) - t
    sixth = np.float32(1.0 / 6.0)
    w0, w3 = sixth * s * s * s, sixth * t * t * t
    w1 = np.float32(2.0 / 3.0) - t * t * (np.float32(1.0) - np.float32(0.5) * t)
    return w0, w1, np.float32(1.0) - w0 - w1 - w3, w3


@_part
def _tap(coefficients, row, column):
    """Coefficient at any row and column, continued across the seam and the poles."""
    height, width = coefficients.shape
    if row < 0:
        row, column = -1 - row, column + width // 2
    elif row >= height:
        row, column = 2 * height - 1 - row, column + width // 2
    return coefficients[row, column % width]


@_part
def _sample(coefficients, u, v):
    """Value at pixel (u, v); u may be off by any number of turns, v by a patch off the image."""
    height, width = coefficients.shape
    u, v = u - 0.5, v - 0.5
    column, row = int(np.floor(u)), int(np.floor(v))
    a0, a1, a2, a3 = _weights(np.float32(u - column))
    b0, b1, b2, b3 = _weights(np.float32(v - row))
    inside = column >= 1 and column < width - 2 and row >= 1 and row < height - 2
    value = np.float32(0.0)
    for k in range(4):
        b = b0 if k == 0 else (b1 if k == 1 else (b2 if k == 2 else b3))
        r = row - 1 + k
        if inside:
            c = coefficients[r]
            c0, c1, c2, c3 = c[column - 1], c[column], c[column + 1], c[column + 2]
        else:
            c0, c1 = _tap(coefficients, r, column - 1), _tap(coefficients, r, column)
            c2, c3 = _tap(coefficients, r, column + 1), _tap(coefficients, r, column + 2)
        value += b * (a0 * c0 + a1 * c1 + a2 * c2 + a3 * c3)
    return value


@_part
def _pixel_map(origin, spread, half, width, height, nodes, quadratics):
    """Pixels of the rays origin + spread @ (x, y), |x|, |y| <= half, as biquadratics.

    Args:
        origin (3,), spread (3, 2): a plane patch seen from the rig; rig frame, any length.
        nodes (3, 3, 2): scratch, pixels of the patch's corners, edges and centre, x by rows.
        quadratics (2, 3, 3): of u and v; coefficient [i, j] is of (x / half)^i (y / half)^j.

    Returns:
        False if a pole is too near for the polynomial: then each ray needs its own pixel.
    """
    for i in range(3):
        for j in range(3):
            x, y = (i - 1) * half, (j - 1) * half
            u, v = _ray_pixel(origin, spread, x, y, width, height)
            nodes[i, j, 0], nodes[i, j, 1] = u, v
    centre = nodes[1, 1, 0]
    for i in range(3):
        for j in range(3):
            nodes[i, j, 0] -= width * np.floor((nodes[i, j, 0] - centre) / width + 0.5)
    for k in range(2):
        q = quadratics[k]
        for j in range(3):
            before, at, after = nodes[0, j, k], nodes[1, j, k], nodes[2, j, k]
            q[0, j], q[1, j], q[2, j] = at, 0.5 * (after - before), 0.5 * (after + before) - at
        for i in range(3):
            before, at, after = q[i, 0], q[i, 1], q[i, 2]
            q[i, 0], q[i, 1], q[i, 2] = at, 0.5 * (after - before), 0.5 * (after + before) - at
    size2 = 0.0  # two squared steps, at least the square of the longest
    for i in range(3):
        size2 += spread[i, 0] ** 2 + spread[i, 1] ** 2
    return origin[0] ** 2 + origin[2] ** 2 > size2 * (_POLE_HALF_PATCHES * half) ** 2


@_allocating
def _scratch(reach):
    """Scratch for `_sample_grid`: nodes and quadratics, see `_pixel_map`; positions (2, n * n) in
    half patches, columns and rows (2, n * n) before them, weights (8, n * n) of the samples
    around."""
    n = 2 * reach + 1
    places = np.empty((2, n * n))
    for i in range(n):
        for j in range(n):
            places[0, i * n + j] = (i - reach) / (reach + 1.0)
            places[1, i * n + j] = (j - reach) / (reach + 1.0)
    before, weights = np.empty((2, n * n), np.int32), np.empty((8, n * n), np.float32)
    return np.empty((3, 3, 2)), np.empty((2, 3, 3)), places, before, weights


@_part
def _sample_grid(coefficients, origin, spread, reach, shift_x, shift_y, scratch, out):
    """Values (n * n,) of a shifted n x n grid of unit spacing on the plane patch.

    `out[i * n + j]` is at x = i - reach + shift_x, y = j - reach + shift_y, n = 2 reach + 1.
    """
    nodes, quadratics, places, before, weights = scratch
    height, width = coefficients.shape
    n, half = 2 * reach + 1, reach + 1.0
    smooth = _pixel_map(origin, spread, half, width, height, nodes, quadratics)
    if smooth and _find_taps(
        quadratics, places, shift_x / half, shift_y / half, width, height, before, weights
    ):
        _sum_inside(coefficients, before, weights, out)
        return
    p, q = quadratics[0], quadratics[1]
    for i in range(n):
        for j in range(n):
            x, y = i - reach + shift_x, j - reach + shift_y
            if smooth:
                x, y = x / half, y / half
                u = _quadratic(p, x, 0) + y * (_quadratic(p, x, 1) + y * _quadratic(p, x, 2))
                v = _quadratic(q, x, 0) + y * (_quadratic(q, x, 1) + y * _quadratic(q, x, 2))
            else:
                u, v = _ray_pixel(origin, spread, x, y, width, height)
            out[i * n + j] = _sample(coefficients, u, v)


@_part
def _quadratic(coefficients, x, j):
    """Value at x of column j of a biquadratic."""
    return coefficients[0, j] + x * (coefficients[1, j] + x * coefficients[2, j])


@_part
def _find_taps(quadratics, places, shift_x, shift_y, width, height, before, weights):
    """Write columns and rows before places, and weights; False if samples lie beyond an edge.

    Free of branches and of arrays that may alias its output, so that it is vectorised.
    """
    p, q = quadratics[0], quadratics[1]
    p00, p01, p02 = p[0, 0] - 0.5, p[0, 1], p[0, 2]
    p10, p11, p12 = p[1, 0], p[1, 1], p[1, 2]
    p20, p21, p22 = p[2, 0], p[2, 1], p[2, 2]
    q00, q01, q02 = q[0, 0] - 0.5, q[0, 1], q[0, 2]
    q10, q11, q12 = q[1, 0], q[1, 1], q[1, 2]
    q20, q21, q22 = q[2, 0], q[2, 1], q[2, 2]
    left, right = np.int32(width), np.int32(-1)
    top, bottom = np.int32(height), np.int32(-1)
    for k in range(places.shape[1]):
        x, y = places[0, k] + shift_x, places[1, k] + shift_y
        u0, v0 = p00 + x * (p10 + x * p20), q00 + x * (q10 + x * q20)
        u1, v1 = p01 + x * (p11 + x * p21), q01 + x * (q11 + x * q21)
        u2, v2 = p02 + x * (p12 + x * p22), q02 + x * (q12 + x * q22)
        u, v = u0 + y * (u1 + y * u2), v0 + y * (v1 + y * v2)
        column, row = np.floor(u), np.floor(v)
        a0, a1, a2, a3 = _weights(np.float32(u - column))
        b0, b1, b2, b3 = _weights(np.float32(v - row))
        weights[0, k], weights[1, k], weights[2, k], weights[3, k] = a0, a1, a2, a3
        weights[4, k], weights[5, k], weights[6, k], weights[7, k] = b0, b1, b2, b3
        before[0, k], before[1, k] = np.int32(column), np.int32(row)
        left, right = min(left, before[0, k]), max(right, before[0, k])
        top, bottom = min(top, before[1, k]), max(bottom, before[1, k])
    return left >= 1 and right < width - 2 and top >= 1 and bottom < height - 2


@_part
def _sum_inside(coefficients, before, weights, out):
    """Values at places whose samples all lie inside the image."""
    for k in range(len(out)):
        value = np.float32(0.0)
        first = np.uint32(before[0, k] - 1)  # unsigned: no test for negative indices
        for i in range(4):
            c = coefficients[np.uint32(before[1, k] - 1 + i)]
            value += weights[4 + i, k] * (
                weights[0, k] * c[first]
                + weights[1, k] * c[first + np.uint32(1)]
                + weights[2, k] * c[first + np.uint32(2)]
                + weights[3, k] * c[first + np.uint32(3)]
            )
        out[k] = value


@_part
def _is_usable(mask, nodes):
    """True if the mask (H, W) is set at all nodes of the last patch; an empty mask counts as
    set."""
    height, width = mask.shape
    usable = True
    for i in range(3 if height else 0):
        for j in range(3):
            row = min(max(int(np.floor(nodes[i, j, 1])), 0), height - 1)
            usable &= mask[row, int(np.floor(nodes[i, j, 0])) % width]
    return usable


@_part
def _statistics(window, values):
    """Weighted mass, mean and sum of squares about the mean."""
    mass = mean = square = 0.0
    for k in range(len(window)):
        mass += window[k]
        mean += window[k] * values[k]
    mean /= mass
    for k in range(len(window)):
        square += window[k] * (values[k] - mean) ** 2
    return mass, mean, square


@_part
def _normal_matrix(templates, t, reach, columns, normal):
    """Write the normal matrix (8, 8) of a template; False if it does not determine a shift.

    columns (8, n * n) is scratch, so that each sum is a loop of its own, which is vectorised.
    """
    n = 2 * reach + 1
    window, grey = templates.window, templates.grey[t]
    by_x, by_y = templates.by_x[t], templates.by_y[t]
    for k in range(n * n):
        x, y = k // n - reach, k % n - reach
        columns[0, k], columns[1, k] = by_x[k], by_y[k]
        columns[2, k], columns[3, k] = by_x[k] * x, by_y[k] * x
        columns[4, k], columns[5, k] = by_x[k] * y, by_y[k] * y
        columns[6, k], columns[7, k] = grey[k], 1.0
    for i in range(8):
        for j in range(i, 8):
            one, other, total = columns[i], columns[j], 0.0
            for k in range(n * n):
                total += window[k] * one[k] * other[k]
            normal[i, j] = normal[j, i] = total
    trace = normal[0, 0] + normal[1, 1]
    determinant = normal[0, 0] * normal[1, 1] - normal[0, 1] ** 2
    for r in range(8):
        normal[r, r] += 1e-6 * normal[r, r] + (templates.prior if 2 <= r < 6 else 0.0)
    return determinant > _MIN_CORNER_DETERMINANT * trace * trace


@_part
def _cut(coefficients, mask, t, origin, spread, least_contrast, templates, reach, scratch):
    """`cut_templates` of one template without its inverse; False if it has none."""
    samples, grids, columns, normal = scratch
    window, values = templates.window, templates.grey[t]
    by_x, by_y = templates.by_x[t], templates.by_y[t]
    num = len(window)
    for g in range(5):  # half a pixel along x and y, half a pixel back, and the patch itself
        sx, sy = 0.5 * ((g == 0) - (g == 2)), 0.5 * ((g == 1) - (g == 3))
        _sample_grid(coefficients, origin, spread, reach, sx, sy, samples, grids[g])
    for k in range(num):
        by_x[k], by_y[k] = grids[0, k] - grids[2, k], grids[1, k] - grids[3, k]
        values[k] = grids[4, k]
    if not _is_usable(mask, samples[0]):
        templates.states[t] = MASKED
        return False
    mass, mean, square = _statistics(window, values)
    for k in range(num):
        values[k] -= mean
    corner = _normal_matrix(templates, t, reach, columns, normal)
    textured = corner and square > mass * least_contrast * least_contrast
    templates.states[t] = ALIGNED if textured else FLAT
    return textured


@_kernel
def cut_templates(coefficients, mask, rows, origins, spreads, least_contrast, templates):
    """Fill the rows (R,) of templates from their reference frame.

    Args:
        mask: (H, 2H) bool, True = use, or empty.
        origins (T, 3), spreads (T, 3, 2): the plane patches.
        least_contrast: standard deviation in grey values below which there is no texture.
    """
    num = len(templates.window)
    reach = int(np.sqrt(num)) // 2
    normal = np.empty((8, 8))
    scratch = _scratch(reach), np.empty((5, num), np.float32), np.empty((8, num)), normal
    for t in rows:
        if _cut(
            coefficients, mask, t, origins[t], spreads[t], least_contrast, templates, reach, scratch
        ):
            _invert(normal, templates.inverses[t])


@_part
def _invert(matrix, inverse):
    """Write the inverse (8, 8) of a symmetric positive definite matrix, which is overwritten by
    its Cholesky factor and that factor's inverse below and on the diagonal."""
    for c in range(8):
        for r in range(c, 8):
            total = matrix[r, c]
            for k in range(c):
                total -= matrix[r, k] * matrix[c, k]
            matrix[r, c] = np.sqrt(total) if r == c else total / matrix[c, c]
    for c in range(8):
        matrix[c, c] = 1.0 / matrix[c, c]
        for r in range(c + 1, 8):
            total = 0.0
            for k in range(c, r):
                total -= matrix[r, k] * matrix[k, c]
            matrix[r, c] = total / matrix[r, r]
    for r in range(8):
        for c in range(8):
            total = 0.0
            for k in range(max(r, c), 8):
                total += matrix[k, r] * matrix[k, c]
            inverse[r, c] = total


@_part
def _gradient(templates, t, reach, values, places, gain, offset, b):
    """Write the normal equations' right side (8,); returns the residual's weighted square.

    Sums are variables of their own and the loop has no others, so that it is vectorised.
    """
    window, grey = templates.window, templates.grey[t]
    by_x, by_y = templates.by_x[t], templates.by_y[t]
    inverse_gain = 1.0 / gain
    cost = total = of_grey = along_x = along_y = xx = yx = xy = yy = 0.0
    for k in range(len(window)):
        e = (values[k] - offset) * inverse_gain - grey[k]
        weighted = window[k] * e
        ex, ey, x, y = weighted * by_x[k], weighted * by_y[k], places[0, k], places[1, k]
        cost += weighted * e
        total += weighted
        of_grey += weighted * grey[k]
        along_x += ex
        along_y += ey
        xx += ex * x
        yx += ey * x
        xy += ex * y
        yy += ey * y
    half = reach + 1.0
    b[0], b[1], b[2], b[3] = along_x, along_y, half * xx, half * yx
    b[4], b[5], b[6], b[7] = half * xy, half * yy, of_grey, total
    return cost


@_part
def _judge(templates, t, values, mean, square, power, mass):
    """ZNCC, and the residual's variance after gain and offset, in the template's grey values."""
    cross = 0.0
    for k in range(len(values)):
        cross += templates.window[k] * (values[k] - mean) * templates.grey[t, k]
    gain = max(cross / power, 1e-6)
    rest = max(square - gain * cross, _MIN_GREY_VARIANCE * mass)
    freedom = 1.0 - 8.0 / len(values)
    return cross / np.sqrt(square * power), rest / (gain * gain * mass * freedom)


@_part
def _align(coefficients, mask, o, sightings, max_shift, steps, tolerance, templates, scratch):
    """`align_templates` of one sighting; returns its state."""
    samples, values, origin, spread, b, step = scratch
    window = templates.window
    reach = int(np.sqrt(len(window))) // 2
    t, warp = sightings.templates[o], sightings.warps[o]
    power = _statistics(window, templates.grey[t])[2]
    gain = offset = 0.0
    settled = False
    for number in range(steps + 1):
        _place(sightings, o, origin, spread)
        _sample_grid(coefficients, origin, spread, reach, 0.0, 0.0, samples, values)
        if number == 0 or settled:
            mass, mean, square = _statistics(window, values)
            if not square > _MIN_GREY_VARIANCE * mass:
                return FLAT
            if settled:
                sightings.scores[o], sightings.variances[o] = _judge(
                    templates, t, values, mean, square, power, mass
                )
                return ALIGNED if _is_usable(mask, samples[0]) else MASKED
            gain, offset = np.sqrt(square / power), mean
        cost = _gradient(templates, t, reach, values, samples[2], gain, offset, b)
        if number >= _TRIAL_STEPS and not cost < power:
            return UNLIKE
        _solve(templates, t, warp, b, step)
        offset += gain * step[7]
        gain *= max(1.0 + step[6], 0.2)
        if not _compose(warp, step) or not warp[0] ** 2 + warp[1] ** 2 < max_shift**2:
            return FAR
        settled = step[0] ** 2 + step[1] ** 2 < tolerance**2
    return UNSTEADY


@_kernel
def align_templates(coefficients, mask, rows, sightings, max_shift, steps, tolerance, templates):
    """Align templates to one frame by inverse-compositional Gauss-Newton.

    The template's point q = (x, y) is matched at origin + spread @ (shift + (1 + affine) q),
    with a gain and an offset. Baker & Matthews, "Lucas-Kanade 20 Years On", IJCV 56(3), 2004.

    Args:
        rows (R,): sightings in this frame; their warps, scores, variances and states are written.
        max_shift: largest shift, template pixels; beyond it a patch fails.
        steps: largest number of steps.
        tolerance: of the shift's last step, template pixels.
    """
    num = len(templates.window)
    reach = int(np.sqrt(num)) // 2
    origin, spread = np.empty(3), np.empty((3, 2))
    values = np.empty(num, np.float32)
    scratch = _scratch(reach), values, origin, spread, np.empty(8), np.empty(8)
    for o in rows:
        sightings.states[o] = _align(
            coefficients, mask, o, sightings, max_shift, steps, tolerance, templates, scratch
        )


@_part
def _place(sightings, o, origin, spread):
    """Write the plane patch (3,), (3, 2) of a sighting under its warp."""
    warp = sightings.warps[o]
    for i in range(3):
        p, q = sightings.spreads[o, i, 0], sightings.spreads[o, i, 1]
        origin[i] = sightings.origins[o, i] + p * warp[0] + q * warp[1]
        spread[i, 0] = p * (1.0 + warp[2]) + q * warp[3]
        spread[i, 1] = p * warp[4] + q * (1.0 + warp[5])


@_part
def _solve(templates, t, warp, b, step):
    """Write the Gauss-Newton step (8,), with a zero prior on the affine part."""
    for r in range(2, 6):
        b[r] += templates.prior * warp[r]
    for r in range(8):
        total = 0.0
        for c in range(8):
            total += templates.inverses[t, r, c] * b[c]
        step[r] = total


@_part
def _compose(warp, step):
    """warp := warp after the inverse of the step's warp; False if the step is not invertible."""
    a, c, b, d = 1.0 + step[2], step[3], step[4], 1.0 + step[5]
    determinant = a * d - b * c
    if not determinant > 0.1:
        return False
    p, r, q, s = 1.0 + warp[2], warp[3], warp[4], 1.0 + warp[5]
    na, nb = (p * d - q * c) / determinant, (q * a - p * b) / determinant
    nc, nd = (r * d - s * c) / determinant, (s * a - r * b) / determinant
    warp[0] -= na * step[0] + nb * step[1]
    warp[1] -= nc * step[0] + nd * step[1]
    warp[2], warp[3], warp[4], warp[5] = na - 1.0, nc, nb, nd - 1.0
    return True
