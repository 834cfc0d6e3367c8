"""Sub-pixel observations: the patch around each point, aligned to every frame that shows it."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from factors import tangent_basis
from factors.patches import ALIGNED, REASONS, PatchSet, Sightings, expect, found_at
from factors.sphere_field import SphereField
from factors.threads import map_in_threads, rows_in_threads
from gsba.bundle.tracks import tied_steps
from gsba.camera.cameras import ONE_CAMERA, Cameras
from gsba.camera.rig import CubeRig
from gsba.frames import panorama
from gsba.geometry import standing_places
from gsba.memory import release_mapped_files, total_memory_bytes
from gsba.photometric import frame_jobs
from gsba.photometric.frame_jobs import MAX_SHIFT_PX
from gsba.photometric.packing import Observed, PointsInFrames, pack
from gsba.photometric.patches import SLOPE_SIGMA
from gsba.photometric.references import references, visible_frames
from gsba.store.shards import Workers
from gsba.types import Counts, Keypoints, Landmarks, Sighted, Solution
from gsba.types.records import slices

_MIN_TRACK_LENGTH = 3  # of a point that is aligned in frames without an observation of it, too
_TOO_UNCERTAIN = "position too uncertain"
_PATCH_BYTES = 12288  # of a point's patch and its sightings, about
_SIGHTINGS_AT_ONCE = 1 << 15  # sightings that a thread processes together: some 20 MB
_MEMORY_SHARE = 64  # of the machine's memory, which the patches of one part take at most
_POINTS_AT_ONCE = 1 << 15  # whose former observations a thread looks for together
_PLACE_BITS = 10  # of a coordinate by which frames are put in order: cells of a 1024th of the map
_MIN_SIGMA_PX = 0.03  # pixels, noise of the best patches: sampling, and a plane as the surface
_BLUR_ERROR = 0.0105  # template pixels, error of a shift per unit (template pixel squared) by which
# pixels of two pictures cover a surface differently: benchmarks/results/limit.md

REJECTIONS = (*REASONS.values(), _TOO_UNCERTAIN)  # reasons why alignments are dropped

_STRAIGHT = SphereField.none()


@dataclass(frozen=True, slots=True)
class _Planes:
    """Plane patches around points, in their hosts."""

    origins: np.ndarray  # (J, 3) unit bearings
    spreads: np.ndarray  # (J, 3, 2) steps across them, radians
    slopes: np.ndarray  # (J, 2) relative depth that a step adds; 0 = the patch faces its host
    tilted: np.ndarray  # (J, 3, 2) steps on the surface, at unit distance, rig frame of the host
    axes_world: np.ndarray  # (J, 3, 2) those steps at the point, map units
    rays_world: np.ndarray  # (J, 3) from the host to the point, map units


@dataclass(frozen=True, slots=True)
class AlignedObservations:
    """Observations of a map's points, and what earlier alignments have shown of them."""

    keypoints: Keypoints  # as pictures show them
    patch_size: int  # panorama pixels across the patches around them, odd
    aligned: np.ndarray | None = None  # (N,) bool, keypoints confirmed by patches; None = none
    normals_rig: np.ndarray | None = None  # (N, 3) of the surfaces that they show, as in `Sighted`;
    # None = unknown
    field: SphereField = _STRAIGHT  # errors of stitching: the map is corrected by it
    folder: Path | None = None  # on the disk that holds what is found; None = it is in memory


