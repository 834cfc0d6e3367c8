"""The camera of a run: where its lenses are, what they are, and how their rows are read."""

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from gsba.bundle import (
    adjustment,
    lens_axes,
    lens_centres,
    readout,
    residual_correlation,
    seam_band,
    self_calibration,
    stitching,
)
from gsba.bundle.adjustment import ALIGNED_GATES, GATE_SCALE
from gsba.bundle.camera_adjustment import (
    CameraCovariances,
    CameraSystem,
    solve_sighted_with_camera,
    solve_with_camera,
)
from gsba.bundle.lens_axes import LensAxes
from gsba.bundle.lens_centres import LensCentres, StitchRadius
from gsba.bundle.readout import CameraEstimate, CameraEstimates, tracks_of_camera
from gsba.bundle.reconstruction import world_scale
from gsba.bundle.self_calibration import SelfCalibration
from gsba.bundle.shared_parameters import ObservedRays
from gsba.camera.cameras import Cameras
from gsba.camera.fisheye import Rig, turned
from gsba.camera.lens import ONE_CENTRE, Lenses
from gsba.frames.dual_fisheye import SEAM
from gsba.frames.recordings import names_of_cameras
from gsba.pipeline import backend, frontend
from gsba.pipeline.map import Map
from gsba.pipeline.run import Run
from gsba.pipeline.state import State
from gsba.trajectory.conventions import quarter_turn
from gsba.types import CoarsePoses, Keypoints, PoseSource, Reconstruction, Sighted, Solution

T = TypeVar("T")

Cuts = tuple[tuple[Rig, bool] | None, ...]  # (C,) calibration to cut raw frames of each camera by,
# and whether it was estimated; None = they are cut well

logger = logging.getLogger(__name__)


def find_camera(state: State, prefix: str = "") -> State:
    """Lenses and readout of each camera, before gates take what tells of them; and the map that
    these give.

    Each camera is judged by what its own frames observe, the rays of others as they are so far;
    then all cameras are solved for together. The state's matches stay: the map is matched from
    itself afterwards.

    Args:
        state: of the run; it stays as it is where one centre explains the images.
        prefix: of the names of stages. With one, only cameras are looked for that were not found
            before.
    """
    sought = sought_cameras(state, again=bool(prefix))
    found = _find_lenses(state, sought, prefix) if sought else state
    return replace(found, matches=state.matches)


def sought_cameras(state: State, again: bool = False) -> list[int]:
    """Cameras that may have several lenses and are one centre so far; `again`: without raw ones."""
    run = state.run
    if run.settings.camera.model == "central":
        return []
    return [
        number
        for number, (kind, found) in enumerate(
            zip(run.frames.formats, state.map.cameras, strict=True)
        )
        if kind.panoramic and not found.lenses and not (again and kind.fisheyes is not None)
    ]


def _find_lenses(state: State, sought: Sequence[int], prefix: str) -> State:
    """Lenses on trial, judged by what is matched with them; then the radius of stitching."""
    run, settings = state.run, state.run.settings
    trial, guesses = _on_trial(state, sought, prefix)
    gates, map_, raw = settings.rounds.loops, state.map, _raw_cameras(run)
    left = list(sought)
    for n in range(2):
        lenses = list(trial.observed.cameras.lenses)
        for camera in left:
            name = f"{prefix}lenses{n}"
            known = run.settings_of(camera).baseline() is not None
            find = partial(_centres, known=known)
            given = name, camera, _seen_by_features, find, LensCentres
            centres = _estimated(trial, *given, noted=True)
            map_, lenses[camera] = map_.changed(camera, centres=centres), centres.lenses
        left = [camera for camera in left if lenses[camera]]
        if not left:
            return replace(state, map=map_)
        cameras = trial.observed.cameras.with_lenses([one if one else ONE_CENTRE for one in lenses])
        trial = backend.adjust(trial.through(cameras), f"{prefix}lensed{n}", gates)
        gates = settings.rounds.dense
        if n == 0 and set(left) - set(raw):
            trial = frontend.match_along_epipolars(trial, f"{prefix}adjacent_lenses")
            trial = frontend.match_known_points(trial, f"{prefix}wide_lenses")
    for camera in left:
        map_ = map_.changed(camera, axes=guesses.get(camera))
    trial = replace(trial, map=replace(map_, solution=trial.solution))
    apart = [c for c in left if c not in raw and not _in_one_place(map_, c)]  # as no radius shows
    trial = _with_stitch_radii(_with_seam_bands(trial, apart, prefix), apart, prefix)
    return _calibrate_raw(trial, [camera for camera in left if camera in raw])


