"""Scene points from bearings and poses, robust to false observations in a track."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from factors.threads import balanced_ranges, run_in_threads
from gsba.bundle._triangulation_kernels import cast_rays, triangulate_tracks
from gsba.bundle.tracks import map_runs
from gsba.config import TriangulateSettings
from gsba.disk import concatenated
from gsba.geometry import moved_to
from gsba.memory import release_mapped_files
from gsba.types import Counts, Keypoints, Landmarks, Reconstruction, Tracks

_IN_MEMORY = 1 << 18  # observations of which the tracks are in memory in any case
_NONE = Counts(0, 0, "tracks")


def triangulate(
    tracks: Tracks,
    bearings_rig: np.ndarray,
    sigmas_rad: np.ndarray,
    world_T_rigs: np.ndarray,
    max_error_sigmas: float,
    settings: TriangulateSettings,
    num_threads: int = 1,
    origins_rig: np.ndarray | None = None,
) -> Landmarks:
    """Triangulate every track and drop what does not fit.

    A point is hypothesised from pairs of observations, scored by how many of its track's
    observations lie within the gate in front of their frame, and refined on those (weighted
    midpoint, then Gauss-Newton on tangent-plane residuals).

    Args:
        bearings_rig: (O, 3) bearings of the observations.
        sigmas_rad: (O,) their noise.
        world_T_rigs: (F, 4, 4) current poses.
        max_error_sigmas: gate on the angle between observation and point, in sigmas.
        origins_rig: (O, 3) rig frame, where each ray starts; None = the rig's centre.
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
    short = lengths < settings.min_track_length
    flat = ~short & (parallaxes < np.deg2rad(settings.min_parallax_deg))
    dropped = {"observations disagree": short, "parallax too small": flat}
    if origins_rig is not None:
        distances = np.linalg.norm(points[tracks.points] - centres, axis=1)
        near = (inliers > 0) & (distances < np.linalg.norm(origins_rig, axis=1))
        inside = np.bincount(tracks.points, near, len(points)) > 0
        dropped["within the camera"] = inside & ~short & ~flat
    kept = ~np.any(list(dropped.values()), axis=0)
    survivors = tracks.of_observations(kept[tracks.points] & (inliers > 0))
    numbers = {reason: int(flag.sum()) for reason, flag in dropped.items()}
    counts = Counts(tracks.num_points, survivors.num_points, "tracks", numbers)
    return Landmarks(points[kept], survivors, counts)


def place(
    tracks: Tracks,
    keypoints: Keypoints,
    world_T_rigs: np.ndarray,
    max_error_sigmas: float,
    settings: TriangulateSettings,
    num_threads: int = 1,
    scratch: Path | None = None,
) -> Landmarks:
    """As `triangulate`, the observations being the tracks' own keypoints; some tracks at a time.

    Args:
        scratch: folder on the disk that takes the points of very many tracks; None = they are in
            memory.
    """
    counts = [_NONE]

    def placed(_: slice, __: slice, some: Tracks) -> Landmarks:
        rows = keypoints.rows(some)
        rays = keypoints.bearings_rig.take(rows, axis=0), keypoints.sigmas_rad[rows]
        how = max_error_sigmas, settings, 1, keypoints.origins_of(rows)
        return triangulate(some, *rays, world_T_rigs, *how)

    def found() -> Iterator[tuple[np.ndarray, ...]]:
        none = tracks.of(np.zeros(tracks.num_points, bool))
        yield np.zeros((0, 3)), none.points, none.frames, none.keypoints
        num = 0
        for own in map_runs(placed, tracks, num_threads):
            counts.append(own.counts)
            numbers = own.tracks.points + np.int32(num)
            yield own.points_world, numbers, own.tracks.frames, own.tracks.keypoints
            num += own.tracks.num_points

    folder = scratch if len(tracks) > _IN_MEMORY else None
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
