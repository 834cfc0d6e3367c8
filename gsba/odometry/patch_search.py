"""Patches around keypoints of a panorama, searched along their epipolar lines in another, in
compiled code."""

import numpy as np

from factors.compiled import kernel_and_part
from factors.sphere_image import erp_pixel

_kernel, _part = kernel_and_part(allocating=True, fastmath={"contract", "reassoc", "nsz"})
HALF = 4  # samples from the middle of a patch to its border
SIDE = 2 * HALF + 1
AREA = SIDE * SIDE
_FEW = (HALF + 1) ** 2  # samples that are compared first, every second one of both axes
MIN_LIKENESS, MIN_MARGIN = 0.65, 0.06  # of the best place, and above any other
MIN_FACING = 0.1  # likeness of a plane that faces the camera, below which no other is tried
BESIDE = 0.035  # radians along a line: places further from the best one are others


@_part
def _sums(image, u0, v0, ui, uj, vi, vj, columns, rows, template, first, last):
    """Sums of some samples of a patch, of their squares, and of their products with a template; in
    single precision and without branches, so that the compiler takes several samples at once."""
    total = squares = products = np.float32(0.0)
    for n in range(first, last):
        u = u0 + ui * columns[n] + uj * rows[n]
        v = v0 + vi * columns[n] + vj * rows[n]
        left, top = np.int32(u), np.int32(v)
        a, b = u - np.float32(left), v - np.float32(top)
        x, y = np.uint32(left), np.uint32(top)
        right, low = x + np.uint32(1), y + np.uint32(1)
        above = image[y, x] + a * (image[y, right] - image[y, x])
        below = image[low, x] + a * (image[low, right] - image[low, x])
        value = above + b * (below - above)
        total += value
        squares += value * value
        products += value * template[n]
    return total, squares, products


@_part
def _likeness(image, warp, columns, rows, template, mean, variance, least):
    """Correlation of a patch with a template of unit norm; that of every second sample, whose mean
    and variance are given, where it is below `least`; -1 outside or where it is flat."""
    if not _is_inside(image, warp):
        return np.float32(-1.0)
    u0, v0 = np.float32(warp[0]), np.float32(warp[1])
    ui, uj = np.float32(warp[2]), np.float32(warp[3])
    vi, vj = np.float32(warp[4]), np.float32(warp[5])
    total, squares, products = _sums(
        image, u0, v0, ui, uj, vi, vj, columns, rows, template, 0, _FEW
    )
    var = squares / _FEW - (total / _FEW) * (total / _FEW)
    joint = products / _FEW - total / _FEW * mean
    if not var > 2.0:
        return np.float32(-1.0)
    if not joint > 0.0 or joint * joint < least * least * var * variance:
        return np.float32(joint / np.sqrt(var * variance))
    more = _sums(image, u0, v0, ui, uj, vi, vj, columns, rows, template, _FEW, AREA)
    total, squares, products = total + more[0], squares + more[1], products + more[2]
    var = squares / AREA - (total / AREA) * (total / AREA)
    return np.float32(products / np.sqrt(var * AREA)) if var > 4.0 else np.float32(-1.0)


@_part
def _is_inside(image, warp):
    """True if a patch by its warp (u, v, ui, uj, vi, vj) lies in the image."""
    across = HALF * (abs(warp[2]) + abs(warp[3]))
    down = HALF * (abs(warp[4]) + abs(warp[5]))
    height, width = image.shape
    return (
        warp[0] >= across
        and warp[0] + across < width - 1.001
        and warp[1] >= down
        and warp[1] + down < height - 1.001
    )


@_part
def _sample(image, u, v):
    """Value at a pixel (u, v), OpenCV's origin, between rows and columns of the image."""
    x, y = int(u), int(v)
    a, b = np.float32(u - x), np.float32(v - y)
    above = image[y, x] + a * (image[y, x + 1] - image[y, x])
    below = image[y + 1, x] + a * (image[y + 1, x + 1] - image[y + 1, x])
    return above + b * (below - above)


@_part
def _cut(image, warp, out):
    """The patch by its warp, without its mean, of unit norm; False outside or where it is flat."""
    if not _is_inside(image, warp):
        return False
    total = squares = np.float32(0.0)
    for j in range(-HALF, HALF + 1):
        for i in range(-HALF, HALF + 1):
            u, v = warp[0] + warp[2] * i + warp[3] * j, warp[1] + warp[4] * i + warp[5] * j
            value = _sample(image, u, v)
            out[(j + HALF) * SIDE + i + HALF] = value
            total += value
            squares += value * value
    var = squares / AREA - (total / AREA) * (total / AREA)
    if not var > 4.0:
        return False
    for n in range(AREA):
        out[n] = (out[n] - total / AREA) / np.sqrt(var * AREA)
    return True