def _in_one_place(map_: Map, camera: int) -> bool:
    """True if the lenses of a camera are kept for their rows alone."""
    centres = map_.cameras[camera].centres
    return centres is not None and bool(centres.reason)


def _with_seam_bands(state: State, stitched: Sequence[int], prefix: str) -> State:
    """The state without what panoramas of cameras show from between the lenses."""
    for camera in stitched:
        given = f"{prefix}seam", camera, _seen_by_features, seam_band.widened, Lenses
        lenses = _estimated(state, *given)
        state = _with_lenses(state, {camera: lenses})
    return state


def _with_stitch_radii(start: State, stitched: Sequence[int], prefix: str) -> State:
    """Map and cameras solved together, with the radius that panoramas of cameras are stitched for.

    The distance between lenses is wrong where the radius is left out, and the first estimate of the
    radius with it: it is judged once all is solved with it.
    """
    tried = dict[int, Lenses]()

    def asked(state: State, stage: str, camera: int) -> StitchRadius:
        given = _seen_by_features, lens_centres.stitched_for, StitchRadius
        return _estimated(state, prefix + stage, camera, *given)

    for camera in stitched:
        first = asked(start, "stitch_radius", camera)
        start = replace(start, map=start.map.changed(camera, stitch_radius=first))
        lenses = first.on_trial(start.observed.cameras.lenses[camera])
        if lenses is not None:
            tried[camera] = lenses
    trial = _with_lenses(start, tried)
    if tried:  # matches found without a radius miss what crosses the seam
        trial = _solve_with_cameras(trial, trial.map.estimates(), f"{prefix}stitched")
        trial = frontend.match_along_epipolars(trial, f"{prefix}adjacent_stitched")
        trial = frontend.match_known_points(trial, f"{prefix}wide_stitched")
    trial = _settle_cameras(trial, f"{prefix}settled")
    judged = {camera: asked(trial, "stitch_radius_tried", camera) for camera in tried}
    for camera, radius in judged.items():
        start = replace(start, map=start.map.changed(camera, stitch_radius=radius))
        trial = replace(trial, map=trial.map.changed(camera, stitch_radius=radius))
    taken = {camera: tried[camera] for camera, radius in judged.items() if not radius.reason}
    if len(taken) == len(tried):
        return trial
    return _settle_cameras(_with_lenses(start, taken), f"{prefix}settled_far")


def _with_lenses(state: State, lenses: dict[int, Lenses]) -> State:
    for camera, own in lenses.items():
        state = _through(state, camera, own).with_lenses(camera, own)
    return state


def _on_trial(
    state: State, sought: Sequence[int], prefix: str
) -> tuple[State, dict[int, LensAxes]]:
    """The state seen through lenses that centres are sought for; guesses of stitched ones' axes."""
    run, guesses = state.run, dict[int, LensAxes]()
    trial, raw = state, _raw_cameras(run)
    for camera in sought:
        own = run.settings_of(camera)
        yaws = own.lens_yaws_deg
        if camera in raw:
            fisheyes = run.frames.formats[camera].fisheyes
            assert fisheyes is not None
            trial = _through(trial, camera, Lenses.of_raw(fisheyes, float(SEAM)))
            continue
        lenses = Lenses() if yaws is None else Lenses.ring(np.deg2rad(yaws))
        trial = _through(trial, camera, lenses)
        if not _axes_known(run, camera):
            given = f"{prefix}axes", camera, _seen_by_features, lens_axes.guess, LensAxes
            guesses[camera] = _estimated(trial, *given)
            lenses = guesses[camera].lenses
        trial = _through(trial, camera, replace(lenses, band_rad=seam_band.NARROWEST))
    return trial, guesses


def _through(state: State, camera: int, lenses: Lenses) -> State:
    every = list(state.observed.cameras.lenses)
    every[camera] = lenses
    return state.through(state.observed.cameras.with_lenses(every))


