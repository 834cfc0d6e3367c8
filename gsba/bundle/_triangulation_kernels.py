"""Compiled loops of triangulation: hypotheses from pairs of rays, their support, refinement."""

import numpy as np

from factors.compiled import kernel_and_part

_kernel, _part = kernel_and_part()
_MAX_HYPOTHESES = 12  # pairs of observations tried per track


@_kernel
def cast_rays(first, last, world_T_rigs, frames, bearings, origins, rays, centres):
    """Directions and starts in the world of the rays of observations first to last - 1.

    `origins` (O, 3) in the rig's frame, or (0, 3) if all rays start in the rig's centre.
    """
    for o in range(first, last):
        f = frames[o]
        for i in range(3):
            ray, centre = 0.0, world_T_rigs[f, i, 3]
            for k in range(3):
                ray += world_T_rigs[f, i, k] * bearings[o, k]
            if len(origins):
                turned = 0.0
                for k in range(3):
                    turned += world_T_rigs[f, i, k] * origins[o, k]
                centre += turned
            rays[o, i], centres[o, i] = ray, centre


@_kernel
def triangulate_tracks(
    starts, first, last, rays, centres, sigmas, gate, points, inliers, parallaxes
):
    """Points, inlier flags and largest parallax (radians) of tracks first to last - 1.

    Rays are in the world frame. A hypothesis that all observations support ends the search.
    """
    best = np.empty(3)
    for j in range(first, last):
        lo, hi = starts[j], starts[j + 1]
        best_count, best_cost = 0, np.inf
        tried = 0
        for step in range(hi - lo - 1, 0, -1):  # wide pairs of the track first
            for a in range(lo, hi - step):
                if tried == _MAX_HYPOTHESES or best_count == hi - lo:
                    break
                tried += 1
                x, y, z, ok = _midpoint(rays, centres, a, a + step)
                if not ok:
                    continue
                count, cost = 0, 0.0
                for o in range(lo, hi):
                    error = _squared_error(rays, centres, o, x, y, z) / sigmas[o] ** 2
                    if error < gate * gate:
                        count += 1
                        cost += error
                if count > best_count or (count == best_count and cost < best_cost):
                    best_count, best_cost = count, cost
                    best[0], best[1], best[2] = x, y, z
        if best_count < 2:
            continue
        for _ in range(3):
            _gauss_newton_step(rays, centres, sigmas, lo, hi, best, gate)
        x, y, z = best[0], best[1], best[2]
        cosine = 1.0
        for o in range(lo, hi):
            if _squared_error(rays, centres, o, x, y, z) < (gate * sigmas[o]) ** 2:
                inliers[o] = 1
                for p in range(lo, o):
                    if inliers[p]:
                        cosine = min(cosine, _cosine(centres, o, p, x, y, z))
        points[j, 0], points[j, 1], points[j, 2] = x, y, z
        parallaxes[j] = np.arccos(max(cosine, -1.0))


@_part
def _squared_error(rays, centres, o, x, y, z):
    """Squared tangent of the angle between ray o and the way to a point; inf behind."""
    x, y, z = x - centres[o, 0], y - centres[o, 1], z - centres[o, 2]
    u, v, w = rays[o, 0], rays[o, 1], rays[o, 2]
    along = u * x + v * y + w * z
    if along <= 0:
        return np.inf
    a, b, c = v * z - w * y, w * x - u * z, u * y - v * x
    return (a * a + b * b + c * c) / (along * along)


@_part
def _cosine(centres, o, p, x, y, z):
    """Cosine of the angle at a point between the ways to two centres."""
    a, b, c = x - centres[o, 0], y - centres[o, 1], z - centres[o, 2]
    d, e, f = x - centres[p, 0], y - centres[p, 1], z - centres[p, 2]
    squares = (a * a + b * b + c * c) * (d * d + e * e + f * f)
    return (a * d + b * e + c * f) / np.sqrt(max(squares, 1e-300))


@_part
def _midpoint(rays, centres, a, b):
    """Point halfway between two rays where they come closest; False if parallel or behind."""
    ux, uy, uz = rays[a, 0], rays[a, 1], rays[a, 2]
    vx, vy, vz = rays[b, 0], rays[b, 1], rays[b, 2]
    ax, ay, az = centres[a, 0], centres[a, 1], centres[a, 2]
    wx, wy, wz = centres[b, 0] - ax, centres[b, 1] - ay, centres[b, 2] - az
    c = ux * vx + uy * vy + uz * vz
    denominator = 1 - c * c
    if denominator < 1e-10:
        return ax, ay, az, False
    uw, vw = ux * wx + uy * wy + uz * wz, vx * wx + vy * wy + vz * wz
    s, t = (uw - c * vw) / denominator, (c * uw - vw) / denominator
    x = ax + 0.5 * (s * ux + wx + t * vx)
    y = ay + 0.5 * (s * uy + wy + t * vy)
    z = az + 0.5 * (s * uz + wz + t * vz)
    return x, y, z, s > 0 and t > 0


@_part
def _gauss_newton_step(rays, centres, sigmas, lo, hi, point, gate):
    """Move a point by one step on the sines of the angles of the observations within the gate."""
    xx = xy = xz = yy = yz = zz = gx = gy = gz = 0.0
    for o in range(lo, hi):
        if (
            _squared_error(rays, centres, o, point[0], point[1], point[2])
            >= (gate * sigmas[o]) ** 2
        ):
            continue
        dx, dy, dz = point[0] - centres[o, 0], point[1] - centres[o, 1], point[2] - centres[o, 2]
        u, v, w = rays[o, 0], rays[o, 1], rays[o, 2]
        weight = 1 / (sigmas[o] ** 2 * max(dx * dx + dy * dy + dz * dz, 1e-24))
        along = u * dx + v * dy + w * dz
        gx += weight * (dx - along * u)
        gy += weight * (dy - along * v)
        gz += weight * (dz - along * w)
        xx += weight * (1 - u * u)
        yy += weight * (1 - v * v)
        zz += weight * (1 - w * w)
        xy -= weight * u * v
        xz -= weight * u * w
        yz -= weight * v * w
    # Cholesky factor of the Hessian, its diagonal raised a little
    a = np.sqrt(xx * (1 + 1e-9))
    if not a > 0:
        return
    b, c = xy / a, xz / a
    d = yy * (1 + 1e-9) - b * b
    if not d > 0:
        return
    d = np.sqrt(d)
    e = (yz - b * c) / d
    f = zz * (1 + 1e-9) - c * c - e * e
    if not f > 0:
        return
    f = np.sqrt(f)
    p = gx / a
    q = (gy - b * p) / d
    r = (gz - c * p - e * q) / f
    z = r / f
    y = (q - e * z) / d
    x = (p - b * y - c * z) / a
    point[0] -= x
    point[1] -= y
    point[2] -= z
