"""Sub-pixel observations: the patch around each point, aligned to every frame that shows it."""

from dataclasses import dataclass

import numpy as np

from factors import tangent_basis
from factors.patches import ALIGNED, REASONS, PatchSet, Sightings, expect, found_at
from factors.sphere_field import SphereField
from gsba.camera.lens import ONE_CENTRE, Lenses
from gsba.camera.rig import CubeRig, owner_faces
from gsba.config import PatchSettings
from gsba.frames import panorama
from gsba.photometric import frame_jobs
from gsba.photometric.references import references, visible_frames
from gsba.store.shards import Workers
from gsba.types import Counts, Keypoints, Landmarks, Sighted, Tracks

_UNCERTAIN = "position too uncertain"
_AT_ONCE = 1 << 17  # sightings that are judged together: some 80 MB
_LEAST_SIGMA = 0.03  # pixels: what sampling and a plane for the surface cost the best of patches

_STRAIGHT = SphereField.none()


@dataclass(frozen=True, slots=True)
class _Observed:
    """Observations of points, in any order."""

    points: np.ndarray  # (N,) int64
    frames: np.ndarray  # (N,) int64
    bearings_rig: np.ndarray  # (N, 3) float64, unit
    covariances: np.ndarray  # (N, 2, 2) float64, radians squared, on tangent_basis


def align(
    landmarks: Landmarks,
    world_T_rigs: np.ndarray,
    keypoints: Keypoints,
    noise: float,
    greys: panorama.Greys,
    rig: CubeRig,
    name: str,
    aligned: np.ndarray | None,
    settings: PatchSettings,
    workers: Workers,
    field: SphereField = _STRAIGHT,
    lenses: Lenses = ONE_CENTRE,
) -> Sighted:
    """Observe every point anew, in the frames that should show it.

    The patch around a point is cut from the middle frame of its views, as a plane facing it; poses
    and depth carry it into others, where shift, affine part, gain and offset are found.

    Args:
        landmarks: points and their observations so far.
        world_T_rigs: (F, 4, 4) poses they were solved with.
        keypoints: of those observations.
        noise: of those, in units of their sigmas.
        greys: the frames' images.
        rig: faces that pixels are given on.
        name: beside the progress bar.
        aligned: (N,) bool, which of the keypoints patches have confirmed; None = none.
        settings: limits and sizes.
        workers: who work on frames.
        field: of the camera; keypoints are as observed, the map as corrected.
        lenses: that see the points; nothing is looked for where two pictures are blended.

    Returns:
        Tracks of aligned observations, and of former ones where a point was not aligned.
    """
    rows = references(landmarks, world_T_rigs)
    hosts = landmarks.tracks.frames[rows].astype(np.int64)
    extended = _extended(landmarks, keypoints, aligned, settings.min_track_length)
    origins, spreads, seeing, sightings = _expected(
        landmarks, world_T_rigs, rows, extended, greys.width, settings, field, lenses
    )
    title = f"{name}: templates"
    patches = frame_jobs.cut(title, greys, hosts, origins, spreads, settings, workers)
    frame_jobs.align(name, greys, seeing, patches, sightings, settings, workers)
    kept, found, dropped = _accepted(patches, sightings, seeing, 2 * np.pi / greys.width, settings)
    at_hosts = _at_hosts(patches, sightings, kept, hosts, origins, spreads)
    del patches, sightings, origins, spreads  # gigabytes, of thousands of frames
    former = _former(landmarks, keypoints, noise, [found, at_hosts], greys.num_frames)
    counts = Counts(len(seeing), len(found.points), "observations", dropped)
    colors = keypoints.colors[keypoints.rows(landmarks.tracks)[rows]]
    return _pack([found, at_hosts, former], colors, greys.num_frames, rig, counts)


def _expected(
    landmarks: Landmarks,
    world_T_rigs: np.ndarray,
    rows: np.ndarray,
    extended: np.ndarray,
    width: int,
    settings: PatchSettings,
    field: SphereField,
    lenses: Lenses,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Sightings]:
    """Patches (directions (J, 3) and axes (J, 3, 2)) in their hosts, and where frames (R,) should
    show them."""
    hosts = landmarks.tracks.frames[rows].astype(np.int64)
    points, seeing = visible_frames(landmarks, world_T_rigs, rows, extended, settings)
    places = landmarks.points_world
    origins, spreads, planes = _patches(places, world_T_rigs[hosts], hosts, width, field, lenses)
    at, across = _carried(places[points], planes[points], world_T_rigs[seeing], seeing, lenses)
    if lenses:
        blended = lenses.blended(origins, hosts)[points] | lenses.blended(at, seeing)
        clear = ~blended
        points, seeing, at, across = points[clear], seeing[clear], at[clear], across[clear]
    return origins, spreads, seeing, expect(points, field.observed(at), across)


