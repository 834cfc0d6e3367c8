"""Scene points from bearings and poses, robust to false observations in a track."""

import numba
import numpy as np

from gsba.config import TriangulateSettings
from gsba.types import Counts, Landmarks, Tracks

_MAX_HYPOTHESES = 12  # pairs of observations tried per track


def run(
    tracks: Tracks,
    bearings_rig: np.ndarray,
    sigmas_rad: np.ndarray,
    world_T_rigs: np.ndarray,
    max_error_sigmas: float,
    settings: TriangulateSettings,
) -> Landmarks:
    """Triangulate every track and drop what does not fit.

    A point is hypothesised from pairs of observations, scored by how many of its track's
    observations lie within the gate in front of their frame, and refined on those (weighted
    midpoint, then Gauss-Newton on tangent-plane residuals).

    Args:
        tracks: candidate tracks.
        bearings_rig: (O, 3) bearings of the observations.
        sigmas_rad: (O,) their noise.
        world_T_rigs: (F, 4, 4) current poses.
        max_error_sigmas: gate on the angle between observation and point, in sigmas.
        settings: limits on parallax and track length.
    """
    starts = np.searchsorted(tracks.points, np.arange(tracks.num_points + 1))
    rays = np.einsum("oij,oj->oi", world_T_rigs[tracks.frames, :3, :3], bearings_rig)
    centres = world_T_rigs[tracks.frames, :3, 3]
    points = np.zeros((tracks.num_points, 3))
    inliers = np.zeros(len(rays), np.int64)
    parallaxes = np.zeros(tracks.num_points)
    _triangulate(starts, rays, centres, sigmas_rad, max_error_sigmas, points, inliers, parallaxes)
    lengths = np.add.reduceat(inliers, starts[:-1]) if len(rays) else np.zeros(0, int)
    short = lengths < settings.min_track_length
    flat = ~short & (parallaxes < np.deg2rad(settings.min_parallax_deg))
    kept = ~short & ~flat
    rows = np.flatnonzero(inliers.astype(bool) & kept[tracks.points])
    renumbered = np.cumsum(kept) - 1
    survivors = Tracks(
        renumbered[tracks.points[rows]].astype(np.int32),
        tracks.frames[rows],
        tracks.keypoints[rows],
        int(kept.sum()),
    )
    counts = Counts(
        tracks.num_points,
        survivors.num_points,
        "tracks",
        {"observations disagree": int(short.sum()), "parallax too small": int(flat.sum())},
    )
    return Landmarks(points[kept], survivors, counts)


@numba.njit(cache=True, nogil=True)
def _triangulate(starts, rays, centres, sigmas, gate, points, inliers, parallaxes):
    """Point, inlier flags and largest parallax (radians) of each track; rays in the world frame."""
    for j in range(len(starts) - 1):
        lo, hi = starts[j], starts[j + 1]
        best_count, best_cost = 0, np.inf
        best = np.zeros(3)
        tried = 0
        for step in range(hi - lo - 1, 0, -1):  # wide pairs of the track first
            for a in range(lo, hi - step):
                if tried == _MAX_HYPOTHESES:
                    break
                tried += 1
                point, ok = _midpoint(rays, centres, a, a + step)
                if not ok:
                    continue
                count, cost = 0, 0.0
                for o in range(lo, hi):
                    error = _angle(rays[o], point - centres[o]) / sigmas[o]
                    if error < gate:
                        count += 1
                        cost += error * error
                if count > best_count or (count == best_count and cost < best_cost):
                    best_count, best_cost, best = count, cost, point
        if best_count < 2:
            continue
        for _ in range(3):
            best = _gauss_newton_step(rays, centres, sigmas, lo, hi, best, gate)
        for o in range(lo, hi):
            if _angle(rays[o], best - centres[o]) / sigmas[o] < gate:
                inliers[o] = 1
                for p in range(lo, o):
                    if inliers[p]:
                        parallax = _angle(best - centres[o], best - centres[p])
                        parallaxes[j] = max(parallaxes[j], parallax)
        points[j] = best


@numba.njit(cache=True, nogil=True)
def _angle(a, b):
    """Angle between two vectors, accurate when small."""
    x = a[1] * b[2] - a[2] * b[1]
    y = a[2] * b[0] - a[0] * b[2]
    z = a[0] * b[1] - a[1] * b[0]
    return np.arctan2(np.sqrt(x * x + y * y + z * z), a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@numba.njit(cache=True, nogil=True)
def _midpoint(rays, centres, a, b):
    """Point halfway between two rays where they come closest; False if parallel or behind."""
    u, v = rays[a], rays[b]
    w = centres[b] - centres[a]
    c = u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
    denominator = 1 - c * c
    if denominator < 1e-10:
        return centres[a], False
    uw = u[0] * w[0] + u[1] * w[1] + u[2] * w[2]
    vw = v[0] * w[0] + v[1] * w[1] + v[2] * w[2]
    s, t = (uw - c * vw) / denominator, (c * uw - vw) / denominator
    return 0.5 * (centres[a] + s * u + centres[b] + t * v), s > 0 and t > 0


@numba.njit(cache=True, nogil=True)
def _gauss_newton_step(rays, centres, sigmas, lo, hi, point, gate):
    """One step on the sines of the angles of the observations within the gate."""
    hessian, gradient = np.zeros((3, 3)), np.zeros(3)
    for o in range(lo, hi):
        offset = point - centres[o]
        distance = np.sqrt(offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2)
        if distance < 1e-12 or _angle(rays[o], offset) / sigmas[o] >= gate:
            continue
        weight = 1 / (sigmas[o] * distance) ** 2
        along = rays[o][0] * offset[0] + rays[o][1] * offset[1] + rays[o][2] * offset[2]
        for r in range(3):
            gradient[r] += weight * (offset[r] - along * rays[o][r])
            for c in range(3):
                hessian[r, c] += weight * ((1.0 if r == c else 0.0) - rays[o][r] * rays[o][c])
    for r in range(3):
        hessian[r, r] *= 1 + 1e-9
    if abs(np.linalg.det(hessian)) < 1e-300:
        return point
    return point - np.linalg.solve(hessian, gradient)