def _calibrate_raw(trial: State, raw: Sequence[int]) -> State:
    """The state with the calibration of raw cameras, where images tell it."""
    run, free = trial.run, False
    for camera in raw:
        lenses = trial.map.cameras[camera].lenses
        if run.lenses_found and run.lenses_found[camera]:
            # Patches say more of them than features do.
            lenses = replace(lenses, fisheyes=lenses.reference_calibration)
            trial = trial.with_lenses(camera, lenses)
            continue
        find = _calibration(run, camera)
        given = "calibrated", camera, _seen_by_features, find, SelfCalibration
        known = _estimated(trial, *given)
        trial = replace(trial, map=trial.map.changed(camera, calibrated=known))
        if not known.reason:
            trial, free = trial.with_lenses(camera, known.lenses), True
    if not free:
        return trial
    trial = _settle_cameras(trial.through(trial.map.lenses), "recalibrated")
    for n in range(4):
        before = trial.map.lenses.lenses
        trial = frontend.match_along_epipolars(trial, f"adjacent_raw{n}")
        trial = frontend.match_known_points(trial, f"wide_raw{n}")
        trial = _settle_cameras(trial, f"calibrated{n}")
        pairs = zip(before, trial.map.lenses.lenses, strict=True)
        if max(self_calibration.apart(*pair) for pair in pairs) < np.deg2rad(0.01):
            break
    return trial


def _settle_cameras(state: State, name: str) -> State:
    """Map and cameras solved together, after a first estimate of how rows are read."""
    found = state.map.estimates()
    for camera, one in enumerate(found.each):
        if one.lenses and one.lenses.readout_motion is None:
            stage = f"{name}_readout"
            given = stage, camera, _seen_by_features, readout.estimate, CameraEstimate
            read = _estimated(state, *given, noted=True)
            found = found.changed(camera, read)
    return _solve_with_cameras(state, found, name)


def _solve_with_cameras(state: State, found: CameraEstimates, name: str) -> State:
    """Map and cameras solved together."""
    run = state.run
    gates = GATE_SCALE, *run.settings.rounds.dense  # a camera that is off throws observations off
    state = state.through(found.cameras)

    def compute() -> tuple[Solution, CameraEstimates]:
        return solve_with_camera(
            backend.tracks_of(state),
            state.observed.shown,
            found,
            run.frames.timestamps,
            state.solution,
            state.adjustment_context(),
            gates,
            final=False,
        )

    key = [_settings_of_cameras(run), gates]
    solved, settled = run.stage(name, key, compute, tuple[Solution, CameraEstimates])
    return state.with_solution(solved).with_cameras(settled).through(settled.cameras)


def take_parts_from_patches(state: State, sighted: Sighted, name: str, number: int) -> State:
    """The map with the parts of cameras that aligned patches show, its poses yet to follow:
    estimate 0 of a round finds how rows are read, 1 which axes and calibration lenses have, if not
    known."""
    observe = partial(_seen_by_patches, sighted=sighted)
    for camera in range(len(state.map.cameras)):
        for part, estimate, returns in list(_missing_parts(state, camera, number)):
            stage = f"{part}_{name}"
            found = _estimated(state, stage, camera, observe, estimate, returns, noted=True)
            changed = state.map.changed(camera, **{part: found})
            state = replace(state, map=changed).with_lenses(camera, found.lenses)
    return state


def _missing_parts(
    state: State, camera: int, number: int
) -> Iterator[tuple[str, Callable[[ObservedRays], Any], type]]:
    """Parts of a camera that estimate `number` of a round looks for: field of `FoundCamera`,
    estimate, and type of the result."""
    run, one = state.run, state.map.cameras[camera]
    lenses, raw = one.lenses, camera in _raw_cameras(run)
    if not lenses:
        return
    if number == 0:
        if lenses.readout_motion is None and one.estimate().reason != readout.VANISHED:
            plain = run.frames.formats[camera].lenses_nominal and lenses.fisheyes is None
            find = partial(readout.estimate, few_frames=raw and not plain)
            yield "readout", find, CameraEstimate
        return
    if raw and lenses.fisheyes is None:  # the rest has settled
        yield "calibrated", _calibration(run, camera), SelfCalibration
    if not _axes_known(run, camera) and lenses.axes is None:
        yield "axes", lens_axes.loosened, LensAxes
    unstitched = raw or _in_one_place(state.map, camera)
    if not unstitched and not lenses.inverse_stitch_radius:
        yield "stitch_radius", lens_centres.stitched_for, StitchRadius


