"""Compiled passes over patches of panoramas: cut templates, and align them to other frames.

A patch is a plane piece of scene: the rays origin + spread @ (x, y) of an n x n grid of unit
spacing, row-major in (x, y), x and y from -reach to reach. Images are spline coefficients
(H, 2H) float32.

A pixel averages over a piece of surface, whose size and shape differ between two views: one picture
of a patch is more blurred than the other. To first order they differ by the second derivatives of
the grey values, times half the difference of the two blurs' covariances (Lindeberg, "Scale-Space
Theory in Computer Vision", 1994: blur obeys the diffusion equation). These three numbers are
unknowns of an alignment, beside shift, affine part, gain and offset; left out, they shift patches.
"""

from typing import NamedTuple

import numpy as np

from factors.compiled import kernel_and_part
from factors.sphere_image import spline_weights, tap

# States of a sighting: aligned; without texture; masked; shifted too far; not converged in the
# allowed steps; uncorrelated.
ALIGNED, FLAT, MASKED, FAR, UNSTEADY, UNLIKE = 0, 1, 2, 3, 4, 5


class Templates(NamedTuple):
    """Patches cut from their reference frames, and precomputed terms of their alignment."""

    window: np.ndarray  # (n * n,) float64, weight of each pixel, at most 1
    affine_prior: float  # weight of a deviation of the affine part, in grey values squared
    blur_prior: float  # weight of a difference of blur, in grey values squared
    grey: np.ndarray  # (T, n * n) float32, weighted mean removed
    by_x: np.ndarray  # (T, n * n) float32, derivatives of grey
    by_y: np.ndarray  # (T, n * n) float32
    curvatures: np.ndarray  # (T, 3, n * n) float32, second derivatives of grey: xx, xy, yy
    inverses: np.ndarray  # (T, 11, 11) float32, of the normal matrix of [shift, affine, gain,
    # offset, blur]
    states: np.ndarray  # (T,) uint8, ALIGNED where usable


class Sightings(NamedTuple):
    """Predicted sightings of templates, and the results of their alignment."""

    templates: np.ndarray  # (O,) int64, row of the template
    origins: np.ndarray  # (O, 3) float64, the template's plane patch, rig frame of the observing
    # frame
    spreads: np.ndarray  # (O, 3, 2) float64
    warps: np.ndarray  # (O, 6) float64, shift (2) and affine by columns (4): start, and result
    scores: np.ndarray  # (O,) float64, ZNCC
    variances: np.ndarray  # (O,) float64, of the residual, in the template's grey values
    states: np.ndarray  # (O,) uint8


_POLE_HALF_PATCHES = 8.0  # distance from a pole, in half patches, within which each ray needs its
# own pixel
_MAX_OFF_CENTRE = 0.25  # pixels between a patch's centre and that of the square its pixels are
# mapped in; the map is exact there
_UNKNOWNS, _BLUR = 11, 8  # unknowns of an alignment, and the first one of the blur
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
    u = width * (_arctan2(a, c) / (2 * np.pi) + 0.5)
    return u, height * (0.5 + _arctan2(b, np.sqrt(a * a + c * c)) / np.pi)


@_part
def _arctan2(y, x):
    """Angle of (x, y) to 2e-8 rad, free of branches so that loops of it are vectorised.

    Abramowitz & Stegun, "Handbook of Mathematical Functions", 1964, 4.4.49.
    """
    p, q = np.abs(x), np.abs(y)
    t = min(p, q) / max(p, q, 1e-300)
    t2 = t * t
    series = -0.0161657367 + t2 * 0.0028662257
    series = 0.1065626393 + t2 * (-0.0752896400 + t2 * (0.0429096138 + t2 * series))
    series = -0.3333314528 + t2 * (0.1999355085 + t2 * (-0.1420889944 + t2 * series))
    angle = t + t * t2 * series
    angle = np.pi / 2 - angle if q > p else angle
    angle = np.pi - angle if x < 0 else angle
    return -angle if y < 0 else angle


