"""Compiled: differences between a panorama and its neighbours at assumed distances."""

import math

import numpy as np

from factors.compiled import kernel_and_part

_MIN_VIEW_COSINE, _MAX_DISTANCE_RATIO = 0.6, 2.2  # views rotated or scaled by more are not compared
_PI, _HALF_PI = np.float32(math.pi), np.float32(0.5 * math.pi)  # float32: twice as many at once
_A, _B, _C = np.float32(-0.0464964749), np.float32(0.15931422), np.float32(-0.327622764)
_kernel, _part = kernel_and_part(fastmath=True)
_exact, _ = kernel_and_part()
_TINY, _FAR = np.float32(1e-30), np.float32(1e9)


@_part
def _atan2(y, x):
    """atan2 within 1e-3 rad: a tenth of a pixel on the panoramas that are compared."""
    ax, ay = abs(x), abs(y)
    a = min(ax, ay) / max(max(ax, ay), _TINY)
    s = a * a
    angle = ((_A * s + _B) * s + _C) * s * a + a
    angle = _HALF_PI - angle if ay > ax else angle
    angle = _PI - angle if x < 0 else angle
    return -angle if y < 0 else angle


@_part
def _project(T, rays, inverse, height, u, v):
    """Pixels u, v (W,) in a neighbour's panorama of rays (W, 3) at inverse distances (W,); without
    branches, so that it is compiled to vector instructions."""
    scale = np.float32(height / math.pi)
    across, down = np.float32(height - 0.5), np.float32(0.5 * height - 0.5)
    for c in range(len(rays)):
        a, b, d, w = rays[c, 0], rays[c, 1], rays[c, 2], inverse[c]
        x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * d + w * T[0, 3]
        y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * d + w * T[1, 3]
        z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * d + w * T[2, 3]
        u[c] = _atan2(x, z) * scale + across
        v[c] = _atan2(y, np.sqrt(x * x + z * z)) * scale + down


@_part
def _sort(values):
    """Sort (M, W) along its first axis, all columns at once and without a branch."""
    num, width = values.shape
    for turn in range(num):
        for m in range(turn % 2, num - 1, 2):
            for c in range(width):
                a, b = values[m, c], values[m + 1, c]
                values[m, c], values[m + 1, c] = min(a, b), max(a, b)


@_kernel
def compare(own, least, most, others, n_T_own, rays, inverse, cap, differences, away, spread):
    """Compare a panorama with its neighbours at assumed distances.

    Args:
        own: (H, W, C) float32 grey levels.
        least, most: (H, W, C) float32, extremes of `own` around each pixel: a neighbour's level
            between them is no difference (Birchfield, Tomasi, PAMI 20(4), 1998).
        others: (M, H, W, C) float32, the neighbours, negative where masked.
        n_T_own: (M, 4, 4) float32, from the panorama's own frame to the neighbour's.
        rays: (H, W, 3) float32, unit, rig frame.
        inverse: (H, W) float32, assumed inverse distances along the rays.
        cap: grey levels at which differences are clipped.
        differences: (M, H, W) float32, out: difference to each neighbour; the cap where masked.
        away: (H, W) float32, out: distance from the neighbours' median grey level.
        spread: (H, W) float32, out: typical distance of neighbours from that median.
    """
    num, height, width, channels = others.shape
    u, v = np.empty(width, np.float32), np.empty(width, np.float32)
    greys, ordered = np.empty((num, width), np.float32), np.empty((num, width), np.float32)
    known = np.empty(width, np.int64)
    part = np.float32(1 / channels)
    for r in range(height):
        known[:] = 0
        for m in range(num):
            image = others[m]
            _project(n_T_own[m], rays[r], inverse[r], height, u, v)
            for c in range(width):
                greys[m, c], differences[m, r, c] = _FAR, cap
                left, top = math.floor(u[c]), math.floor(v[c])
                fu, fv = u[c] - np.float32(left), v[c] - np.float32(top)
                r0, r1 = max(int(top), 0), min(int(top) + 1, height - 1)
                c0 = int(left) if left >= 0 else width - 1
                c1 = c0 + 1 if c0 + 1 < width else 0
                if min(image[r0, c0, 0], image[r0, c1, 0]) < 0:
                    continue
                if min(image[r1, c0, 0], image[r1, c1, 0]) < 0:
                    continue
                grey, d = np.float32(0), np.float32(0)
                for k in range(channels):
                    upper = image[r0, c0, k] + fu * (image[r0, c1, k] - image[r0, c0, k])
                    lower = image[r1, c0, k] + fu * (image[r1, c1, k] - image[r1, c0, k])
                    level = upper + fv * (lower - upper)
                    grey += level
                    d += max(least[r, c, k] - level, level - most[r, c, k], np.float32(0))
                greys[m, c], differences[m, r, c] = part * grey, min(part * d, cap)
                known[c] += 1
        ordered[:] = greys
        _sort(ordered)
        for c in range(width):
            n = known[c]
            median = np.float32(0.5) * (ordered[max(n - 1, 0) // 2, c] + ordered[n // 2, c])
            grey = np.float32(0)
            for k in range(channels):
                grey += own[r, c, k]
            away[r, c] = min(abs(part * grey - median), cap) if n > 0 else np.float32(0)
            for m in range(num):
                greys[m, c] = min(abs(greys[m, c] - median), cap) if greys[m, c] < _FAR else _FAR
        _sort(greys)
        for c in range(width):
            spread[r, c] = greys[known[c] // 2, c] if known[c] > 0 else cap


@_kernel
def keep_best(differences, away, spread, best, away_best, spread_best):
    """Update the best differences so far with those of one more distance.

    Args:
        differences, away, spread: see `compare`, of one assumed distance, averaged over patches.
        best: (2, H, W) float32, in and out: second and third smallest difference.
        away_best, spread_best: (H, W) float32, in and out: where neighbours agree best.
    """
    num, height, width = differences.shape
    ordered = np.empty((num, width), np.float32)
    for r in range(height):
        for m in range(num):
            ordered[m] = differences[m, r]
        _sort(ordered)
        for c in range(width):
            best[0, r, c] = min(best[0, r, c], ordered[1, c])
            best[1, r, c] = min(best[1, r, c], ordered[2, c])
            if spread[r, c] < spread_best[r, c]:
                spread_best[r, c], away_best[r, c] = spread[r, c], away[r, c]


@_exact
def witnesses(usable, n_T_own, rays, inverse):
    """Number (H, W) uint8 of neighbours, unmasked in `usable (M, H, W)`, that see an assumed
    distance, from a similar viewpoint; n_T_own, rays, inverse: see `compare`."""
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
                if (
                    cosine < _MIN_VIEW_COSINE * ratio
                    or not 1 < _MAX_DISTANCE_RATIO * ratio < _MAX_DISTANCE_RATIO**2
                ):
                    continue
                u = _atan2(seen[0], seen[2]) / (2 * math.pi) + 0.5
                v = _atan2(seen[1], math.sqrt(seen[0] ** 2 + seen[2] ** 2)) / math.pi + 0.5
                out[r, c] += usable[m, min(int(v * height), height - 1), int(u * width) % width]
    return out
