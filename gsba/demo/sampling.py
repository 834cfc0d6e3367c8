"""Filtered albedo and baked light at a ray's hit on a face: textures are sampled along an
anisotropic footprint from exact ray differentials (Igehy, SIGGRAPH 1999)."""

import numpy as np

from gsba.demo.raycast import part


@part
def bilinear(values, offset, width, height, x, y):
    """Value (3) at (x, y), in cells with centres at whole numbers, clamped to the border."""
    x = min(max(x, 0.0), width - 1.0)
    y = min(max(y, 0.0), height - 1.0)
    i, j = int(x), int(y)
    fx, fy = x - i, y - j
    p = offset + j * width + i
    q = p + width if j + 1 < height else p
    right = 1 if i + 1 < width else 0
    w00, w10, w01, w11 = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
    r, s = p + right, q + right
    return (
        w00 * values[p, 0] + w10 * values[r, 0] + w01 * values[q, 0] + w11 * values[s, 0],
        w00 * values[p, 1] + w10 * values[r, 1] + w01 * values[q, 1] + w11 * values[s, 1],
        w00 * values[p, 2] + w10 * values[r, 2] + w01 * values[q, 2] + w11 * values[s, 2],
    )


@part
def _texture(scene, texture, s, t, ds, dt, size, taps):
    """Mean albedo (3), 0..255, of `taps` samples of `size` texels along (ds, dt) about (s, t)."""
    top = scene.levels.shape[1] - 1
    level = min(max(np.log2(size), 0.0), float(top))
    low = int(level)
    r, g, b = 0.0, 0.0, 0.0
    for k in range(2):
        weight = level - low if k else 1 - (level - low)
        if weight <= 0:
            continue
        at = low + k
        offset, width = scene.levels[texture, at, 0], scene.levels[texture, at, 1]
        height, scale = scene.levels[texture, at, 2], 1 / (1 << at)
        for tap in range(taps):
            f = (tap + 0.5) / taps - 0.5
            x, y = (s + f * ds) * scale - 0.5, (t + f * dt) * scale - 0.5
            c = bilinear(scene.texels, offset, width, height, x, y)
            r, g, b = r + weight * c[0], g + weight * c[1], b + weight * c[2]
    return r / taps, g / taps, b / taps


@part
def _slide(scene, q, d, t, e):
    """Change of the texture coordinates s, t at the hit when the direction d changes by e."""
    n, w = scene.normals, scene.duals
    along = n[q, 0] * d[0] + n[q, 1] * d[1] + n[q, 2] * d[2]
    ratio = (n[q, 0] * e[0] + n[q, 1] * e[1] + n[q, 2] * e[2]) / along
    x, y, z = t * (e[0] - d[0] * ratio), t * (e[1] - d[1] * ratio), t * (e[2] - d[2] * ratio)
    return (
        scene.windows[q, 2] * (w[q, 0, 0] * x + w[q, 0, 1] * y + w[q, 0, 2] * z),
        scene.windows[q, 3] * (w[q, 1, 0] * x + w[q, 1, 1] * y + w[q, 1, 2] * z),
    )


@part
def albedo_at(scene, q, a, b, d, t, du, dv):
    """Filtered albedo (3), 0..255, for a ray of distance t whose direction varies by du and dv."""
    u, v = _slide(scene, q, d, t, du), _slide(scene, q, d, t, dv)
    longer, shorter = np.sqrt(u[0] ** 2 + u[1] ** 2), np.sqrt(v[0] ** 2 + v[1] ** 2)
    if longer < shorter:
        u, longer, shorter = v, shorter, longer
    # texture samples along the longer axis of a stretched footprint
    size = max(shorter, longer / 8, 1.0)
    taps = int(np.ceil(longer / size - 1e-6))
    x = scene.windows[q, 0] + a * scene.windows[q, 2]
    y = scene.windows[q, 1] + b * scene.windows[q, 3]
    return _texture(scene, scene.textures[q], x, y, u[0], u[1], size, max(taps, 1))


@part
def light_at(scene, light, q, a, b):
    """Baked light (3) at face coordinates a, b."""
    columns, rows = scene.light_grids[q, 1], scene.light_grids[q, 2]
    x, y = a * (columns - 1), b * (rows - 1)
    return bilinear(light, scene.light_grids[q, 0], columns, rows, x, y)