@_part
def _map_pixels(origin, spread, square, width, height, nodes, quadratics):
    """Pixels of the rays origin + spread @ (x, y) in a square of a plane patch, as biquadratics.

    Args:
        origin (3,), spread (3, 2): a plane patch seen from the rig; rig frame, any length.
        square (3,): centre x and y, and half the width.
        nodes (3, 3, 2): scratch, pixels of the square's corners, edges and centre, x by rows.
        quadratics (2, 3, 3): of u and v; coefficient [i, j] is of the i-th power of x and the j-th
            of y, both from the centre in halves of the square.

    Returns:
        False if a pole is too near for the polynomial: then each ray needs its own pixel.
    """
    for i in range(3):
        for j in range(3):
            x, y = square[0] + (i - 1) * square[2], square[1] + (j - 1) * square[2]
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
    size2 = from_pole2 = 0.0  # two squared steps, at least the square of the longest
    for i in range(3):
        size2 += spread[i, 0] ** 2 + spread[i, 1] ** 2
        across = origin[i] + spread[i, 0] * square[0] + spread[i, 1] * square[1]
        from_pole2 += across * across if i != 1 else 0.0
    return from_pole2 > size2 * (_POLE_HALF_PATCHES * square[2]) ** 2


@_allocating
def _scratch(reach):
    """Scratch for `_sample_patch`: nodes, quadratics and square, see `_map_pixels`; places
    (2, n * n) in the patch, pixels (2, n * n), columns and rows (2, n * n) before them, weights
    (8, n * n) of the samples around."""
    n = 2 * reach + 1
    places = np.empty((2, n * n))
    for i in range(n):
        for j in range(n):
            places[0, i * n + j], places[1, i * n + j] = i - reach, j - reach
    nodes, quadratics, square = np.empty((3, 3, 2)), np.empty((2, 3, 3)), np.zeros(3)
    pixels, before = np.empty((2, n * n)), np.empty((2, n * n), np.int32)
    weights = np.empty((8, n * n), np.float32)
    return nodes, quadratics, square, places, pixels, before, weights


@_part
def _sample_patch(coefficients, origin, spread, warp, reach, smooth, scratch, out):
    """Values (n * n,) of an n x n grid of unit spacing on a plane patch, under a warp.

    `out[i * n + j]` is at shift + (1 + affine) @ (i - reach, j - reach), n = 2 reach + 1.

    Args:
        warp: (6,) shift and affine part, by columns.
        smooth: what the last call for this patch returned; True for the first one.
        scratch: of `_scratch`; `square[2] = 0` before the first call for a patch.

    Returns:
        False if a pole is too near for the polynomial.
    """
    nodes, quadratics, square, places, pixels, before, weights = scratch
    height, width = coefficients.shape
    a, b, c, d = 1.0 + warp[2], warp[3], warp[4], 1.0 + warp[5]
    extent = reach * max(abs(a) + abs(c), abs(b) + abs(d))
    off = max(abs(warp[0] - square[0]), abs(warp[1] - square[1]))
    if off > _MAX_OFF_CENTRE or extent + _MAX_OFF_CENTRE > square[2]:
        square[0], square[1], square[2] = warp[0], warp[1], extent + 1.0
        smooth = _map_pixels(origin, spread, square, width, height, nodes, quadratics)
    if smooth:
        _find_pixels(quadratics, square, places, warp, pixels)
    else:
        _project_pixels(origin, spread, places, warp, nodes[1, 1, 0], width, height, pixels)
    if _find_taps(pixels, width, height, before, weights):
        _sum_inside(coefficients, before, weights, out)
    else:
        _sum_anywhere(coefficients, before, weights, out)
    return smooth