def align(
    solved: Solution,
    observed: AlignedObservations,
    greys: panorama.Greys,
    rig: CubeRig,
    workers: Workers,
    lenses: Cameras = ONE_CAMERA,
    name: str = "align",
) -> Sighted:
    """Observe every point again, in the frames that should show it.

    The patch around a point is cut from the middle frame of its views, facing it or tilted with the
    surface, where that is known; poses and depth project it into other frames, where shift, affine
    part, gain and offset are estimated. The affine parts determine the surfaces' normals.

    Args:
        lenses: lenses of the camera; the band where two pictures are blended is left out.

    Returns:
        Tracks of aligned observations, and of former ones where alignment failed.
    """
    landmarks, world_T_rigs = solved.landmarks, solved.world_T_rigs
    rows = references(landmarks, world_T_rigs)
    walked = tied_steps(landmarks.tracks, greys.num_frames)
    places = standing_places(world_T_rigs[:, :3, 3], walked)
    normals_world = np.zeros((len(rows), 3))
    dropped, num_found = dict.fromkeys(REJECTIONS, 0), 0

    def by_patches() -> Iterator[Observed]:
        nonlocal num_found
        for points in _by_hosts(landmarks.tracks.frames[rows], world_T_rigs[:, :3, 3]):
            chosen = np.zeros(len(rows), bool)
            chosen[points] = True
            some = replace(solved, landmarks=landmarks.of(chosen))
            given = places, observed, greys, workers, lenses, name, dropped
            found, at_hosts, normals_world[points] = _align_some(some, *given)
            num_found += len(found)
            yield found.of(points)
            yield at_hosts.of(points)
            release_mapped_files()

    folder, keypoints = observed.folder, observed.keypoints
    new = Observed.joined(by_patches(), folder)
    given = landmarks, keypoints, solved.noise, new, greys.num_frames, workers.num_threads
    former = Observed.joined(_former_observations(*given), folder)
    own = keypoints.starts[landmarks.tracks.frames[rows]] + landmarks.tracks.keypoints[rows]
    shown = PointsInFrames(keypoints.colors[own], normals_world, world_T_rigs)
    counts = Counts(num_found + sum(dropped.values()), num_found, "observations", dropped)
    return pack(new, former, shown, rig, counts, folder, workers.num_threads)


