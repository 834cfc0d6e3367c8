"""Light baked on the faces: direct from the lamps, then diffuse bounces."""

import numpy as np

from gsba.demo.raycast import Scene, coordinates, in_bands, kernel, nearest
from gsba.demo.sampling import light_at

NUM_BOUNCE_RAYS = 48  # per light sample
NUM_LAMP_POINTS = 3  # per axis of an emitting face, for soft shadows


def bake(scene: Scene) -> np.ndarray:
    """Irradiance / pi, (M, 3) float64, at every light sample of the scene."""
    points, normals = _samples(scene)
    lamps = _lamps(scene)
    origins = points + 0.06 * normals
    direct = np.full((len(points), 3), 0.15)  # light that reaches every surface
    in_bands(_gather_direct, len(points), scene, origins, normals, lamps, direct)
    k = np.arange(NUM_BOUNCE_RAYS) + 0.5
    radius = np.sqrt(k / NUM_BOUNCE_RAYS)  # cosine-weighted sunflower spiral
    angle = k * np.pi * (3 - np.sqrt(5))
    directions = np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)], axis=1
    )
    light = direct
    for _ in range(2):  # bounces
        bounced = direct.copy()
        in_bands(_gather_bounce, len(points), scene, origins, normals, directions, light, bounced)
        light = bounced
    return light


def _samples(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals (M, 3) of all light samples, slightly inside their faces."""
    points, normals = [], []
    for q, (_, columns, rows) in enumerate(scene.light_grids):
        a, b = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
        ab = 0.5 + 0.96 * (np.stack([a.ravel(), b.ravel()], axis=1) - 0.5)
        if scene.spans[q] < 2:
            ab /= 2  # a triangle holds only half of its square
        points.append(scene.corners[q] + ab @ scene.edges[q])
        normals.append(np.broadcast_to(scene.normals[q], (len(ab), 3)))
    return np.concatenate(points), np.concatenate(normals)


def _lamps(scene: Scene) -> np.ndarray:
    """Points (P, 7) on the emitting faces: position, normal, radiance times area."""
    lamps = [np.empty((0, 7))]
    grid = (np.arange(NUM_LAMP_POINTS) + 0.5) / NUM_LAMP_POINTS
    a, b = np.meshgrid(grid, grid)
    ab = np.stack([a.ravel(), b.ravel()], axis=1)
    for q in np.flatnonzero(scene.emissions):
        area = np.linalg.norm(np.cross(*scene.edges[q]))
        power = np.full((len(ab), 1), scene.emissions[q] * area / len(ab))
        normals = np.broadcast_to(scene.normals[q], (len(ab), 3))
        lamps.append(np.hstack([scene.corners[q] + ab @ scene.edges[q], normals, power]))
    return np.concatenate(lamps)


@kernel
def _gather_direct(start, stop, scene, points, normals, lamps, out):
    """Add the light of lamps (P, 7) that reaches points (M, 3) to out (M, 3)."""
    for m in range(start, stop):
        o = (points[m, 0], points[m, 1], points[m, 2])
        for p in range(len(lamps)):
            d = (lamps[p, 0] - o[0], lamps[p, 1] - o[1], lamps[p, 2] - o[2])
            r2 = d[0] ** 2 + d[1] ** 2 + d[2] ** 2
            here = normals[m, 0] * d[0] + normals[m, 1] * d[1] + normals[m, 2] * d[2]
            there = -(lamps[p, 3] * d[0] + lamps[p, 4] * d[1] + lamps[p, 5] * d[2])
            if here > 0 and there > 0 and nearest(scene, o, d, 0.999)[1] < 0:
                light = lamps[p, 6] * here * there / (np.pi * r2 * r2)
                out[m, 0] += light
                out[m, 1] += light
                out[m, 2] += light


@kernel
def _gather_bounce(start, stop, scene, points, normals, directions, light, out):
    """Add the light that lit faces send to points (M, 3); directions (D, 3) lie about +z."""
    for m in range(start, stop):
        o = (points[m, 0], points[m, 1], points[m, 2])
        x, y, z = normals[m, 0], normals[m, 1], normals[m, 2]
        # Orthonormal basis of the normal (Duff et al., JCGT 6(1), 2017).
        sign = 1.0 if z >= 0 else -1.0
        a = -1 / (sign + z)
        b = x * y * a
        s = (1 + sign * x * x * a, sign * b, -sign * x)
        t = (b, sign + y * y * a, -y)
        for k in range(len(directions)):
            u, v, w = directions[k, 0], directions[k, 1], directions[k, 2]
            d = (
                u * s[0] + v * t[0] + w * x,
                u * s[1] + v * t[1] + w * y,
                u * s[2] + v * t[2] + w * z,
            )
            distance, q = nearest(scene, o, d, np.inf)
            if q < 0:
                continue
            ab = coordinates(scene, q, o, d, distance)
            lit = light_at(scene, light, q, ab[0], ab[1])
            albedo = scene.textures[q]
            out[m, 0] += scene.albedos[albedo, 0] * lit[0] / len(directions)
            out[m, 1] += scene.albedos[albedo, 1] * lit[1] / len(directions)
            out[m, 2] += scene.albedos[albedo, 2] * lit[2] / len(directions)