def adjust_with_patches(
    state: State, sighted: Sighted, name: str, gates: Sequence[float] | None = None
) -> tuple[Solution, Keypoints, CameraEstimates]:
    """Aligned observations solved for poses, points and camera; gates None = those of patches.
    Returns the solution, the keypoints with the noise that they turned out to have, and the
    camera."""
    run, map_ = state.run, state.map
    gates = ALIGNED_GATES if gates is None else gates

    def compute() -> tuple[Solution, Keypoints, CameraEstimates]:
        shown = stitching.corrected(sighted.keypoints, map_.field, run.rig)
        solved, found, camera = solve_sighted_with_camera(
            replace(sighted, keypoints=shown),
            map_.estimates(),
            run.frames.timestamps,
            map_.solution,
            state.adjustment_context(),
            gates,
        )
        return solved, stitching.with_noise_of(sighted.keypoints, found), camera

    returns = tuple[Solution, Keypoints, CameraEstimates]
    return run.stage(name, [*_settings_of_cameras(run), gates], compute, returns)


def measure_camera(state: State) -> State:
    """Marginal covariances of poses and cameras, adjusted together."""
    map_ = state.map
    if not map_.lenses:
        return state

    def compute() -> CameraCovariances:
        straight = stitching.corrected(map_.observed, map_.field, state.run.rig)
        times, context = state.run.frames.timestamps, state.adjustment_context()
        system = CameraSystem(map_.solution, straight, map_.estimates(), times, context)
        rays = map_.keypoints(state.run.rig)
        ratio = residual_correlation.variance_ratio(map_.solution, rays, context)
        return system.covariances(state.prior.parts).grown(ratio)

    key = _settings_of_cameras(state.run)
    measured = state.run.stage("camera", key, compute, CameraCovariances, noted=False)
    map_ = replace(map_, covariances=measured)
    for camera, (one, sigmas) in enumerate(zip(map_.cameras, measured.cameras, strict=True)):
        if one.centres is None or not one.lenses:
            continue
        found = one.estimate()
        found = replace(found, readout_sigma=readout.total_sigma(found, sigmas.readout_sigma))
        centres = replace(one.centres, covariance=sigmas.centre)
        changed = replace(one, centres=centres).with_estimate(found)
        map_ = map_.changed(camera, centres=changed.centres, readout=changed.readout)
    return replace(state, map=map_)


def keep_lenses(state: State, result: Reconstruction) -> Cameras:
    """The cameras of a map in the unit of the result that it became, for later exports."""
    cameras = state.map.lenses
    if not cameras:
        return cameras
    cameras = cameras.scaled(world_scale(state.solution, result)).cut_anew()
    return state.run.stage("lenses", [], lambda: cameras, Cameras, noted=False)


def better_calibration(coarse: CoarsePoses, map_: Map) -> Cuts | None:
    """Calibrations to cut raw frames by in the next pass, in the trajectory's axes, and whether
    each was estimated; None = a camera's frames are cut well, or all are."""
    found = [_better(coarse, map_, camera) for camera in range(len(map_.cameras))]
    return tuple(found) if any(found) else None


def _better(coarse: CoarsePoses, map_: Map, camera: int) -> tuple[Rig, bool] | None:
    lenses = map_.cameras[camera].lenses
    if lenses.reference_calibration is None:
        return None
    found, turn = self_calibration.now(lenses), np.eye(3)
    rows = map_.lenses.frames_of(camera, len(coarse.sources))
    own = coarse.taken(rows)
    if (own.sources == PoseSource.SLAM).any():
        turn = quarter_turn(own, map_.solution.world_T_rigs[rows])
    off = self_calibration.apart(lenses, replace(lenses, fisheyes=None))
    if off < np.deg2rad(0.03) and np.array_equal(turn, np.eye(3)):
        return None
    logger.info("lenses are %.2f deg from what panoramas were cut by: all anew", np.rad2deg(off))
    return turned(found, turn), lenses.fisheyes is not None


