"""Scene points from bearings and poses, robust to false observations in a track."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from factors.compiled import kernel_and_part
from factors.threads import balanced_ranges, run_in_threads
from gsba.bundle.tracks import MAX_IN_MEMORY, map_runs, tied_steps
from gsba.disk import concatenated
from gsba.geometry import moved_to, standing_length
from gsba.memory import release_mapped_files
from gsba.types import Counts, Keypoints, Landmarks, Reconstruction, Tracks

_kernel, _part = kernel_and_part()


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
                if tried == 12 or best_count == hi - lo:  # pairs of observations
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


_MIN_TRACK_LENGTH = 2  # observations of a point: one ray has no depth


def triangulate(
    tracks: Tracks,
    bearings_rig: np.ndarray,
    sigmas_rad: np.ndarray,
    world_T_rigs: np.ndarray,
    max_error_sigmas: float,
    num_threads: int = 1,
    origins_rig: np.ndarray | None = None,
    min_parallax_deg: float = 0.5,
    standing: float | None = None,
) -> Landmarks:
    """Triangulate every track and drop what does not fit.

    A point is hypothesised from pairs of observations, scored by how many of its track's
    observations lie within the gate in front of their frame, and refined on those (weighted
    midpoint, then Gauss-Newton on tangent-plane residuals).

    Args:
        bearings_rig, sigmas_rad: (O, 3) bearings of the observations, and (O,) their noise.
        world_T_rigs: (F, 4, 4) current poses.
        max_error_sigmas: gate on the angle between observation and point, in sigmas.
        origins_rig: (O, 3) rig frame, where each ray starts; None = the rig's centre.
        min_parallax_deg: largest angle between two rays of a point, at least: the depth of a point
            with less is noise.
        standing: map units, how far the camera moves at most where it stands: the depth of a point
            nearer than that is noise, whatever its parallax; None = `standing_within` the tracks.
    """
    starts = np.searchsorted(tracks.points, np.arange(tracks.num_points + 1))
    rays, centres = np.empty((len(tracks), 3)), np.empty((len(tracks), 3))
    starting = np.zeros((0, 3)) if origins_rig is None else origins_rig
    bearings = np.asarray(bearings_rig, np.float64)
    given = np.ascontiguousarray(world_T_rigs), tracks.frames, bearings, starting
    points = np.zeros((tracks.num_points, 3))
    inliers = np.zeros(len(rays), np.int64)
    parallaxes = np.zeros(tracks.num_points)
    ranges = balanced_ranges(starts)

    def work(part: int) -> None:
        gate, (first, last) = float(max_error_sigmas), ranges[part]
        cast_rays(starts[first], starts[last], *given, rays, centres)
        triangulate_tracks(
            starts, first, last, rays, centres, sigmas_rad, gate, points, inliers, parallaxes
        )

    run_in_threads(work, len(ranges), num_threads)
    lengths = np.bincount(tracks.points[inliers > 0], minlength=tracks.num_points)
    short = lengths < _MIN_TRACK_LENGTH
    flat = ~short & (parallaxes < np.deg2rad(min_parallax_deg))
    standing = standing_within(tracks, world_T_rigs) if standing is None else standing
    least = np.full(len(rays), standing)
    if origins_rig is not None:
        least = np.maximum(least, np.linalg.norm(origins_rig, axis=1))
    near = (inliers > 0) & (np.linalg.norm(points[tracks.points] - centres, axis=1) < least)
    inside = np.bincount(tracks.points, near, len(points)) > 0
    dropped = {"observations disagree": short, "parallax too small": flat}
    dropped["too near"] = inside & ~short & ~flat
    kept = ~np.any(list(dropped.values()), axis=0)
    survivors = tracks.of_observations(kept[tracks.points] & (inliers > 0))
    numbers = {reason: int(flag.sum()) for reason, flag in dropped.items()}
    counts = Counts(tracks.num_points, survivors.num_points, "tracks", numbers)
    return Landmarks(points[kept], survivors, counts)


def standing_within(tracks: Tracks, world_T_rigs: np.ndarray) -> float:
    """`standing_length` of poses (F, 4, 4), by the steps over which tracks lead."""
    steps = np.linalg.norm(np.diff(world_T_rigs[:, :3, 3], axis=0), axis=1)
    return standing_length(steps[tied_steps(tracks, len(world_T_rigs))])


def place(
    tracks: Tracks,
    keypoints: Keypoints,
    world_T_rigs: np.ndarray,
    max_error_sigmas: float,
    num_threads: int = 1,
    scratch: Path | None = None,
) -> Landmarks:
    """As `triangulate`, the observations being the tracks' own keypoints; some tracks at a time. A
    folder on the disk takes the points of very many tracks; None = they are in memory."""
    counts, standing = list[Counts](), standing_within(tracks, world_T_rigs)

    def placed(_: slice, __: slice, some: Tracks) -> Landmarks:
        rows = keypoints.rows(some)
        rays = keypoints.bearings_rig.take(rows, axis=0), keypoints.sigmas_rad[rows]
        how = max_error_sigmas, 1, keypoints.origins_of(rows)
        return triangulate(some, *rays, world_T_rigs, *how, standing=standing)

    def found() -> Iterator[tuple[np.ndarray, ...]]:
        none = tracks.of(np.zeros(tracks.num_points, bool))
        yield np.zeros((0, 3)), none.points, none.frames, none.keypoints
        num = 0
        for own in map_runs(placed, tracks, num_threads):
            counts.append(own.counts)
            numbers = own.tracks.points + np.int32(num)
            yield own.points_world, numbers, own.tracks.frames, own.tracks.keypoints
            num += own.tracks.num_points

    folder = scratch if len(tracks) > MAX_IN_MEMORY else None
    points_world, points, frames, rows = concatenated(found(), folder)
    seen = Tracks(points, frames, rows, len(points_world))
    dropped: dict[str, int] = {}
    for part in counts:
        for reason, number in part.dropped.items():
            dropped[reason] = dropped.get(reason, 0) + number
    received, kept = sum(p.received for p in counts), sum(p.kept for p in counts)
    return Landmarks(points_world, seen, Counts(received, kept, "tracks", dropped))


def points_under(reconstruction: Reconstruction, world_T_rigs: np.ndarray) -> np.ndarray:
    """Points (J, 3) nearest to the rays of a reconstruction under other poses (F, 4, 4)."""
    placed = np.zeros((len(reconstruction.points_world), 3))
    for some in reconstruction.pieces():
        lenses = moved_to(world_T_rigs[some.observation_frames], some.observation_origins)
        rotations, centres = lenses[:, :3, :3], lenses[:, :3, 3]
        rays = np.einsum("oij,oj->oi", rotations, some.observation_bearings)
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :]  # off the ray
        points, which = np.unique(some.observation_points, return_inverse=True)
        normal, target = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        np.add.at(normal, which, across)
        np.add.at(target, which, np.einsum("oij,oj->oi", across, centres))
        normal += 1e-9 * np.eye(3)  # parallel rays leave the depth open
        placed[points] = np.linalg.solve(normal, target[..., None])[..., 0]
        release_mapped_files()
    return placed