@_part
def _find_pixels(quadratics, square, places, warp, pixels):
    """Write pixels of places under a warp, by biquadratics.

    Free of branches and of arrays that may alias its output, so that it is vectorised.
    """
    p, q = quadratics[0], quadratics[1]
    p00, p01, p02 = p[0, 0], p[0, 1], p[0, 2]
    p10, p11, p12 = p[1, 0], p[1, 1], p[1, 2]
    p20, p21, p22 = p[2, 0], p[2, 1], p[2, 2]
    q00, q01, q02 = q[0, 0], q[0, 1], q[0, 2]
    q10, q11, q12 = q[1, 0], q[1, 1], q[1, 2]
    q20, q21, q22 = q[2, 0], q[2, 1], q[2, 2]
    scale = 1.0 / square[2]
    shift_x, shift_y = scale * (warp[0] - square[0]), scale * (warp[1] - square[1])
    a, b, c, d = scale + scale * warp[2], scale * warp[3], scale * warp[4], scale + scale * warp[5]
    for k in range(places.shape[1]):
        x = shift_x + a * places[0, k] + c * places[1, k]
        y = shift_y + b * places[0, k] + d * places[1, k]
        u0, v0 = p00 + x * (p10 + x * p20), q00 + x * (q10 + x * q20)
        u1, v1 = p01 + x * (p11 + x * p21), q01 + x * (q11 + x * q21)
        u2, v2 = p02 + x * (p12 + x * p22), q02 + x * (q12 + x * q22)
        pixels[0, k], pixels[1, k] = u0 + y * (u1 + y * u2), v0 + y * (v1 + y * v2)


@_part
def _project_pixels(origin, spread, places, warp, centre, width, height, pixels):
    """Write pixels of places under a warp, each of its own ray; u within half a turn of a
    centre."""
    a, b, c, d = 1.0 + warp[2], warp[3], warp[4], 1.0 + warp[5]
    shift_x, shift_y = warp[0], warp[1]
    for k in range(places.shape[1]):
        x = shift_x + a * places[0, k] + c * places[1, k]
        y = shift_y + b * places[0, k] + d * places[1, k]
        u, v = _ray_pixel(origin, spread, x, y, width, height)
        pixels[0, k] = u - width * np.floor((u - centre) / width + 0.5)
        pixels[1, k] = v


@_part
def _find_taps(pixels, width, height, before, weights):
    """Write columns and rows before pixels, and weights; False if samples lie beyond an edge."""
    left, right = np.int32(width), np.int32(-1)
    top, bottom = np.int32(height), np.int32(-1)
    for k in range(pixels.shape[1]):
        u, v = pixels[0, k] - 0.5, pixels[1, k] - 0.5
        column, row = np.floor(u), np.floor(v)
        a0, a1, a2, a3 = spline_weights(np.float32(u - column))
        b0, b1, b2, b3 = spline_weights(np.float32(v - row))
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
def _sum_anywhere(coefficients, before, weights, out):
    """Values at places whose samples may lie beyond the seam or a pole."""
    for k in range(len(out)):
        value = np.float32(0.0)
        for i in range(4):
            for j in range(4):
                sample = tap(coefficients, before[1, k] - 1 + i, before[0, k] - 1 + j)
                value += weights[4 + i, k] * weights[j, k] * sample
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
    """Write the normal matrix (11, 11) of a template; False if it does not determine a shift.

    columns (11, n * n) is scratch, so that each sum is a loop of its own, which is vectorised.
    """
    n = 2 * reach + 1
    window, grey = templates.window, templates.grey[t]
    by_x, by_y, curvatures = templates.by_x[t], templates.by_y[t], templates.curvatures[t]
    for k in range(n * n):
        x, y = k // n - reach, k % n - reach
        columns[0, k], columns[1, k] = by_x[k], by_y[k]
        columns[2, k], columns[3, k] = by_x[k] * x, by_y[k] * x
        columns[4, k], columns[5, k] = by_x[k] * y, by_y[k] * y
        columns[6, k], columns[7, k] = grey[k], 1.0
        for c in range(3):
            columns[_BLUR + c, k] = curvatures[c, k]
    for i in range(_UNKNOWNS):
        for j in range(i, _UNKNOWNS):
            one, other, total = columns[i], columns[j], 0.0
            for k in range(n * n):
                total += window[k] * one[k] * other[k]
            normal[i, j] = normal[j, i] = total
    trace = normal[0, 0] + normal[1, 1]
    determinant = normal[0, 0] * normal[1, 1] - normal[0, 1] ** 2
    for r in range(_UNKNOWNS):
        normal[r, r] *= 1.0 + 1e-6
        if 2 <= r < 6:
            normal[r, r] += templates.affine_prior
        elif r >= _BLUR:
            normal[r, r] += templates.blur_prior
    return determinant > 1e-4 * trace * trace  # excludes edges


