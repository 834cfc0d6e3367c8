"""The back end of a run: from matches to poses and points, and their refinement by pixels."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from gsba.bundle import (
    adjustment,
    common_errors,
    gauge,
    map_strength,
    residual_correlation,
    rotation_only,
    tracks,
)
from gsba.bundle.camera_adjustment import CameraCovariances
from gsba.bundle.gauge import Gauge
from gsba.bundle.gps_factors import GpsFactors
from gsba.bundle.lens_centres import baseline_of
from gsba.bundle.map_strength import MapStrength
from gsba.bundle.reconstruction import MIN_OBSERVATIONS, assemble, world_scale
from gsba.camera.views import Optics, scenes_around
from gsba.imu.alignment import up_axis
from gsba.log import event
from gsba.loop_closure import connectivity, map_merging
from gsba.loop_closure.merged_map import Registered, follow
from gsba.matching import correspondences
from gsba.photometric import direct
from gsba.photometric.direct import PhotometricResult
from gsba.pipeline.acceptance import NoPositions
from gsba.pipeline.stage_titles import WITHOUT_GPS
from gsba.pipeline.state import MapMatches, State
from gsba.placement.placement import metres_per_unit
from gsba.splat import refinement
from gsba.splat.refinement import SplatResult
from gsba.store.store import digest
from gsba.trajectory import judgement, steps
from gsba.types import PoseSource, PoseStatus, Reconstruction, Solution, Tracks

logger = logging.getLogger(__name__)

# Fixes bend a map by this many times the square that their noise and that of the images explain. In
# simulations with right claims the ratio is at most .25, and images err by twice their claims.
MAX_CONTRADICTION = 4.0
_MIN_BRIDGING = 12  # points of three frames, without which the scale is open: in rendered tours up
# to 8 left it wrong by a fifth, 16 and more right


def adjust(state: State, name: str, gates: Sequence[float], *, final: bool = False) -> State:
    """Bundle adjustment in rounds over the state's tracks; `gates` in sigmas of a residual."""
    run, keypoints = state.run, state.observed.keypoints

    def compute() -> Solution:
        found, context = tracks_of(state), state.adjustment_context()
        return adjustment.adjust(found, keypoints, state.solution, context, gates, final)

    key = [run.solving_key(), gates, final]
    solution = run.stage(name, key, compute, Solution)
    event("map", name=name, observations=len(solution.landmarks.tracks))
    return state.with_solution(solution)


def align_gauge(state: State, name: str) -> State:
    """Trajectory and solution carried to the scale and world that families know; else as they are.

    Points of the solution are left out then.
    """
    run, prior, solution = state.run, state.prior, state.solution
    if not run.families.fixing_gauge.members:
        return state

    compute = partial(gauge.align, run.families, solution, prior.parts)
    found = run.stage(name, run.families.digests(), compute, Gauge, noted=False)
    carried = replace(state, prior=prior.moved(found))
    return carried.with_solution(found.moved(solution, prior.parts))


def place_points(state: State, name: str) -> State:
    """Points of the matches of neighbours, under poses as they are."""
    run, solution = state.run, state.solution

    def compute() -> Solution:
        neighbours = replace(state, matches=MapMatches(state.matches.neighbours))
        gate = run.settings.rounds.dense[-1] * solution.noise
        found, keypoints = tracks_of(neighbours), state.observed.keypoints
        placed = state.triangulated(found, keypoints, gate)
        return replace(solution, landmarks=placed)

    key = [run.solving_key()]
    return state.with_solution(run.stage(name, key, compute, Solution, noted=False))


def tracks_of(state: State) -> Tracks:
    """Tracks that matches make, within parts that nothing ties together yet."""
    keypoints, parts = state.observed.keypoints, state.prior.parts
    every = [*([] if state.places is None else [state.places]), *state.matches.sets()]
    tied = [connectivity.within(matches, parts) for matches in every]
    found = tracks.build(tied, np.diff(keypoints.starts), state.run.store.scratch_folder)
    return state.observed.cameras.clear(found, keypoints, state.run.num_threads)


