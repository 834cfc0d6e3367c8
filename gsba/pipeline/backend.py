"""The back end of a run: from matches to poses and points, and what refines these further."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from gsba.bundle import (
    adjustment,
    common_errors,
    gauge,
    lens_axes,
    lens_centres,
    map_strength,
    readout,
    rotation_only,
    self_calibration,
    stitching,
    tracks,
    triangulation,
)
from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.camera_adjustment import solve_with_camera
from gsba.bundle.camera_system import CameraCovariances, CameraSystem
from gsba.bundle.gauge import Gauge
from gsba.bundle.lens_axes import LensAxes
from gsba.bundle.lens_centres import LensCentres, StitchRadius, baseline_of
from gsba.bundle.map_strength import MapStrength
from gsba.bundle.readout import CameraEstimate
from gsba.bundle.reconstruction import assemble, world_scale
from gsba.bundle.self_calibration import SelfCalibration
from gsba.camera.lens import ONE_CENTRE, Lenses
from gsba.camera.optics import Optics
from gsba.camera.views import scenes_around
from gsba.imu.alignment import Alignment, align, turning_of
from gsba.imu.gravity import up_axis
from gsba.log import GsbaError
from gsba.loop_closure import connectivity, map_merging
from gsba.loop_closure.merged_map import Registered, follow
from gsba.matching import correspondences
from gsba.photometric import direct
from gsba.photometric.direct import PhotometricResult
from gsba.pipeline.frontend import ObservedFrames
from gsba.pipeline.map import Map
from gsba.pipeline.prior import Prior
from gsba.pipeline.run import Run
from gsba.splat import refinement
from gsba.splat.refinement import SplatResult
from gsba.store.store import digest
from gsba.trajectory import steps
from gsba.types import (
    Keypoints,
    Landmarks,
    Matches,
    PoseStatus,
    Reconstruction,
    Solution,
    Tracks,
    VerifiedPairs,
)

T = TypeVar("T")

_MIN_BRIDGING = 12  # points of three frames, without which the scale is open: in rendered tours up
# to 8 left it wrong by a fifth, 16 and more right
_WIDE = 30.0  # gate in standard deviations of observations that a wrong camera threw off


def adjust(
    run: Run,
    seen: ObservedFrames,
    prior: Prior,
    name: str,
    matches: Sequence[Matches],
    start: Solution,
    gates: Sequence[float],
    final: bool = False,
) -> Solution:
    """Bundle adjustment in rounds over the tracks that matches make."""

    def compute() -> Solution:
        found = _tracks(seen, prior, matches)
        problem = run.problem(prior, start)
        return adjustment.adjust(found, seen.keypoints, start, problem, gates, final)

    return run.stage(name, [run.solving_key(), gates, final], compute, Solution)


def align_gauge(run: Run, prior: Prior, solved: Solution, name: str) -> tuple[Prior, Solution]:
    """Trajectory and solution carried to the scale and world that families know; else as they are.

    Points of the solution are left out then.
    """
    if not run.families.fixing_gauge.members:
        return prior, solved

    def compute() -> Gauge:
        return gauge.align(run.families, solved, prior.parts)

    found = run.stage(name, run.families.digests(), compute, Gauge, noted=False)
    return prior.moved(found), found.moved(solved, prior.parts)


def place(
    run: Run,
    seen: ObservedFrames,
    prior: Prior,
    name: str,
    matches: Sequence[Matches],
    solved: Solution,
) -> Solution:
    """Points of these matches under poses as they are."""
    settings = run.settings

    def compute() -> Solution:
        placed = triangulation.place(
            _tracks(seen, prior, matches),
            seen.keypoints,
            solved.world_T_rigs,
            settings.rounds.dense[-1] * solved.noise,
            settings.triangulate,
            run.num_threads,
        )
        return replace(solved, landmarks=placed)

    return run.stage(name, [run.solving_key()], compute, Solution, noted=False)


def guess_axes(
    run: Run,
    seen: ObservedFrames,
    prior: Prior,
    name: str,
    matches: Sequence[Matches],
    solved: Solution,
) -> LensAxes:
    """Which way two lenses would look, from matches as they came."""

    def found(wide: Solution) -> LensAxes:
        problem = run.problem(prior, wide)
        return lens_axes.guess(wide.landmarks, seen.keypoints, wide, seen.lenses, problem)

    return _of_matches(run, seen, prior, name, matches, solved, found, LensAxes)


def self_calibrate_lenses(
    run: Run,
    seen: ObservedFrames,
    prior: Prior,
    name: str,
    matches: Sequence[Matches],
    solved: Solution,
) -> SelfCalibration:
    """What the lenses of raw pairs are, from matches that no solution has chosen among."""

    def found(wide: Solution) -> SelfCalibration:
        nominal = run.frames.lenses_nominal
        return self_calibration.estimate(*_under_lenses(run, seen, prior, wide), nominal)

    return _of_matches(run, seen, prior, name, matches, solved, found, SelfCalibration)


def find_lenses(
    run: Run,
    seen: ObservedFrames,
    prior: Prior,
    name: str,
    matches: Sequence[Matches],
    solved: Solution,
) -> LensCentres:
    """Where the lenses are, from matches that no solution has chosen among."""

    def found(wide: Solution) -> LensCentres:
        problem = run.problem(prior, wide)
        return lens_centres.estimate(wide.landmarks, seen.keypoints, wide, seen.lenses, problem)

    return _of_matches(run, seen, prior, name, matches, solved, found, LensCentres, noted=True)


def find_stitch_radius(
    run: Run,
    seen: ObservedFrames,
    prior: Prior,
    name: str,
    matches: Sequence[Matches],
    solved: Solution,
) -> StitchRadius:
    """How far away panoramas take things to be, from the same under two lenses."""

    def found(wide: Solution) -> StitchRadius:
        return lens_centres.stitched_for(*_under_lenses(run, seen, prior, wide))

    return _of_matches(run, seen, prior, name, matches, solved, found, StitchRadius)


def find_readout(
    run: Run,
    seen: ObservedFrames,
    prior: Prior,
    name: str,
    matches: Sequence[Matches],
    solved: Solution,
) -> CameraEstimate:
    """How long rows are read and which way, from the same."""

    def found(wide: Solution) -> CameraEstimate:
        shown, times = seen.shown.bearings_rig, run.frames.timestamps
        problem = run.problem(prior, wide)
        given = wide.landmarks, seen.keypoints, shown, wide, seen.lenses, times, problem
        return readout.estimate(*given)

    return _of_matches(run, seen, prior, name, matches, solved, found, CameraEstimate, noted=True)


def settle_camera(
    run: Run,
    seen: ObservedFrames,
    prior: Prior,
    name: str,
    matches: Sequence[Matches],
    solved: Solution,
    camera: CameraEstimate,
) -> tuple[Solution, CameraEstimate]:
    """The map of the same matches, solved with all that was taken of the camera."""
    rounds = run.settings.rounds
    gates = rounds.gate_scale, *rounds.dense  # a camera that is off throws observations off

    def compute() -> tuple[Solution, CameraEstimate]:
        found, problem = _tracks(seen, prior, matches), run.problem(prior, solved)
        given = found, seen.shown, camera, run.frames.timestamps, solved, problem, gates
        return solve_with_camera(*given, final=False)

    key = [camera_key(run), gates]
    return run.stage(name, key, compute, tuple[Solution, CameraEstimate])


def _under_lenses(
    run: Run, seen: ObservedFrames, prior: Prior, wide: Solution
) -> tuple[Landmarks, Keypoints, np.ndarray, Solution, Lenses, AdjustmentContext]:
    """What is asked of a map for what its lenses do to pictures."""
    shown, problem = seen.shown.bearings_rig, run.problem(prior, wide)
    return wide.landmarks, seen.keypoints, shown, wide, seen.lenses, problem


def _of_matches(
    run: Run,
    seen: ObservedFrames,
    prior: Prior,
    name: str,
    matches: Sequence[Matches],
    solved: Solution,
    found: Callable[[Solution], T],
    returns: type[T],
    *,
    noted: bool = False,
) -> T:
    """What is found of the camera from points of matches with all within a gate.

    Observations that one centre threw off are far: the gate is wide until there are two, and
    poses count as unsure as it is wide.
    """
    settings = run.settings
    gate = settings.rounds.gate_scale if seen.lenses else _WIDE

    def compute() -> T:
        placed = triangulation.place(
            _tracks(seen, prior, matches),
            seen.keypoints,
            solved.world_T_rigs,
            gate * solved.noise,
            settings.triangulate,
            run.num_threads,
        )
        noise = solved.noise * gate / settings.rounds.gate_scale
        return found(replace(solved, landmarks=placed, noise=noise))

    return run.stage(name, camera_key(run), compute, returns, noted=noted)


def camera_key(run: Run) -> list[object]:
    """Settings that what is found of the camera rests on."""
    camera = run.settings.camera
    said = camera.model_dump(exclude={"name", "baseline_mm", "readout_ms"})
    return [
        run.solving_key(),
        said,
        camera.readout(),
        camera.inverse_stitch_radius(1.0),
        run.settings.seed,
    ]


def _tracks(seen: ObservedFrames, prior: Prior, matches: Sequence[Matches]) -> Tracks:
    """Tracks that matches make, within parts that nothing ties together yet."""
    tied = [connectivity.within(some, prior.parts) for some in matches]
    found = tracks.build(tied, np.diff(seen.keypoints.starts))
    return seen.lenses.clear(found, seen.keypoints)


def scattered(run: Run, prior: Prior, near: VerifiedPairs, solved: Solution) -> np.ndarray | None:
    """Parts (F,) of the map that no step ties together; None = it is in one piece.

    Without a trajectory, steps also part where too few points see both: the scale is open there.

    Raises:
        GsbaError: there is no map at all, so that nothing could be registered against it.
    """
    if not len(solved.landmarks.points_world):
        raise GsbaError(
            "no scene point is seen from enough frames, with enough parallax: frames must "
            "follow one another closely (or lower triangulate.min_track_length or "
            "triangulate.min_parallax_deg)"
        )
    scarce = connectivity.starving(solved, run.settings.rounds.min_observations)
    nothing = np.zeros_like(prior.trust.held_steps)
    if prior.absent:  # nothing but points hands the scale on
        matches = steps.matches_of_steps(near, len(scarce))
        loose = connectivity.bridging(solved.landmarks.tracks, len(scarce)) < _MIN_BRIDGING
        loose[1:-1] &= (matches[:-1] > 0) & (matches[1:] > 0)
        loose[[0, -1]] = False
        open_at = set(np.flatnonzero(loose).tolist())
        near = steps.without_steps(near, steps.given_up(open_at, matches))
    return connectivity.parted(near.matches.pairs, nothing, scarce)


def merge_maps(
    run: Run, seen: ObservedFrames, prior: Prior, solved: Solution, parts: np.ndarray
) -> tuple[Prior, Registered]:
    """Parts of the map joined where they meet, frames in none of them registered."""
    trust = prior.trust

    def compute() -> Registered:
        held, shown = trust.held_steps, ~trust.unseen_steps
        if prior.absent:  # images show a step between parts, but not how long it is
            fed = ~connectivity.starving(solved, run.settings.rounds.min_observations)
            shown &= ~((parts[1:] != parts[:-1]) & fed[1:] & fed[:-1])
        given = held, shown, run.frames.timestamps, prior.absent
        return map_merging.merge(seen.context, solved, parts, *given)

    merged = run.stage("registered", run.matching_key(), compute, Registered)
    coarse, trust, joints = follow(merged, prior.coarse, trust, prior.joints)
    apart = connectivity.several(merged.components)
    prior = replace(prior, merged=merged, parts=apart, coarse=coarse, trust=trust, joints=joints)
    return prior, merged


def measure_strength(run: Run, seen: ObservedFrames, prior: Prior, solved: Solution) -> Prior:
    """What images hold well goes without priors; the rest are worth what the others show."""
    limits, settings, trust = run.settings.weak_frames, run.settings.priors, prior.trust

    def compute() -> MapStrength:
        problem = run.problem(prior, None, settings.faint())
        covariances, joint = adjustment.pose_covariances(
            solved, seen.keypoints, problem, prior.parts
        )
        return map_strength.measure(
            solved.world_T_rigs,
            covariances,
            joint,
            prior.coarse.world_T_rigs,
            ~trust.unseen_steps,
            ~trust.false_steps,
            limits,
            settings,
            prior.parts,
        )

    strength = run.stage("strength", [run.solving_key(), limits], compute, MapStrength)
    return replace(prior, strength=strength)


def align_imu(
    run: Run, prior: Prior, solved: Solution, name: str, *, with_noise: bool = True
) -> Prior:
    """What a gyro says of the frames' turning, by better poses than before.

    Args:
        with_noise: measure its noise, too. Poses have followed it by as much as it was believed:
            the noise that they leave is measured once where they have become much better.
    """
    readings, former, times = run.imu, prior.gyro, run.frames.timestamps
    if readings is None or former is None or former.reason:
        return prior
    rotations = solved.world_T_rigs[:, :3, :3]
    steps = np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:]

    def compute() -> Alignment:
        return align(times, steps, ~prior.trust.unseen_steps, readings, former)

    found = run.stage(name, readings.digest, compute, Alignment)
    if found.reason:
        return prior
    if not with_noise:
        found = replace(found, noise=former.noise)
    return replace(prior, gyro=found, turning=turning_of(readings, found, times))


def refine_photometric(run: Run, prior: Prior, world: Map) -> Map:
    """Joint refinement by the observations so far and the grey values of patches."""
    key = [run.solving_key(), run.settings.photometric]

    def compute() -> PhotometricResult:
        frames, keypoints = world.straightened(run.frames), world.keypoints(run.rig)
        lenses = world.lenses.cut_anew()
        problem = run.problem(prior, world.solution)
        return direct.refine(frames, keypoints, world.solution, problem, lenses)

    found = run.stage("photometric", key, compute, PhotometricResult)
    return replace(world, solution=found.adjustment, frame_weights=found.frame_weights)


def refine_on_splat(run: Run, prior: Prior, world: Map) -> Map:
    """Joint refinement by the observations so far, patches, and a splat of the frames."""
    settings, solved = run.settings, world.solution
    key = [run.solving_key(), settings.splat, settings.photometric, settings.factors]
    turns = run.store.root / "stages/splat/turns.npz"

    def compute() -> SplatResult:
        frames, start = world.straightened(run.frames), digest(key, solved.world_T_rigs.tolist())
        lenses = world.lenses.cut_anew() if world.lenses else ONE_CENTRE
        weights = world.frame_weights
        patches = direct.joint(frames, solved, weights, settings, run.num_threads, lenses)
        places, seen = solved.landmarks.points_world, solved.landmarks.tracks
        around = scenes_around(solved.world_T_rigs, places, seen.points, seen.frames)
        optics = Optics(lenses, around)
        given = frames, world.keypoints(run.rig), solved, run.problem(prior, solved)
        return refinement.refine(*given, patches, turns, start, optics)

    found = run.stage("splat", key, compute, SplatResult)
    turns.unlink(missing_ok=True)
    return replace(world, solution=found.adjustment, moves=found.moves)


def measure_camera(run: Run, prior: Prior, world: Map) -> Map:
    """How well poses and camera are known beside each other."""
    if world.centres is None or not world.lenses:
        return world

    def compute() -> CameraCovariances:
        straight = stitching.corrected(world.observed, world.field, run.rig)
        solved, times = world.solution, run.frames.timestamps
        given = solved, straight, world.camera(), times, run.problem(prior, solved)
        return CameraSystem(*given).covariances(prior.parts)

    found = run.stage("camera", camera_key(run), compute, CameraCovariances, noted=False)
    centres = replace(world.centres, covariance=found.centre)
    seeing = world.camera()
    read = replace(seeing, readout_sigma=readout.total_sigma(seeing, found.readout_sigma))
    return replace(world, centres=centres, covariances=found).with_camera(read)


def reconstruct(run: Run, seen: ObservedFrames, prior: Prior, world: Map) -> Reconstruction:
    """Covariances, and everything back in the trajectory's world; of a turn, rotations alone."""
    if prior.turning_only:
        return _reconstruct_rotations(run, seen, prior)

    def compute() -> Reconstruction:
        solved, observed = world.solution, world.keypoints(run.rig)
        problem = run.problem(prior, solved)
        frames = world.straightened(run.frames)
        if world.covariances is None:
            claimed = adjustment.pose_covariances(solved, observed, problem, prior.parts)
        else:
            claimed = world.covariances.poses, world.covariances.joint
        covariances, joint = common_errors.added(*claimed, solved.world_T_rigs, prior.parts)
        result = assemble(
            solved,
            covariances,
            observed,
            prior.coarse,
            run.settings.rounds.min_observations,
            prior.trust.false_frames,
            frames.correction,
            prior.parts,
            joint,
            stays=bool(run.families.fixing_gauge.members),
        )
        result = replace(result, fisheyes=frames.fisheyes, vertical=_vertical(run, prior, result))
        if not world.lenses or world.centres is None:
            return result
        baseline = baseline_of(world.centres, world_scale(solved, result))
        return replace(result, lens_baseline=baseline)

    return run.stage("reconstruction", run.solving_key(), compute, Reconstruction)