@_part
def _curve(grids, by_x, n, curvatures):
    """Write second derivatives (3, n * n) of a patch from its samples, see `_cut`."""
    for k in range(n * n):
        twice, row = 2 * grids[0, k], k % n
        after, before = k + (row < n - 1), k - (row > 0)
        curvatures[0, k] = 4 * (grids[1, k] - twice + grids[3, k])
        curvatures[1, k] = (by_x[after] - by_x[before]) / (after - before)
        curvatures[2, k] = 4 * (grids[2, k] - twice + grids[4, k])


@_part
def _cut(coefficients, mask, t, origin, spread, least_contrast, templates, reach, scratch):
    """`cut_templates` of one template without its inverse; False if it has none."""
    samples, grids, columns, normal, warp = scratch
    window, values = templates.window, templates.grey[t]
    by_x, by_y = templates.by_x[t], templates.by_y[t]
    num, smooth = len(window), True
    samples[2][2] = 0.0
    for g in range(5):  # the patch itself, half a pixel along x and y, half a pixel back
        warp[0], warp[1] = 0.5 * ((g == 1) - (g == 3)), 0.5 * ((g == 2) - (g == 4))
        smooth = _sample_patch(coefficients, origin, spread, warp, reach, smooth, samples, grids[g])
    for k in range(num):
        by_x[k], by_y[k] = grids[1, k] - grids[3, k], grids[2, k] - grids[4, k]
        values[k] = grids[0, k]
    _curve(grids, by_x, 2 * reach + 1, templates.curvatures[t])
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
    normal = np.empty((_UNKNOWNS, _UNKNOWNS))
    grids, columns = np.empty((5, num), np.float32), np.empty((_UNKNOWNS, num))
    scratch = _scratch(reach), grids, columns, normal, np.zeros(6)
    for t in rows:
        if _cut(
            coefficients, mask, t, origins[t], spreads[t], least_contrast, templates, reach, scratch
        ):
            _invert(normal, templates.inverses[t])


@_part
def _invert(matrix, inverse):
    """Write the inverse (11, 11) of a symmetric positive definite matrix, which is overwritten by
    its Cholesky factor and that factor's inverse below and on the diagonal."""
    for c in range(_UNKNOWNS):
        for r in range(c, _UNKNOWNS):
            total = matrix[r, c]
            for k in range(c):
                total -= matrix[r, k] * matrix[c, k]
            matrix[r, c] = np.sqrt(total) if r == c else total / matrix[c, c]
    for c in range(_UNKNOWNS):
        matrix[c, c] = 1.0 / matrix[c, c]
        for r in range(c + 1, _UNKNOWNS):
            total = 0.0
            for k in range(c, r):
                total -= matrix[r, k] * matrix[k, c]
            matrix[r, c] = total / matrix[r, r]
    for r in range(_UNKNOWNS):
        for c in range(_UNKNOWNS):
            total = 0.0
            for k in range(max(r, c), _UNKNOWNS):
                total += matrix[k, r] * matrix[k, c]
            inverse[r, c] = total


