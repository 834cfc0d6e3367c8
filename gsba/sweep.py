"""Compiled: how a panorama differs from its neighbours seen through assumed distances."""

import math

import numba
import numpy as np

_COS_MIN, _RATIO_MAX = 0.6, 2.2  # a view turned or scaled by more does not tell


@numba.njit(cache=True, nogil=True, fastmath=True)
def _atan2(y, x):
    """Within 1e-3 rad: a tenth of a pixel on the panoramas that are compared."""
    ax, ay = abs(x), abs(y)
    a = min(ax, ay) / max(max(ax, ay), 1e-30)
    s = a * a
    angle = ((-0.0464964749 * s + 0.15931422) * s - 0.327622764) * s * a + a
    if ay > ax:
        angle = 0.5 * math.pi - angle
    if x < 0:
        angle = math.pi - angle
    return -angle if y < 0 else angle


@numba.njit(cache=True, nogil=True, fastmath=True)
def _sample(image, x, y, z, out):
    """Bilinear colour of a panorama (H, W, C) along (x, y, z) into `out`; False where masked."""
    height, width, channels = image.shape
    u = _atan2(x, z) * (width / (2 * math.pi)) + 0.5 * width - 0.5
    v = _atan2(y, math.sqrt(x * x + z * z)) * (height / math.pi) + 0.5 * height - 0.5
    left, top = math.floor(u), math.floor(v)
    fu, fv = u - left, v - top
    r0, r1 = min(max(int(top), 0), height - 1), min(max(int(top) + 1, 0), height - 1)
    c0, c1 = int(left) % width, (int(left) + 1) % width
    for k in range(channels):
        upper = (1 - fu) * image[r0, c0, k] + fu * image[r0, c1, k]
        lower = (1 - fu) * image[r1, c0, k] + fu * image[r1, c1, k]
        out[k] = (1 - fv) * upper + fv * lower
    return (
        min(image[r0, c0, 0], image[r0, c1, 0]) >= 0
        and min(image[r1, c0, 0], image[r1, c1, 0]) >= 0
    )


@numba.njit(cache=True, nogil=True, fastmath=True)
def _insert(values, num, value):
    """Put a value into its place among the first `num`, which are sorted."""
    j = num
    while j > 0 and values[j - 1] > value:
        values[j] = values[j - 1]
        j -= 1
    values[j] = value


@numba.njit(cache=True, nogil=True, fastmath=True)
def compare(own, least, most, others, n_T_own, rays, inverse, cap, differences, away, spread):
    """Compare a panorama with its neighbours at assumed distances.

    Args:
        own: (H, W, C) float32 grey levels.
        least, most: (H, W, C) float32, extremes of `own` around each pixel: a neighbour's level
            between them is no difference (Birchfield, Tomasi, PAMI 20(4), 1998).
        others: (M, H, W, C) float32, the neighbours, negative where masked.
        n_T_own: (M, 4, 4) float32, a neighbour's frame from the panorama's own.
        rays: (H, W, 3) float32, unit, rig frame.
        inverse: (H, W) float32, assumed inverse distances along the rays.
        cap: grey levels, the largest difference that is told apart.
        differences: (M, H, W) float32, out: to each neighbour; the cap where it is masked.
        away: (H, W) float32, out: from the median grey level of all neighbours.
        spread: (H, W) float32, out: typical distance of neighbours from that median.
    """
    num, height, width, channels = others.shape
    levels = np.empty((num, channels), np.float32)
    ordered, sums = np.empty(num, np.float32), np.empty(num, np.float32)
    for r in range(height):
        for c in range(width):
            w = inverse[r, c]
            x, y, z = rays[r, c, 0], rays[r, c, 1], rays[r, c, 2]
            known = 0
            for m in range(num):
                T = n_T_own[m]
                clear = _sample(
                    others[m],
                    T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + w * T[0, 3],
                    T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + w * T[1, 3],
                    T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + w * T[2, 3],
                    levels[known],
                )
                differences[m, r, c] = cap
                if clear:
                    d = np.float32(0)
                    for k in range(channels):
                        level = levels[known, k]
                        d += max(np.float32(0), least[r, c, k] - level, level - most[r, c, k])
                    differences[m, r, c] = min(d / channels, cap)
                    known += 1
            away[r, c], spread[r, c] = 0.0, cap
            if known == 0:
                continue
            for m in range(known):
                sums[m] = 0
                for k in range(channels):
                    sums[m] += levels[m, k] / channels
                _insert(ordered, m, sums[m])
            median = 0.5 * (ordered[(known - 1) // 2] + ordered[known // 2])
            d = -median
            for k in range(channels):
                d += own[r, c, k] / channels
            away[r, c] = min(abs(d), cap)
            for m in range(known):
                _insert(ordered, m, min(abs(sums[m] - median), cap))
            spread[r, c] = ordered[known // 2]


@numba.njit(cache=True, nogil=True)
def keep_best(differences, away, spread, best, away_best, spread_best):
    """Keep what the best distance so far leaves over.

    Args:
        differences, away, spread: of one assumed distance, as of `compare`, averaged over patches.
        best: (2, H, W) float32, in and out: second and third smallest difference.
        away_best, spread_best: (H, W) float32, in and out: where neighbours agree best.
    """
    num, height, width = differences.shape
    ordered = np.empty(num, np.float32)
    for r in range(height):
        for c in range(width):
            for m in range(num):
                _insert(ordered, m, differences[m, r, c])
            best[0, r, c] = min(best[0, r, c], ordered[1])
            best[1, r, c] = min(best[1, r, c], ordered[2])
            if spread[r, c] < spread_best[r, c]:
                spread_best[r, c], away_best[r, c] = spread[r, c], away[r, c]


@numba.njit(cache=True, nogil=True)
def witnesses(usable, n_T_own, rays, inverse):
    """How many neighbours see what is at some distance, unmasked and from where it looks alike.

    Args:
        usable: (M, H, W) bool, the neighbours' masks.
        n_T_own, rays, inverse: see `compare`.

    Returns:
        (H, W) uint8.
    """
    num, height, width = usable.shape
    out = np.zeros((height, width), np.uint8)
    for r in range(height):
        for c in range(width):
            ray, w = rays[r, c], inverse[r, c]
            for m in range(num):
                T = n_T_own[m]
                turned = np.empty(3)
                seen = np.empty(3)
                for i in range(3):
                    turned[i] = T[i, 0] * ray[0] + T[i, 1] * ray[1] + T[i, 2] * ray[2]
                    seen[i] = turned[i] + w * T[i, 3]
                ratio = math.sqrt(seen[0] ** 2 + seen[1] ** 2 + seen[2] ** 2)
                cosine = turned[0] * seen[0] + turned[1] * seen[1] + turned[2] * seen[2]
                if cosine < _COS_MIN * ratio or not 1 < _RATIO_MAX * ratio < _RATIO_MAX**2:
                    continue
                u = _atan2(seen[0], seen[2]) / (2 * math.pi) + 0.5
                v = _atan2(seen[1], math.sqrt(seen[0] ** 2 + seen[2] ** 2)) / math.pi + 0.5
                out[r, c] += usable[m, min(int(v * height), height - 1), int(u * width) % width]
    return out