@_part
def _place(x, y, z, width, height, pad, warp):
    """Middle of a patch by its ray (x, y, z), in the padded image; False near a pole."""
    if y * y > 0.86 * (x * x + y * y + z * z):
        return False
    warp[0], warp[1] = erp_pixel(x, y, z, width, height)
    warp[0] += pad - 0.5
    warp[1] -= 0.5
    return True


@_part
def _bend(x, y, z, by_i, by_j, width, height, sample, warp):
    """The rest of a patch's warp, from the derivatives (3,) of its middle's ray (x, y, z) by i and
    j, samples."""
    flat2 = x * x + z * z
    squared = flat2 + y * y
    flat = np.sqrt(flat2)
    along = sample * width / (2 * np.pi) / flat2
    down = sample * height / np.pi / (flat * squared)
    warp[2] = along * (z * by_i[0] - x * by_i[2])
    warp[3] = along * (z * by_j[0] - x * by_j[2])
    warp[4] = down * (flat2 * by_i[1] - y * (x * by_i[0] + z * by_i[2]))
    warp[5] = down * (flat2 * by_j[1] - y * (x * by_j[0] + z * by_j[2]))


@_part
def _derivatives(rotation, ray, tangents, plane, out):
    """Derivatives (2, 3) of points on a plane through the ray's end, in the other frame's axes: 0
    facing the camera, 1 level, 2 and 3 upright at 40 degrees to either side."""
    nx, ny, nz = ray[0], ray[1], ray[2]
    if plane == 1:
        nx, ny, nz = 0.0, 1.0, 0.0
    elif plane > 1:
        azimuth = np.arctan2(ray[0], ray[2]) + (0.7 if plane == 2 else -0.7)
        nx, ny, nz = np.sin(azimuth), 0.0, np.cos(azimuth)
    depth = nx * ray[0] + ny * ray[1] + nz * ray[2]
    for e in range(2):
        t = tangents[e]
        slope = (nx * t[0] + ny * t[1] + nz * t[2]) / depth
        x, y, z = t[0] - ray[0] * slope, t[1] - ray[1] * slope, t[2] - ray[2] * slope
        for r in range(3):
            out[e, r] = rotation[r, 0] * x + rotation[r, 1] * y + rotation[r, 2] * z


@_part
def _align(image, template, patch, warp):
    """Correlation after moving and bending an affine warp until the patch fits; -1 = lost."""
    start_u, start_v = warp[0], warp[1]
    normal, right, row = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    for _ in range(12):
        if not _cut(image, warp, patch):
            return np.float32(-1.0)
        normal[:], right[:] = 0.0, 0.0
        for j in range(SIDE):
            for i in range(SIDE):
                west, east = max(i - 1, 0), min(i + 1, SIDE - 1)
                north, south = max(j - 1, 0), min(j + 1, SIDE - 1)
                by_i = (patch[j * SIDE + east] - patch[j * SIDE + west]) / (east - west)
                by_j = (patch[south * SIDE + i] - patch[north * SIDE + i]) / (south - north)
                x, y = i - HALF, j - HALF
                row[0], row[1], row[2] = by_i, by_j, by_i * x
                row[3], row[4], row[5] = by_i * y, by_j * x, by_j * y
                off = template[j * SIDE + i] - patch[j * SIDE + i]
                for a in range(6):
                    right[a] += row[a] * off
                    for b in range(6):
                        normal[a, b] += row[a] * row[b]
        for a in range(6):
            normal[a, a] += 1e-4 if a < 2 else 1.2e-3
        step = np.linalg.solve(normal, right)
        ui, uj, vi, vj = warp[2], warp[3], warp[4], warp[5]
        warp[0] += ui * step[0] + uj * step[1]
        warp[1] += vi * step[0] + vj * step[1]
        warp[2], warp[3] = ui * (1 + step[2]) + uj * step[4], ui * step[3] + uj * (1 + step[5])
        warp[4], warp[5] = vi * (1 + step[2]) + vj * step[4], vi * step[3] + vj * (1 + step[5])
        if abs(step[0]) + abs(step[1]) < 0.02:
            break
    moved = (warp[0] - start_u) ** 2 + (warp[1] - start_v) ** 2
    if moved > 36.0 or warp[2] * warp[5] - warp[3] * warp[4] < 0.1 or not _cut(image, warp, patch):
        return np.float32(-1.0)
    product = np.float32(0.0)
    for n in range(AREA):
        product += patch[n] * template[n]
    return product


@_part
def _order(columns, rows):
    """Places (81,) of a patch's samples, from -4 to 4, those that are compared first before."""
    n = 0
    for few in (True, False):
        for j in range(-HALF, HALF + 1):
            for i in range(-HALF, HALF + 1):
                if (i % 2 == 0 and j % 2 == 0) == few:
                    columns[n], rows[n] = i, j
                    n += 1