@_part
def _gradient(templates, t, values, places, gain, offset, b):
    """Write the normal equations' right side (11,); returns the residual's weighted square.

    Sums are variables of their own and the loop has no others, so that it is vectorised.
    """
    window, grey = templates.window, templates.grey[t]
    by_x, by_y = templates.by_x[t], templates.by_y[t]
    inverse_gain = 1.0 / gain
    curvatures = templates.curvatures[t]
    curved_xx, curved_xy, curved_yy = curvatures[0], curvatures[1], curvatures[2]
    cost = total = of_grey = along_x = along_y = xx = yx = xy = yy = 0.0
    blur_xx = blur_xy = blur_yy = 0.0
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
        blur_xx += weighted * curved_xx[k]
        blur_xy += weighted * curved_xy[k]
        blur_yy += weighted * curved_yy[k]
    b[0], b[1], b[2], b[3] = along_x, along_y, xx, yx
    b[4], b[5], b[6], b[7] = xy, yy, of_grey, total
    b[8], b[9], b[10] = blur_xx, blur_xy, blur_yy
    return cost


@_part
def _correlation(templates, t, values, mean, square, power):
    """ZNCC of values of this mean and sum of squares about it with a template."""
    cross = 0.0
    for k in range(len(values)):
        cross += templates.window[k] * (values[k] - mean) * templates.grey[t, k]
    return cross / np.sqrt(square * power)


@_part
def _unexplained(templates, t, cost, b):
    """Variance of the residual, template grey values, that no unknown explains; b as for
    `_gradient`, with the prior of the affine part as `_solve` leaves it."""
    mass, explained = 0.0, 0.0
    for r in range(_UNKNOWNS):
        for c in range(_UNKNOWNS):
            explained += b[r] * templates.inverses[t, r, c] * b[c]
    for k in range(len(templates.window)):
        mass += templates.window[k]
    freedom = 1.0 - _UNKNOWNS / len(templates.window)
    return max((cost - explained) / mass, _MIN_GREY_VARIANCE) / freedom


@_part
def _align(coefficients, mask, o, sightings, max_shift, steps, tolerance, templates, scratch):
    """`align_templates` of one sighting; returns its state."""
    samples, values, b, step = scratch
    window = templates.window
    reach = int(np.sqrt(len(window))) // 2
    t, warp = sightings.templates[o], sightings.warps[o]
    origin, spread = sightings.origins[o], sightings.spreads[o]
    power = _statistics(window, templates.grey[t])[2]
    gain = offset = 0.0
    settled, smooth = False, True
    samples[2][2] = 0.0
    for number in range(steps + 1):
        smooth = _sample_patch(coefficients, origin, spread, warp, reach, smooth, samples, values)
        if number == 0 or settled:
            mass, mean, square = _statistics(window, values)
            if not square > _MIN_GREY_VARIANCE * mass:
                return FLAT
            if not settled:
                gain, offset = np.sqrt(square / power), mean
        cost = _gradient(templates, t, values, samples[3], gain, offset, b)
        if number >= 4 and not cost < power:  # steps after which a patch must correlate somewhat
            return UNLIKE
        _solve(templates, t, warp, b, step)
        if settled:
            sightings.scores[o] = _correlation(templates, t, values, mean, square, power)
            sightings.variances[o] = _unexplained(templates, t, cost, b)
            return ALIGNED if _is_usable(mask, samples[0]) else MASKED
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
    scratch = _scratch(reach), np.empty(num, np.float32), np.empty(_UNKNOWNS), np.empty(8)
    for o in rows:
        sightings.states[o] = _align(
            coefficients, mask, o, sightings, max_shift, steps, tolerance, templates, scratch
        )


@_part
def _solve(templates, t, warp, b, step):
    """Write the Gauss-Newton step (8,), with zero priors on the affine part and the blur, which is
    estimated anew in each step."""
    for r in range(2, 6):
        b[r] += templates.affine_prior * warp[r]
    for r in range(8):
        total = 0.0
        for c in range(_UNKNOWNS):
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