def separate_parts(state: State) -> np.ndarray | None:
    """Parts (F,) of the map that no step ties together; None = it is in one piece.

    Without a trajectory, steps also part where too few points see both, as the scale is open there,
    and where they are walked at an unusual pace over missing frames.

    Raises:
        NoPositions: there is no map at all, so that nothing could be registered against it.
    """
    solution, near = state.solution, state.verified
    if not len(solution.landmarks.points_world):
        raise NoPositions(
            "no scene point is seen from enough frames, with enough parallax: frames must "
            "follow one another closely"
        )
    scarce = solution.observations() < MIN_OBSERVATIONS
    nothing = np.zeros_like(state.prior.trust.held_steps)
    unguided = state.prior.unguided
    if unguided.any():  # nothing but points hands the scale on
        matches = steps.matches_of_steps(near, len(scarce))
        loose = unguided & (
            connectivity.bridging(solution.landmarks.tracks, len(scarce)) < _MIN_BRIDGING
        )
        loose[1:-1] &= (matches[:-1] > 0) & (matches[1:] > 0)
        loose[[0, -1]] = False
        open_at = set(np.flatnonzero(loose).tolist())
        near = steps.without_steps(near, steps.given_up(open_at, matches))
        near = steps.without_steps(near, set(np.flatnonzero(_doubtful_steps(state)).tolist()))
    return connectivity.parted(near.matches.pairs, nothing, scarce)


def _doubtful_steps(state: State) -> np.ndarray:
    """Unguided steps (F - 1,) bool of an unusual pace over missing frames, or long, to and fro;
    none of a tour, whose steps three frames confirm."""
    frames, unguided, solution = state.run.frames, state.prior.unguided, state.solution
    if state.places is not None:
        return np.zeros(len(frames) - 1, bool)
    times, poses = (frames.timestamps, frames.recording_of_frame), solution.world_T_rigs
    found = judgement.unusual_paces(poses, *times)
    shown = ~(state.prior.trust.unseen_steps | judgement.over_missing_frames(*times))
    found |= judgement.back_and_forth(poses, shown, solution.median_depth())
    return found & unguided[1:] & unguided[:-1]


def merge_maps(state: State, parts: np.ndarray) -> State:
    """Parts (F,) of the map joined where they meet, frames in none of them registered. Raises
    NoPositions: without a trajectory, no three frames are in one part."""
    run, prior, trust, solution = state.run, state.prior, state.prior.trust, state.solution

    def compute() -> Registered:
        held, shown = trust.held_steps, ~(trust.unseen_steps | _doubtful_steps(state))
        open_scale = prior.unguided[1:] & prior.unguided[:-1]
        if open_scale.any():  # images show a step between parts, but not how long it is
            fed = solution.observations() >= MIN_OBSERVATIONS
            shown &= ~((parts[1:] != parts[:-1]) & fed[1:] & fed[:-1] & open_scale)
        context, times = state.observed.context, run.frames.timestamps
        # No trajectory relates recordings: their maps are as free as those of images alone.
        alone = prior.absent or bool(run.evidence.recordings)
        owners = run.frames.recording_of_frame
        return map_merging.merge(context, solution, parts, held, shown, times, alone, owners)

    merged = run.stage("registered", run.matching_key(), compute, Registered)
    sizes = np.unique(merged.components, return_counts=True)[1]
    if prior.absent and sizes.max() < connectivity.MIN_MAP_FRAMES:
        doubtful, num = np.count_nonzero(_doubtful_steps(state)), len(parts) - 1
        cause = (
            f"{doubtful} of {num} steps lead to and fro, or are of an unusual length, as those of "
            "stills in no order and of look-alikes are: name stills in the order of the way, or"
        )
        cause = cause if doubtful else "few points are seen from both sides of a step:"
        raise NoPositions(f"no three frames make a map: {cause} give frames closer together")
    coarse, followed, joints = follow(merged, prior.coarse, trust, prior.joints)
    apart = connectivity.several(merged.components)
    prior = replace(prior, merged=merged, parts=apart, coarse=coarse, trust=followed, joints=joints)
    return replace(state, prior=prior).with_solution(merged.solved)