def _by_hosts(hosts: np.ndarray, positions: np.ndarray) -> Iterator[np.ndarray]:
    """Points (n,), ascending, held together: those of hosts (J,) near one another, read at once."""
    most = max(total_memory_bytes() // (_MEMORY_SHARE * _PATCH_BYTES), 1)
    # numbers of cells, similar for near ones (Morton, 1966)
    low, edge = positions.min(axis=0), float(np.ptp(positions, axis=0).max())
    last = (1 << _PLACE_BITS) - 1
    cells = ((positions - low) / max(edge, 1e-300) * last).astype(np.int64)
    numbers = np.zeros(len(positions), np.int64)
    for bit in range(_PLACE_BITS):
        for axis in range(3):
            numbers |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    order = np.argsort(numbers[hosts], kind="stable")
    for some in slices(len(order), most):
        yield np.sort(order[some])


def _align_some(
    solved: Solution,
    places: np.ndarray,
    observed: AlignedObservations,
    greys: panorama.Greys,
    workers: Workers,
    lenses: Cameras,
    name: str,
    dropped: dict[str, int],
) -> tuple[Observed, Observed, np.ndarray]:
    """Observations of a solution's points by their patches, in other frames and in their hosts, and
    normals (J, 3) of the surfaces, world, zero = unknown; rejections are added to `dropped`.
    `places` (F,) of the frames, see `standing_places`."""
    landmarks, world_T_rigs = solved.landmarks, solved.world_T_rigs
    keypoints, field = observed.keypoints, observed.field
    rows = references(landmarks, world_T_rigs)
    hosts = landmarks.tracks.frames[rows].astype(np.int64)
    own, pixel = keypoints.rows(landmarks.tracks)[rows], 2 * np.pi / greys.width
    normals = np.zeros((len(rows), 3))
    if observed.normals_rig is not None:
        normals = observed.normals_rig[own]
    planes = _planes(landmarks, world_T_rigs, hosts, normals, pixel, field, lenses)
    tracks = landmarks.tracks
    extended = np.bincount(tracks.points, minlength=tracks.num_points) >= _MIN_TRACK_LENGTH
    if observed.aligned is not None:
        extended[tracks.points[observed.aligned[keypoints.rows(tracks)]]] = True
    views = visible_frames(landmarks, world_T_rigs, rows, extended, places)
    map_, threads = (landmarks, planes, world_T_rigs), workers.num_threads
    points, seeing = views
    if lenses:  # outside the band where two pictures are blended
        at, _, _ = _projected_patches(*map_, *views, lenses, threads)
        clear = ~(lenses.blended(planes.origins, hosts)[points] | lenses.blended(at, seeing))
        points, seeing = points[clear], seeing[clear]
    at, across, rays = _projected_patches(*map_, points, seeing, lenses, threads)
    sightings = expect(points, field.observed(at), across)
    title, cut = f"{name}: templates", (planes.origins, planes.tilted, observed.patch_size)
    patches = frame_jobs.cut(title, greys, hosts, *cut, workers)
    frame_jobs.align(name, greys, seeing, patches, sightings, workers)
    enlarged = greys.enlargements()
    steps = np.linalg.norm(planes.spreads[:, :, 0], axis=1) / pixel
    kept, found = _accepted(patches, steps, sightings, seeing, pixel, dropped, threads)
    found = found.enlarged(np.maximum(enlarged[seeing[kept]], enlarged[hosts[found.points]]))
    # a template's place is exact by definition; its noise is shared by all its alignments
    templates = sightings.templates[kept]
    times = np.bincount(templates, minlength=len(hosts))
    sums = np.bincount(templates, sightings.variances[kept], len(hosts))
    used = np.flatnonzero(times)
    of_shifts = patches.shift_covariances(used, sums[used] / times[used])
    axes = tangent_basis(planes.origins[used]) @ planes.spreads[used]
    covariances = axes @ of_shifts @ np.swapaxes(axes, 1, 2)
    covariances += (_MIN_SIGMA_PX * pixel) ** 2 * np.eye(2)
    at_hosts = Observed(used, hosts[used], planes.origins[used], covariances)
    at_hosts = at_hosts.enlarged(enlarged[at_hosts.frames])
    shown = found.bearings_rig, rays[kept]
    seen = patches, sightings, kept, *shown
    normals_world = _normals_world(*seen, planes, world_T_rigs[hosts], threads)
    return found, at_hosts, normals_world


def _planes(
    landmarks: Landmarks,
    world_T_rigs: np.ndarray,
    hosts: np.ndarray,
    normals_rig: np.ndarray,
    pixel: float,
    field: SphereField,
    lenses: Cameras,
) -> _Planes:
    """Plane patches around points (J,), in their hosts; normals_rig (J, 3) zero = unknown."""
    world_T_hosts = world_T_rigs[hosts]
    offsets = landmarks.points_world - world_T_hosts[:, :3, 3]
    local = np.einsum("jba,jb->ja", world_T_hosts[:, :3, :3], offsets)
    if lenses:
        local = lenses.seeing(local, hosts)
    depths = np.linalg.norm(local, axis=1)
    origins = field.observed(local / np.maximum(depths, 1e-300)[:, None])
    spreads = pixel * np.swapaxes(tangent_basis(origins), 1, 2)
    spreads[normals_rig.any(axis=1)] *= 1.4  # pixels to a step of tilted patches; 1 of others
    slopes = slopes_of(normals_rig, origins, spreads)
    tilted = spreads + origins[:, :, None] * slopes[:, None, :]
    away = world_T_hosts[:, :3, :3] * depths[:, None, None]
    rays = np.einsum("jab,jb->ja", away, origins)
    return _Planes(origins, spreads, slopes, tilted, away @ tilted, rays)


def _projected_patches(
    landmarks: Landmarks,
    planes: _Planes,
    world_T_rigs: np.ndarray,
    points: np.ndarray,
    frames: np.ndarray,
    lenses: Cameras,
    num_threads: int,
) -> list[np.ndarray]:
    """Bearings (O, 3), axes (O, 3, 2) in frames (O,) at unit distance; rays (O, 3) from hosts."""

    def project(some: slice) -> tuple[np.ndarray, ...]:
        own, seeing = points[some], frames[some]
        rotations = world_T_rigs[seeing, :3, :3]
        away = landmarks.points_world[own] - world_T_rigs[seeing, :3, 3]
        origins = np.einsum("oba,ob->oa", rotations, away)
        if lenses:
            origins = lenses.seeing(origins, seeing)
        distances = np.maximum(np.linalg.norm(origins, axis=1), 1e-300)[:, None]
        across = np.einsum("oba,obc->oac", rotations, planes.axes_world[own])
        rays = np.einsum("oba,ob->oa", rotations, planes.rays_world[own])
        return origins / distances, across / distances[:, :, None], rays / distances

    return rows_in_threads(project, slices(len(points), _SIGHTINGS_AT_ONCE), num_threads)


def _accepted(
    patches: PatchSet,
    steps_px: np.ndarray,
    sightings: Sightings,
    seeing: np.ndarray,
    pixel: float,
    dropped: dict[str, int],
    num_threads: int,
) -> tuple[np.ndarray, Observed]:
    """Accepted rows (N,) of the sightings, as observations; rejections are added to `dropped`."""

    def accept(some: slice) -> tuple[np.ndarray, ...]:
        there = Sightings(*(array[some] for array in sightings))
        own = dict.fromkeys(dropped, 0)
        kept, bearings, covariances = accepted_rows(patches, steps_px, there, pixel, own)
        return some.start + kept, bearings, covariances, np.array([list(own.values())])

    some = slices(len(seeing), _SIGHTINGS_AT_ONCE)
    kept, bearings, covariances, rejected = rows_in_threads(accept, some, num_threads)
    for reason, number in zip(dropped, rejected.sum(axis=0).tolist(), strict=True):
        dropped[reason] += number
    found = Observed(sightings.templates[kept], seeing[kept], bearings, covariances)
    return kept, found


def accepted_rows(
    patches: PatchSet,
    steps_px: np.ndarray,
    sightings: Sightings,
    pixel: float,
    dropped: dict[str, int],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Accepted rows (N,) of the sightings, their bearings (N, 3) and covariances (N, 2, 2);
    rejections are added to `dropped`.

    Where pixels cover the surface unlike those of the template, blur is only modelled to first
    order: covariances grow by what was measured of such sightings.

    Args:
        steps_px: (T,) pixels of the host to a template's pixel.
        pixel: radians of a panorama's pixel.
    """
    bearings, by_shift = found_at(sightings)
    axes = tangent_basis(bearings) @ by_shift
    of_shifts = patches.shift_covariances(sightings.templates, sightings.variances)
    unlike = coverage_differences(axes, pixel, steps_px[sightings.templates])
    of_shifts += (_BLUR_ERROR * unlike[:, None, None]) ** 2 * np.eye(2)
    covariances = axes @ of_shifts @ np.swapaxes(axes, 1, 2)
    covariances += (_MIN_SIGMA_PX * pixel) ** 2 * np.eye(2)
    half = 0.5 * (covariances[:, 0, 0] - covariances[:, 1, 1])
    middle = 0.5 * (covariances[:, 0, 0] + covariances[:, 1, 1])
    worst = np.sqrt(middle + np.hypot(half, covariances[:, 0, 1]))
    shifts = np.linalg.norm(np.cross(sightings.origins, bearings), axis=1)
    tests = {reason: sightings.states != state for state, reason in REASONS.items()}
    aligned = sightings.states == ALIGNED
    tests["look different"] &= ~aligned | (sightings.scores > 0.75)
    tests["found too far off"] &= ~aligned | (shifts < MAX_SHIFT_PX * pixel)
    # pixels, along the least certain direction
    tests[_TOO_UNCERTAIN] = ~aligned | (worst < 0.5 * pixel)
    left = np.ones(len(bearings), bool)
    for reason, passed in tests.items():
        dropped[reason] += int(np.count_nonzero(left & ~passed))
        left &= passed
    kept = np.flatnonzero(left)
    return kept, bearings[kept], covariances[kept]


def coverage_differences(axes: np.ndarray, pixel: float, steps_px: np.ndarray) -> np.ndarray:
    """Differences (N,) of what a pixel covers of a surface in two frames, template pixels squared.

    Args:
        axes: (N, 2, 2) radians in the observing frame to a template's pixel.
        pixel: radians of a pixel of either frame.
        steps_px: (N,) pixels of the host to a template's pixel.
    """
    (a, b), (c, d) = np.moveaxis(axes, 0, 2) / pixel
    # covariances of what a pixel covers, in template pixels: the inverse of axes' products
    scale = np.maximum((a * d - b * c) ** 2, 1e-12)
    xx, xy, yy = (b * b + d * d) / scale, (a * b + c * d) / scale, (a * a + c * c) / scale
    own = steps_px**-2.0
    return np.sqrt((xx - own) ** 2 + (yy - own) ** 2 + 2 * xy**2)


def _normals_world(
    patches: PatchSet,
    sightings: Sightings,
    kept: np.ndarray,
    bearings: np.ndarray,
    rays: np.ndarray,
    planes: _Planes,
    world_T_hosts: np.ndarray,
    num_threads: int,
) -> np.ndarray:
    """Normals (J, 3) of surfaces by alignments of `kept` (N,) sightings, zero = unknown."""
    posteriors, informations = patches.affine_informations()

    def shown(some: slice) -> tuple[np.ndarray, ...]:
        rows = kept[some]
        templates = sightings.templates[rows]
        found = sightings.warps[rows], sightings.variances[rows]
        known = posteriors[templates], informations[templates]
        shifts = depth_shifts(sightings.spreads[rows], bearings[some], rays[some])
        return shown_slopes(shifts, *found, *known)

    some = slices(len(kept), _SIGHTINGS_AT_ONCE)
    weights, pulls = rows_in_threads(shown, some, num_threads)
    laid = planes.slopes, planes.origins, planes.spreads
    normals = surface_normals(sightings.templates[kept], weights, pulls, *laid)
    return np.einsum("jab,jb->ja", world_T_hosts[:, :3, :3], normals)


def _former_observations(
    landmarks: Landmarks,
    keypoints: Keypoints,
    noise: float,
    found: Observed,
    num_frames: int,
    num_threads: int,
) -> Iterator[Observed]:
    """Former observations where alignment failed; of points without a patch in weak frames."""
    tracks = landmarks.tracks
    wanted = np.zeros(tracks.num_points, bool)
    wanted[found.points] = True
    # from here on, points without aligned patches are dropped
    scarce = np.bincount(found.frames, minlength=num_frames) < 100
    wanted[tracks.points[scarce[tracks.frames]]] = True
    parts = list(slices(tracks.num_points, _POINTS_AT_ONCE))

    def left(n: int) -> Observed:
        some = parts[n]
        bounds = np.searchsorted(tracks.points, [some.start, some.stop])
        points, frames = (array[slice(*bounds)] for array in (tracks.points, tracks.frames))
        there = np.flatnonzero((found.points >= some.start) & (found.points < some.stop))
        known = found.points[there].astype(np.int64) * num_frames + found.frames[there]
        cells = points.astype(np.int64) * num_frames + frames
        chosen = np.flatnonzero(wanted[points] & ~np.isin(cells, known, kind="sort"))
        rows = keypoints.starts[frames[chosen]] + tracks.keypoints[bounds[0] + chosen]
        covariances = keypoints.sigmas_rad[rows, None, None] ** 2 * np.eye(2)
        if keypoints.sqrt_infos is not None:
            roots = keypoints.sqrt_infos[rows]
            covariances = np.linalg.inv(np.swapaxes(roots, 1, 2) @ roots)
        of = points[chosen], frames[chosen]
        return Observed(*of, keypoints.bearings_rig[rows], noise**2 * covariances)

    for one in map_in_threads(left, len(parts), num_threads):
        yield one
        release_mapped_files()


_AFFINE_SIGMA = 0.03  # of an alignment's affine part, by surfaces that are no planes
_MAX_TILT_TANGENT = 3.0  # tangent of a tilt beyond which a patch covers too little of its surface


def slopes_of(normals_rig: np.ndarray, origins: np.ndarray, spreads: np.ndarray) -> np.ndarray:
    """Relative depth (J, 2) that a step across each patch adds on its surface, 0 = unknown, of
    normals (J, 3) of any length, rig frame of the host, zero = unknown; origins: (J, 3) unit
    bearings of the points; spreads: (J, 3, 2) steps across them, radians."""
    facing = np.einsum("ji,ji->j", normals_rig, origins)
    across = np.einsum("ji,jic->jc", normals_rig, spreads)
    known = facing > 0
    slopes = -across / np.where(known, facing, 1.0)[:, None]
    steps = np.linalg.norm(spreads[:, :, 0], axis=1)
    steepness = np.linalg.norm(slopes, axis=1) / np.maximum(steps, 1e-300)
    slopes *= np.minimum(1.0, _MAX_TILT_TANGENT / np.maximum(steepness, _MAX_TILT_TANGENT))[:, None]
    return np.where(known[:, None], slopes, 0.0)


def depth_shifts(spreads: np.ndarray, bearings: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Shifts (N, 2) in template steps by which relative depth along the host's ray appears in each
    aligned sighting.

    Args:
        spreads: (N, 3, 2) of the sightings, see `factors.patches.Sightings`.
        bearings: (N, 3) where they were found, rig frame of the observing frame.
        rays: (N, 3) from the host to the template's point, in the observing frame, in units of its
            distance there.
    """
    axes = tangent_basis(bearings)
    (a, b), (c, d) = np.moveaxis(axes @ spreads, 0, 2)
    x, y = np.moveaxis(axes @ rays[:, :, None], 0, 2)[:, 0]
    return np.stack([d * x - b * y, a * y - c * x], axis=1) / (a * d - b * c)[:, None]


def shown_slopes(
    shifts: np.ndarray,
    warps: np.ndarray,
    variances: np.ndarray,
    posteriors: np.ndarray,
    informations: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Information (N, 2, 2) of sightings on the slopes of their surfaces, and its product (N, 2)
    with the slopes, relative depth a template step, added to those of the projection.

    A slope (k_x, k_y) adds the affine part shift (k_x, k_y). Estimates of affine parts are drawn to
    zero by their prior; information with it times the estimate is information without it times the
    estimate that texture alone would give.

    Args:
        shifts: (N, 2), see `depth_shifts`.
        warps (N, 6), variances (N,): of the sightings, see `factors.patches.Sightings`.
        posteriors, informations: (N, 4, 4), see `PatchSet.affine_informations`.
    """
    rounding = 1 / 12  # variance of grey values that are whole numbers
    noise = (variances + rounding)[:, None, None] * np.eye(4) + _AFFINE_SIGMA**2 * informations
    by_slope = np.zeros((len(shifts), 4, 2))  # the affine part's Jacobian
    by_slope[:, :2, 0] = by_slope[:, 2:, 1] = shifts
    known = np.concatenate([informations @ by_slope, posteriors @ warps[:, 2:, None]], axis=2)
    found = np.swapaxes(by_slope, 1, 2) @ np.linalg.solve(noise, known)
    return found[:, :, :2], found[:, :, 2]


def surface_normals(
    templates: np.ndarray,
    weights: np.ndarray,
    pulls: np.ndarray,
    slopes: np.ndarray,
    origins: np.ndarray,
    spreads: np.ndarray,
) -> np.ndarray:
    """Normals (J, 3) of the surfaces, of any length, rig frames of the hosts, from their patches'
    alignments; zero where they are undetermined.

    Args:
        templates: (N,) template of each accepted sighting.
        weights (N, 2, 2), pulls (N, 2): see `shown_slopes`.
        slopes (J, 2), origins (J, 3), spreads (J, 3, 2): by which patches were projected, and
            the patches in their hosts, before slopes.
    """
    num = len(slopes)
    columns = np.column_stack([weights.reshape(-1, 4), pulls]).T
    sums = np.stack([np.bincount(templates, column, num) for column in columns], axis=1)
    weight, pull = sums[:, :4].reshape(-1, 2, 2), sums[:, 4:]
    sizes = np.linalg.norm(spreads[:, :, 0], axis=1)
    prior = 1 / (SLOPE_SIGMA * np.maximum(sizes, 1e-300)) ** 2
    determined = np.trace(weight, axis1=1, axis2=2) > 2 * prior
    weight = weight + prior[:, None, None] * np.eye(2)
    found = slopes + np.linalg.solve(weight, (pull - prior[:, None] * slopes)[:, :, None])[:, :, 0]
    gradients = np.einsum("jic,jc->ji", spreads, found) / sizes[:, None] ** 2
    return np.where(determined[:, None], origins - gradients, 0.0)