@_kernel
def search_patches(
    image0, image1, pad, rays, rotation, direction, beside, step, sample, scores, pixels
):
    """Correlation (N,) and pixel (N, 2) in the other picture of each patch; -1 = none or not alone.

    Rays x1 = rotation x0 + depth^-1 direction; `beside`: lines to either side of the epipolar one,
    `step` radians apart. Images (h, 2h + 2 pad) go on beyond the seam by `pad` columns, which
    pixels do not count.
    """
    height0, width0 = image0.shape[0], image0.shape[1] - 2 * pad
    height1, width1 = image1.shape[0], image1.shape[1] - 2 * pad
    columns, rows, ordered = (
        np.empty(AREA, np.float32),
        np.empty(AREA, np.float32),
        np.empty(AREA, np.float32),
    )
    _order(columns, rows)
    template, patch = np.empty(AREA, np.float32), np.empty(AREA, np.float32)
    warp, tangents, normal = np.empty(6), np.empty((2, 3)), np.empty(3)
    slopes, best, identity = np.empty((4, 2, 3)), np.empty(6), np.eye(3)
    likes = np.empty(int(np.pi / step) + 1, np.float32)
    for n in range(len(rays)):
        scores[n] = -1.0
        ray = rays[n]
        flat = np.sqrt(ray[0] * ray[0] + ray[2] * ray[2])
        tangents[0, 0], tangents[0, 1], tangents[0, 2] = ray[2] / flat, 0.0, -ray[0] / flat
        tangents[1, 0], tangents[1, 1] = -ray[1] * ray[0] / flat, flat
        tangents[1, 2] = -ray[1] * ray[2] / flat
        _derivatives(identity, ray, tangents, 0, slopes[0])
        if not _place(ray[0], ray[1], ray[2], width0, height0, pad, warp):
            continue
        _bend(ray[0], ray[1], ray[2], slopes[0, 0], slopes[0, 1], width0, height0, sample, warp)
        if not _cut(image0, warp, template):
            continue
        mean = variance = np.float32(0.0)
        for s in range(AREA):
            ordered[s] = template[int((rows[s] + HALF) * SIDE + columns[s] + HALF)]
            if s < _FEW:
                mean += ordered[s] / _FEW
                variance += ordered[s] * ordered[s] / _FEW
        variance -= mean * mean
        x0 = rotation[0, 0] * ray[0] + rotation[0, 1] * ray[1] + rotation[0, 2] * ray[2]
        y0 = rotation[1, 0] * ray[0] + rotation[1, 1] * ray[1] + rotation[1, 2] * ray[2]
        z0 = rotation[2, 0] * ray[0] + rotation[2, 1] * ray[1] + rotation[2, 2] * ray[2]
        normal[0] = y0 * direction[2] - z0 * direction[1]
        normal[1] = z0 * direction[0] - x0 * direction[2]
        normal[2] = x0 * direction[1] - y0 * direction[0]
        sine = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
        if sine < 0.05:
            continue  # the epipole: no direction to search
        angle = np.arctan2(sine, x0 * direction[0] + y0 * direction[1] + z0 * direction[2])
        for plane in range(4):
            _derivatives(rotation, ray, tangents, plane, slopes[plane])
        num, top, at = int((angle - 0.06) / step), np.float32(-1.0), 0
        for k in range(num):
            likes[k] = -1.0
        for k in range(num):
            nearness = np.sin(k * step) / np.sin(angle - k * step)
            if nearness > 4.0:
                break
            for m in range(-beside, beside + 1):
                x, y = x0 + nearness * direction[0], y0 + nearness * direction[1]
                z = z0 + nearness * direction[2]
                off = m * step * np.sqrt(x * x + y * y + z * z) / sine
                x, y, z = x + off * normal[0], y + off * normal[1], z + off * normal[2]
                if not _place(x, y, z, width1, height1, pad, warp):
                    continue
                for plane in range(4):
                    if plane == 1 and abs(ray[1]) < 0.17:
                        continue
                    by_i, by_j = slopes[plane, 0], slopes[plane, 1]
                    _bend(x, y, z, by_i, by_j, width1, height1, sample, warp)
                    like = _likeness(image1, warp, columns, rows, ordered, mean, variance, 0.4)
                    likes[k] = max(likes[k], like)
                    if like > top:
                        top, at = like, k
                        for c in range(6):
                            best[c] = warp[c]
                    if plane == 0 and like < MIN_FACING:
                        break
        second = np.float32(-1.0)
        for k in range(num):
            if abs(k - at) * step > BESIDE:
                second = max(second, likes[k])
        if top < MIN_LIKENESS or top - second < MIN_MARGIN:
            continue
        like = _align(image1, template, patch, best)
        if like > MIN_LIKENESS:
            scores[n] = like
            pixels[n, 0], pixels[n, 1] = best[0] + 0.5 - pad, best[1] + 0.5