def measure_strength(state: State) -> State:
    """Measure the map by images alone: well-determined steps lose their prior, others get noise."""
    run, prior, solution = state.run, state.prior, state.solution
    limits, trust = run.settings.weak_frames, prior.trust

    def compute() -> MapStrength:
        context = state.context_of_images(run.settings.priors.faint())
        errors = adjustment.pose_covariances(
            solution, state.observed.keypoints, context, prior.parts
        )
        strength = map_strength.measure(
            solution.world_T_rigs,
            errors,
            prior.coarse.world_T_rigs,
            ~trust.unseen_steps,
            ~trust.false_steps,
            run.settings,
            prior.parts,
            run.frames.recording_of_frame,
        )
        snapshot = run.families.snapshot(solution, prior.parts)
        fixes = [one for one in run.families.members if isinstance(one, GpsFactors)]
        bent = [one.contradiction(snapshot, errors[1].draws) for one in fixes]
        return replace(strength, contradiction=max(bent, default=0.0))

    strength = run.stage("strength", [run.solving_key(), limits], compute, MapStrength)
    return replace(state, prior=replace(prior, strength=strength))


def without_fixes(state: State, latest: Sequence[str]) -> State:
    """The state without GPS fixes, which its images contradict, after the stages `latest`."""
    logger.warning("the images contradict the GPS fixes: the map is made anew without these")
    run = state.run
    members = [
        replace(one, contradicted=True) if isinstance(one, GpsFactors) else one
        for one in run.families.members
    ]
    families, names = run.families.with_members(members), list(latest)
    return replace(state, run=replace(run, latest=names, families=families, suffix=WITHOUT_GPS))


def refine_photometric(state: State) -> State:
    """Joint refinement by the observations so far and the grey values of patches."""
    run, map_, solution = state.run, state.map, state.solution
    key = [run.solving_key()]

    def compute() -> PhotometricResult:
        frames, keypoints = map_.straightened(run.frames), map_.keypoints(run.rig)
        cameras, context = map_.lenses.cut_anew(), state.adjustment_context()
        return direct.refine(frames, keypoints, solution, context, cameras)

    found = run.stage("photometric", key, compute, PhotometricResult)
    map_ = replace(map_, solution=found.adjustment, frame_weights=found.frame_weights)
    return replace(state, map=map_)


def refine_on_splat(state: State) -> State:
    """Joint refinement by the observations so far, patches, and a splat of the frames."""
    run, map_, solution, settings = state.run, state.map, state.solution, state.run.settings
    key = [run.solving_key(), settings.splat, settings.factors]
    turns = run.store.root / "stages/splat/turns.npz"

    def compute() -> SplatResult:
        frames, start = map_.straightened(run.frames), digest(key, solution.world_T_rigs.tolist())
        cameras = map_.lenses.cut_anew()
        weights = map_.frame_weights
        patches = direct.joint(frames, solution, weights, settings, run.num_threads, cameras)
        places, seen = solution.landmarks.points_world, solution.landmarks.tracks
        around = scenes_around(solution.world_T_rigs, places, seen.points, seen.frames)
        return refinement.refine(
            frames,
            map_.keypoints(run.rig),
            solution,
            state.adjustment_context().beside(*patches),
            turns,
            start,
            Optics(cameras.only, around),
        )

    found = run.stage("splat", key, compute, SplatResult)
    turns.unlink(missing_ok=True)
    return replace(state, map=replace(map_, solution=found.adjustment, moves=found.moves))