def _centres(rays: ObservedRays, known: bool) -> LensCentres:
    """Centres of the lenses, kept about zero, too, if rows are read one after another.

    Mirrors and prisms can put both lenses in about one place: one centre then explains what they
    see, one instant does not. Estimated centres are kept with the reason why they were not taken. A
    camera whose lenses are known to be apart has rows only if it has these.
    """
    found = lens_centres.estimate(rays)
    raw = rays.lenses.reference_calibration is not None
    if not found.reason or known or raw or readout.estimate(rays).reason:
        return found
    return replace(found, lenses=replace(found.lenses, centre=found.found))


def _estimated(
    state: State,
    stage: str,
    camera: int,
    observe: Callable[[State, int], ObservedRays],
    estimate: Callable[[ObservedRays], T],
    returns: type[T],
    *,
    noted: bool = False,
) -> T:
    """An estimate of one camera from the rays that `observe` gives. The stage is named after the
    first recording of that camera, too, if there are several."""
    run = state.run
    if len(run.frames.formats) > 1:
        stage = f"{stage}@{names_of_cameras(run.frames)[camera]}"

    def compute() -> T:
        return estimate(observe(state, camera))

    return run.stage(stage, _settings_of_cameras(run), compute, returns, noted=noted)


def _seen_by_features(state: State, camera: int) -> ObservedRays:
    """Points of the state's matches with all that is within a gate.

    Observations that one centre threw off are far: the gate is wide until there are two, and poses
    count as unsure as it is wide.
    """
    observed, solution = state.observed, state.solution
    lenses = observed.cameras.lenses[camera]
    gate = GATE_SCALE if lenses else 30.0  # a wrong camera throws observations off
    tracks = tracks_of_camera(backend.tracks_of(state), observed.cameras.of_frame, camera)
    placed = state.triangulated(tracks, observed.keypoints, gate * solution.noise)
    wide = replace(solution, landmarks=placed, noise=solution.noise * gate / GATE_SCALE)
    shown = observed.shown.bearings_rig
    return _rays(state, camera, wide, observed.keypoints, lenses, shown)


def _seen_by_patches(state: State, camera: int, sighted: Sighted) -> ObservedRays:
    """Points of aligned patches."""
    run, map_ = state.run, state.map
    there = replace(sighted, keypoints=map_.rays(sighted.keypoints, run.rig))
    there = adjustment.rescale_noise(there, map_.solution, run.settings)
    tracks = tracks_of_camera(there.tracks, map_.of_frame, camera)
    placed = state.triangulated(tracks, there.keypoints, ALIGNED_GATES[0])
    solution = replace(map_.solution, noise=1.0, landmarks=placed)
    shown = stitching.corrected(sighted.keypoints, map_.field, run.rig).bearings_rig
    return _rays(state, camera, solution, there.keypoints, map_.cameras[camera].lenses, shown)


def _rays(
    state: State,
    camera: int,
    solution: Solution,
    keypoints: Keypoints,
    lenses: Lenses,
    shown: np.ndarray,
) -> ObservedRays:
    """Rays of one camera, with the priors and settings of its estimates."""
    context, times = state.adjustment_context().of_camera(camera), state.run.frames.timestamps
    return ObservedRays(solution, keypoints, context, lenses, shown, times)


def _calibration(run: Run, camera: int) -> Callable[[ObservedRays], SelfCalibration]:
    return partial(self_calibration.estimate, nominal=run.frames.formats[camera].lenses_nominal)


def _axes_known(run: Run, camera: int) -> bool:
    """True if no stabiliser has rotated panoramas against the lenses, or settings give the axes."""
    known = run.frames.formats[camera].lens_axes_known
    return known or run.settings_of(camera).lens_yaws_deg is not None


def _raw_cameras(run: Run) -> list[int]:
    return [c for c, kind in enumerate(run.frames.formats) if kind.fisheyes is not None]


def _settings_of_cameras(run: Run) -> list[object]:
    found = list[object]()
    for number in range(len(run.frames.formats)):
        camera = run.settings_of(number)
        left_out = {"name", "baseline_mm", "readout_ms"}
        left_out |= {"lens_yaws_deg"} if camera.lens_yaws_deg is None else set()
        given = camera.model_dump(exclude=left_out)
        found += [given, camera.readout(), camera.inverse_stitch_radius(1.0)]
        found.append(camera.baseline() is not None)
    return [run.solving_key(), *found, run.settings.seed]