def _vertical(run: Run, prior: Prior, result: Reconstruction) -> np.ndarray | None:
    """The vertical in the world of a result, by an accelerometer that rode along."""
    if run.imu is None or prior.gyro is None or prior.gyro.reason:
        return None
    good = result.pose_statuses == PoseStatus.REFINED
    if result.components is not None:  # each map has a world of its own
        good &= result.components == 0
    rotations = result.world_T_rigs[good, :3, :3]
    return up_axis(run.imu, prior.gyro, run.frames.timestamps[good], rotations)


def keep_lenses(run: Run, world: Map, result: Reconstruction) -> Lenses:
    """The lenses of a map in the unit of the result that it became, for later exports."""
    if not world.lenses:
        return ONE_CENTRE
    lenses = world.lenses.scaled(world_scale(world.solution, result)).cut_anew()
    return run.stage("lenses", [], lambda: lenses, Lenses, noted=False)


def _reconstruct_rotations(run: Run, seen: ObservedFrames, prior: Prior) -> Reconstruction:
    """Rotations alone, of a camera that stayed in one place."""
    least, poses = run.settings.rounds.min_observations, prior.start().world_T_rigs

    def compute() -> Reconstruction:
        matches = correspondences.match_for_rotations(seen.context, poses)
        found = tracks.build([matches], np.diff(seen.keypoints.starts))
        return rotation_only.refine(found, seen.keypoints, poses, prior.coarse, least)

    return run.stage("reconstruction", [run.settings.matching, least], compute, Reconstruction)