def reconstruct(
    state: State, amended: Callable[[Reconstruction], Reconstruction] | None = None
) -> Reconstruction:
    """Covariances, and everything back in the trajectory's world; of a turn, rotations alone.
    `amended` gives the result with what else is known of it; None = as it is."""
    run, prior, map_, solution = state.run, state.prior, state.map, state.solution
    if prior.turning_only:
        return _reconstruct_rotations(state)

    def compute() -> Reconstruction:
        observed, frames = map_.keypoints(run.rig), map_.straightened(run.frames)
        context = state.adjustment_context()
        if map_.covariances is None:
            poses = adjustment.pose_covariances(solution, observed, context, prior.parts)
            ratio = residual_correlation.variance_ratio(solution, observed, context)
            measured = CameraCovariances(*poses, ()).grown(ratio)
        else:
            measured = map_.covariances
        covariances, joint = common_errors.added(
            measured.poses, measured.joint, solution.world_T_rigs, prior.parts
        )
        between = PoseSource.INTERPOLATED, PoseSource.EXTRAPOLATED
        guessed = np.isin(prior.coarse.sources, between)
        guessed &= solution.observations() < MIN_OBSERVATIONS
        if guessed.any():  # a trajectory's noise does not tell how far these are off
            factors = np.where(guessed, np.nan, 1.0)[:, None] * np.ones(6)
            covariances, joint = covariances * factors[:, :, None], joint.scaled(factors)
        worlds = None if run.families.fixing_gauge.members else prior.worlds()
        result = assemble(
            solution,
            covariances,
            observed,
            worlds,
            MIN_OBSERVATIONS,
            prior.trust.false_frames,
            prior.parts,
            joint,
            run.store.scratch_folder,
            prior.trust.false_steps,
        )
        result = replace(
            result,
            formats=frames.formats,
            vertical=_vertical(state, result),
            lens_baseline=_baseline(state, world_scale(solution, result)),
            origin=worlds and worlds.origin,
        )
        return result if amended is None else amended(result)

    several = (*run.camera_settings, run.settings.camera) if run.camera_settings else ()
    published = [camera.baseline() for camera in several]  # see `_baseline`
    return run.stage("reconstruction", [*run.solving_key(), *published], compute, Reconstruction)


def _baseline(state: State, scale: float) -> tuple[float, float] | None:
    """Distance of the lenses that settings name and its sigma, by the cameras whose lenses were
    found; None = none has two.

    Published distances of other cameras say the same of the map's scale (units per map unit): they
    are averaged; where they contradict one another, sigma grows as they scatter. It is infinite
    where only lenses of unknown distance were found, not those that settings name.
    """
    run, found = state.run, list[tuple[tuple[float, float], tuple[float, float] | None]]()
    for number, camera in enumerate(state.map.cameras):
        if camera.centres is not None and camera.lenses:
            published = run.settings_of(number).baseline()
            found.append((baseline_of(camera.centres, scale), published))
    if not found:
        return None
    known = [(own, published) for own, published in found if published is not None]
    named = run.settings.camera.baseline()
    if not known:
        return found[0][0] if named is None else (found[0][0][0], float("inf"))
    length, _ = named or known[0][1]
    if len(known) == 1:
        (own, sigma), (published, _) = known[0]
        return own * (length / published), sigma * (length / published)
    metres = np.array([metres_per_unit(own, published) for own, published in known])
    weights = metres[:, 1] ** -2.0
    mean = float(weights @ metres[:, 0] / weights.sum())
    length /= mean
    misfit = float(weights @ (metres[:, 0] - mean) ** 2) / (len(known) - 1)
    return length, length * float((max(misfit, 1.0) / weights.sum()) ** 0.5) / mean


def _vertical(state: State, result: Reconstruction) -> np.ndarray | None:
    """The vertical in the world of a result, by an accelerometer that rode along."""
    readings, gyro = state.run.evidence.imu, state.prior.gyro
    if readings is None or gyro is None or gyro.reason:
        return None
    good = result.pose_statuses == PoseStatus.REFINED
    if result.components is not None:  # each map has a world of its own
        good &= result.components == 0
    rotations = result.world_T_rigs[good, :3, :3]
    return up_axis(readings, gyro, state.run.frames.timestamps[good], rotations)


def _reconstruct_rotations(state: State) -> Reconstruction:
    run, prior, observed = state.run, state.prior, state.observed
    least, poses = MIN_OBSERVATIONS, prior.start().world_T_rigs
    turn = prior.trust.turn
    assert turn is not None
    lonely = ~turn.frames  # are parts of their own, behind all others
    parts = np.where(lonely, np.cumsum(lonely), 0) if lonely.any() else None

    def compute() -> Reconstruction:
        matches = correspondences.match_for_rotations(observed.context, poses)
        tied = connectivity.within(matches, parts)
        found = tracks.build([tied], np.diff(observed.keypoints.starts))
        result = rotation_only.refine(found, observed.keypoints, poses, prior.coarse, least, parts)
        another = result.components is not None and result.components[0] != 0  # than the first's
        return replace(result, origin=None if another else run.coarse.origin)

    key = [run.matching_key(), least]
    return run.stage("reconstruction", key, compute, Reconstruction)