def _patches(
    points_world: np.ndarray,
    world_T_hosts: np.ndarray,
    hosts: np.ndarray,
    width: int,
    field: SphereField,
    lenses: Lenses,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Plane patches that face their hosts, one panorama pixel to a step.

    Returns:
        origins (J, 3), the points' unit bearings, as observed; spreads (J, 3, 2) across them;
        the same axes (J, 3, 2) at the points, in the world.
    """
    offsets = points_world - world_T_hosts[:, :3, 3]
    local = np.einsum("jba,jb->ja", world_T_hosts[:, :3, :3], offsets)
    if lenses:
        local = lenses.seeing(local, hosts)
    depths = np.linalg.norm(local, axis=1)
    origins = field.observed(local / np.maximum(depths, 1e-300)[:, None])
    spreads = 2 * np.pi / width * np.swapaxes(tangent_basis(origins), 1, 2)
    planes = world_T_hosts[:, :3, :3] @ spreads * depths[:, None, None]
    return origins, np.ascontiguousarray(spreads), planes


def _carried(
    points_world: np.ndarray,
    planes_world: np.ndarray,
    world_T_rigs: np.ndarray,
    frames: np.ndarray,
    lenses: Lenses,
) -> tuple[np.ndarray, np.ndarray]:
    """Plane patches (points (O, 3) and axes (O, 3, 2)) in their rigs' frames, at unit distance."""
    rotations = world_T_rigs[:, :3, :3]
    origins = np.einsum("oba,ob->oa", rotations, points_world - world_T_rigs[:, :3, 3])
    if lenses:
        origins = lenses.seeing(origins, frames)
    spreads = np.einsum("oba,obc->oac", rotations, planes_world)
    distances = np.maximum(np.linalg.norm(origins, axis=1), 1e-300)
    return origins / distances[:, None], spreads / distances[:, None, None]


def _accepted(
    patches: PatchSet,
    sightings: Sightings,
    seeing: np.ndarray,
    pixel: float,
    settings: PatchSettings,
) -> tuple[np.ndarray, _Observed, dict[str, int]]:
    """Rows (N,) of the sightings to believe, as observations, and why others fell."""
    parts, dropped = [], dict.fromkeys([*REASONS.values(), _UNCERTAIN], 0)
    for first in range(0, max(len(seeing), 1), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        there = Sightings(*(array[some] for array in sightings))
        kept, bearings, covariances = _believed(patches, there, pixel, settings, dropped)
        parts.append((first + kept, bearings, covariances))
    kept, bearings, covariances = (np.concatenate(column) for column in zip(*parts, strict=True))
    found = _Observed(sightings.templates[kept], seeing[kept], bearings, covariances)
    return kept, found, dropped


def _believed(
    patches: PatchSet,
    sightings: Sightings,
    pixel: float,
    settings: PatchSettings,
    dropped: dict[str, int],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows (N,) of the sightings to believe, their bearings (N, 3) and covariances (N, 2, 2); why
    others fell is added to what was dropped."""
    bearings, by_shift = found_at(sightings)
    axes = tangent_basis(bearings) @ by_shift
    of_shifts = patches.shift_covariances(sightings.templates, sightings.variances)
    covariances = axes @ of_shifts @ np.swapaxes(axes, 1, 2)
    covariances += (_LEAST_SIGMA * pixel) ** 2 * np.eye(2)
    worst = np.sqrt(np.maximum(np.linalg.eigvalsh(covariances)[:, 1], 0))
    shifts = np.linalg.norm(np.cross(sightings.origins, bearings), axis=1)
    tests = {reason: sightings.states != state for state, reason in REASONS.items()}
    aligned = sightings.states == ALIGNED
    tests["look different"] &= ~aligned | (sightings.scores > settings.min_zncc)
    tests["found too far off"] &= ~aligned | (shifts < settings.max_shift_px * pixel)
    tests[_UNCERTAIN] = ~aligned | (worst < settings.max_sigma_px * pixel)
    left = np.ones(len(bearings), bool)
    for reason, passed in tests.items():
        dropped[reason] += int(np.count_nonzero(left & ~passed))
        left &= passed
    kept = np.flatnonzero(left)
    return kept, bearings[kept], covariances[kept]


def _at_hosts(
    patches: PatchSet,
    sightings: Sightings,
    kept: np.ndarray,
    hosts: np.ndarray,
    origins: np.ndarray,
    spreads: np.ndarray,
) -> _Observed:
    """Observations of the templates found again, in the frames they are from.

    A template's place is exact by definition; its noise, which all its alignments share, is
    counted here, with the mean residual of those alignments.
    """
    templates = sightings.templates[kept]
    times = np.bincount(templates, minlength=len(hosts))
    sums = np.bincount(templates, sightings.variances[kept], len(hosts))
    used = np.flatnonzero(times)
    of_shifts = patches.shift_covariances(used, sums[used] / times[used])
    axes = tangent_basis(origins[used]) @ spreads[used]
    covariances = axes @ of_shifts @ np.swapaxes(axes, 1, 2)
    covariances += _LEAST_SIGMA**2 * np.einsum("oij,okj->oik", axes, axes)
    return _Observed(used, hosts[used], origins[used], covariances)


def _extended(
    landmarks: Landmarks, keypoints: Keypoints, aligned: np.ndarray | None, min_length: int
) -> np.ndarray:
    """Points (J,) that many observations or a patch confirm: worth looking for elsewhere."""
    tracks = landmarks.tracks
    out = np.bincount(tracks.points, minlength=tracks.num_points) >= min_length
    if aligned is not None:
        out[tracks.points[aligned[keypoints.rows(tracks)]]] = True
    return out


def _former(
    landmarks: Landmarks,
    keypoints: Keypoints,
    noise: float,
    found: list[_Observed],
    num_frames: int,
) -> _Observed:
    """The observations so far, where there are none now."""
    tracks = landmarks.tracks
    known = np.concatenate([part.points * num_frames + part.frames for part in found])
    cells = tracks.points.astype(np.int64) * num_frames + tracks.frames
    chosen = np.flatnonzero(~np.isin(cells, known))
    rows = keypoints.rows(tracks)[chosen]
    covariances = keypoints.sigmas_rad[rows, None, None] ** 2 * np.eye(2)
    if keypoints.sqrt_infos is not None:
        roots = keypoints.sqrt_infos[rows]
        covariances = np.linalg.inv(np.swapaxes(roots, 1, 2) @ roots)
    points, frames = tracks.points[chosen].astype(np.int64), tracks.frames[chosen].astype(np.int64)
    return _Observed(points, frames, keypoints.bearings_rig[rows], noise**2 * covariances)


def _pack(
    parts: list[_Observed], colors: np.ndarray, num_frames: int, rig: CubeRig, counts: Counts
) -> Sighted:
    """Observations, the last part being former ones, as keypoints frame by frame and as tracks.

    Points seen once are left out.
    """
    points, frames, bearings, covariances = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("points", "frames", "bearings_rig", "covariances")
    )
    seen = np.bincount(points, minlength=len(colors))
    order = np.lexsort((points, frames))
    order = order[seen[points[order]] > 1]
    is_new = order < len(points) - len(parts[-1].points)
    points, frames, bearings = points[order], frames[order], bearings[order]
    starts = np.searchsorted(frames, np.arange(num_frames + 1))
    faces = owner_faces(bearings)
    lower = np.linalg.cholesky(np.linalg.inv(covariances[order]))
    keypoints = Keypoints(
        starts,
        rig.project(bearings, faces),
        faces,
        bearings,
        np.linalg.det(covariances[order]) ** 0.25,
        colors[points],
        np.ascontiguousarray(np.swapaxes(lower, 1, 2)),
    )
    by_point = np.lexsort((frames, points))
    _, compact = np.unique(points[by_point], return_inverse=True)
    tracks = Tracks(
        compact.astype(np.int32),
        frames[by_point].astype(np.int32),
        (by_point - starts[frames[by_point]]).astype(np.int32),
        int(compact[-1]) + 1 if len(compact) else 0,
    )
    return Sighted(keypoints, is_new, tracks, counts)
