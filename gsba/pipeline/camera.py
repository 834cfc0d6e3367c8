"""The camera of a run: where its lenses are, what they are, and how their rows are read.

Two sources tell of it: features, matched before any gate has taken what a wrong camera threw off,
and patches, aligned to a part of a pixel. `_Observations` holds either; an estimator takes these.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from gsba.bundle import (
    adjustment,
    lens_axes,
    lens_centres,
    readout,
    self_calibration,
    stitching,
)
from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.camera_adjustment import solve_sighted_with_camera, solve_with_camera
from gsba.bundle.camera_system import CameraCovariances, CameraSystem
from gsba.bundle.lens_axes import LensAxes
from gsba.bundle.lens_centres import LensCentres, StitchRadius
from gsba.bundle.readout import CameraEstimate
from gsba.bundle.reconstruction import world_scale
from gsba.bundle.self_calibration import SelfCalibration
from gsba.camera.cameras import Cameras
from gsba.camera.fisheye import Rig, turned
from gsba.camera.lens import Lenses
from gsba.frames.dual_fisheye import SEAM
from gsba.pipeline import backend, frontend
from gsba.pipeline.map import Map
from gsba.pipeline.run import Run
from gsba.pipeline.state import State
from gsba.trajectory.axes import quarter_turn
from gsba.types import CoarsePoses, Keypoints, PoseSource, Reconstruction, Sighted, Solution

T = TypeVar("T")

logger = logging.getLogger(__name__)

_WIDE_GATE_SIGMAS = 30.0  # gate of observations that a wrong camera threw off
_MAX_RECALIBRATIONS = 4  # of raw lenses from features, and the map matched anew under them
_MIN_RECALIBRATION_RAD = np.deg2rad(0.01)  # stop when bearings change by less
_MIN_RECUT_RAD = np.deg2rad(0.03)  # change of bearings for which raw frames are cut anew


def find_camera(state: State, prefix: str = "") -> State:
    """Lenses and readout, before gates take what tells of them; and the map that these give.

    The state's matches stay: the map is matched from itself afterwards.

    Args:
        state: of the run; it stays as it is where one centre explains the images.
        prefix: of the names of stages.
    """
    run = state.run
    if len(run.frames.formats) > 1:
        return state
    if run.settings.camera.model == "central" or not run.frames.format.panoramic:
        return state
    raw = run.frames.format.fisheyes is not None
    found = _find_raw_camera(state) if raw else _find_two_lenses(state, prefix)
    return replace(found, matches=state.matches)


def _find_two_lenses(state: State, prefix: str) -> State:
    """Lenses on trial, judged by what is matched with them; then the radius of stitching."""
    settings, shown = state.run.settings, state.observed.shown
    yaws, guess = settings.camera.lens_yaws_deg, None
    trial = state.through(Lenses() if yaws is None else Lenses.ring(np.deg2rad(yaws)))
    if not _axes_known(state.run):
        guess = _from_features(trial, f"{prefix}axes", _guessed_axes, LensAxes)
        trial = trial.through(guess.lenses)
    band, gates = float(np.deg2rad(settings.camera.seam_deg)), settings.rounds.loops
    trial = trial.through(replace(trial.observed.lenses, band_rad=band))
    for n in range(2):
        name = f"{prefix}lenses{n}"
        found = _from_features(trial, name, _centres, LensCentres, noted=True)
        if not found.lenses:
            return replace(state, map=Map.of(state.solution, shown, found))
        trial = backend.adjust(trial.through(found.lenses), f"{prefix}lensed{n}", gates)
        gates = settings.rounds.dense
        if n == 0:
            trial = frontend.match_along_epipolars(trial, f"{prefix}adjacent_lenses")
            trial = frontend.match_known_points(trial, f"{prefix}wide_lenses")
    radius = _from_features(trial, f"{prefix}stitch_radius", _stitch_radius, StitchRadius)
    if not radius.reason:
        trial = backend.adjust(trial.through(radius.lenses), f"{prefix}lensed2", gates)
    map_ = replace(Map.of(trial.solution, shown, found), axes=guess, radius=radius)
    return _settle_camera(replace(trial, map=map_), f"{prefix}settled")


def _find_raw_camera(state: State) -> State:
    """Raw lenses: where they are, then their calibration."""
    run, shown, gates = state.run, state.observed.shown, state.run.settings.rounds.loops
    fisheyes = run.frames.format.fisheyes
    assert fisheyes is not None
    trial = state.through(Lenses.of_raw(fisheyes, float(SEAM)))
    for n in range(2):
        found = _from_features(trial, f"lenses{n}", _centres, LensCentres, noted=True)
        trial = backend.adjust(trial.through(found.lenses), f"lensed{n}", gates)
        gates = run.settings.rounds.dense
    trial = replace(trial, map=Map.of(trial.solution, shown, found))
    trial = _settle_camera(trial, "settled")
    if run.lenses_found:  # patches say more of them than features do
        camera = trial.map.camera()
        free = replace(camera.lenses, fisheyes=camera.lenses.reference_calibration)
        return trial.with_camera(replace(camera, lenses=free))
    known = _from_features(trial, "calibrated", _calibration, SelfCalibration)
    trial = replace(trial, map=replace(trial.map, calibrated=known))
    if known.reason:
        return trial
    trial = trial.with_camera(replace(trial.map.camera(), lenses=known.lenses))
    trial = _settle_camera(trial.through(trial.map.lenses), "recalibrated")
    for n in range(_MAX_RECALIBRATIONS):
        before = trial.map.lenses
        trial = frontend.match_along_epipolars(trial, f"adjacent_raw{n}")
        trial = frontend.match_known_points(trial, f"wide_raw{n}")
        trial = _settle_camera(trial, f"calibrated{n}")
        if self_calibration.apart(before, trial.map.lenses) < _MIN_RECALIBRATION_RAD:
            break
    return trial


def _settle_camera(state: State, name: str) -> State:
    """Map and camera solved together, after a first estimate of how rows are read."""
    run, camera = state.run, state.map.camera()
    if camera.lenses.readout_motion is None:
        found = f"{name}_readout"
        camera = _from_features(state, found, _readout, CameraEstimate, noted=True)
    rounds = run.settings.rounds
    gates = rounds.gate_scale, *rounds.dense  # a camera that is off throws observations off
    state = state.through(camera.lenses)

    def compute() -> tuple[Solution, CameraEstimate]:
        return solve_with_camera(
            backend.tracks_of(state),
            state.observed.shown,
            camera,
            run.frames.timestamps,
            state.solution,
            state.adjustment_context(),
            gates,
            final=False,
        )

    key = [_settings_of_camera(run), gates]
    solved, camera = run.stage(name, key, compute, tuple[Solution, CameraEstimate])
    return state.with_solution(solved).with_camera(camera).through(camera.lenses)


def take_parts_from_patches(state: State, sighted: Sighted, name: str, number: int) -> State:
    """The map with the parts of a camera that aligned patches show; its poses are yet to follow.

    Args:
        state: of the run; its map has two lenses.
        sighted: observations that patches were aligned to.
        name: of the round's stages.
        number: of the estimate in this round. The first finds how rows are read, the second which
            axes and calibration lenses have, as far as these are not known by then.
    """
    raw = state.run.frames.format.fisheyes is not None
    if number == 0 and state.map.lenses.readout_motion is None:
        found = f"readout_{name}"
        state = state.with_camera(
            _from_patches(state, sighted, found, _readout, CameraEstimate, noted=True)
        )
    if number == 1 and raw and state.map.lenses.fisheyes is None:  # the rest has settled
        found = f"calibrated_{name}"
        known = _from_patches(state, sighted, found, _calibration, SelfCalibration, noted=True)
        state = replace(state, map=replace(state.map, calibrated=known))
        state = state.with_camera(replace(state.map.camera(), lenses=known.lenses))
    if number == 1 and not _axes_known(state.run) and state.map.lenses.axes is None:
        axes = _from_patches(state, sighted, f"axes_{name}", _loose_axes, LensAxes, noted=True)
        state = replace(state, map=replace(state.map, axes=axes))
        state = state.with_camera(replace(state.map.camera(), lenses=axes.lenses))
    return state


def adjust_with_patches(
    state: State, sighted: Sighted, name: str, gates: Sequence[float] | None = None
) -> tuple[Solution, Keypoints, CameraEstimate]:
    """Aligned observations solved for poses, points and camera.

    Args:
        state: of the run; its map has two lenses.
        sighted: observations that patches were aligned to.
        name: of the stage.
        gates: of the rounds; None = those of aligned patches.

    Returns:
        The solution, the keypoints with the noise that they turned out to have, and the camera.
    """
    run, map_ = state.run, state.map
    gates = run.settings.rounds.aligned if gates is None else gates

    def compute() -> tuple[Solution, Keypoints, CameraEstimate]:
        shown = stitching.corrected(sighted.keypoints, map_.field, run.rig)
        solved, found, camera = solve_sighted_with_camera(
            replace(sighted, keypoints=shown),
            map_.camera(),
            run.frames.timestamps,
            map_.solution,
            state.adjustment_context(),
            gates,
        )
        return solved, stitching.with_noise_of(sighted.keypoints, found), camera

    returns = tuple[Solution, Keypoints, CameraEstimate]
    return run.stage(name, [*_settings_of_camera(run), gates], compute, returns)


def measure_camera(state: State) -> State:
    """Marginal covariances of poses and camera, adjusted together."""
    map_ = state.map
    if map_.centres is None or not map_.lenses:
        return state

    def compute() -> CameraCovariances:
        straight = stitching.corrected(map_.observed, map_.field, state.run.rig)
        times, context = state.run.frames.timestamps, state.adjustment_context()
        system = CameraSystem(map_.solution, straight, map_.camera(), times, context)
        return system.covariances(state.prior.parts)

    key = _settings_of_camera(state.run)
    found = state.run.stage("camera", key, compute, CameraCovariances, noted=False)
    camera = map_.camera()
    sigma = readout.total_sigma(camera, found.readout_sigma)
    centres = replace(map_.centres, covariance=found.centre)
    state = replace(state, map=replace(map_, centres=centres, covariances=found))
    return state.with_camera(replace(camera, readout_sigma=sigma))


def keep_lenses(state: State, result: Reconstruction) -> Cameras:
    """The cameras of a map in the unit of the result that it became, for later exports."""
    cameras = Cameras.of(state.map.lenses, state.run.frames)
    if not cameras:
        return cameras
    cameras = cameras.scaled(world_scale(state.solution, result)).cut_anew()
    return state.run.stage("lenses", [], lambda: cameras, Cameras, noted=False)


def better_calibration(coarse: CoarsePoses, map_: Map) -> tuple[Rig, bool] | None:
    """The calibration to cut raw frames by in the next pass, in the trajectory's axes.

    Returns:
        The calibration, and whether it was estimated; None = frames are cut well.
    """
    lenses = map_.lenses
    if lenses.reference_calibration is None:
        return None
    found, turn = self_calibration.now(lenses), np.eye(3)
    if (coarse.sources == PoseSource.SLAM).any():
        turn = quarter_turn(coarse, map_.solution.world_T_rigs)
    off = self_calibration.apart(lenses, replace(lenses, fisheyes=None))
    if off < _MIN_RECUT_RAD and np.array_equal(turn, np.eye(3)):
        return None
    logger.info("lenses are %.2f deg from what panoramas were cut by: all anew", np.rad2deg(off))
    return turned(found, turn), lenses.fisheyes is not None


@dataclass(frozen=True, slots=True)
class _Observations:
    """Points and the rays that see them: all that an estimate of the camera rests on."""

    solution: Solution  # poses and points, noise of the observations
    keypoints: Keypoints  # of its observations, as rays of the camera so far
    pictured: Keypoints  # these keypoints where pictures show them
    camera: CameraEstimate  # so far
    state: State  # priors, times, settings

    @property
    def shown(self) -> np.ndarray:
        """Directions of the keypoints in their pictures, (N, 3) float64, unit, rig frame."""
        return self.pictured.bearings_rig

    @property
    def context(self) -> AdjustmentContext:
        """Priors, loss and settings."""
        return self.state.adjustment_context()

    @property
    def times(self) -> np.ndarray:
        """Of the frames, (F,) float64, seconds."""
        return self.state.run.frames.timestamps


def _guessed_axes(of: _Observations) -> LensAxes:
    return lens_axes.guess(
        of.solution.landmarks, of.keypoints, of.solution, of.camera.lenses, of.context
    )


def _loose_axes(of: _Observations) -> LensAxes:
    return lens_axes.loosened(
        of.solution.landmarks, of.keypoints, of.solution, of.camera.lenses, of.context
    )


def _centres(of: _Observations) -> LensCentres:
    return lens_centres.estimate(
        of.solution.landmarks, of.keypoints, of.solution, of.camera.lenses, of.context
    )


def _stitch_radius(of: _Observations) -> StitchRadius:
    return lens_centres.stitched_for(
        of.solution.landmarks, of.keypoints, of.shown, of.solution, of.camera.lenses, of.context
    )


def _calibration(of: _Observations) -> SelfCalibration:
    landmarks, lenses, nominal = (
        of.solution.landmarks,
        of.camera.lenses,
        of.state.run.frames.format.lenses_nominal,
    )
    return self_calibration.estimate(
        landmarks, of.keypoints, of.shown, of.solution, lenses, of.context, nominal
    )


def _readout(of: _Observations) -> CameraEstimate:
    landmarks, lenses = of.solution.landmarks, of.camera.lenses
    return readout.estimate(
        landmarks, of.keypoints, of.shown, of.solution, lenses, of.times, of.context
    )


def _from_features(
    state: State,
    name: str,
    estimate: Callable[[_Observations], T],
    returns: type[T],
    *,
    noted: bool = False,
) -> T:
    """An estimate from points of the state's matches with all that is within a gate.

    Observations that one centre threw off are far: the gate is wide until there are two, and
    poses count as unsure as it is wide.

    Args:
        state: of the run.
        name, returns, noted: of the stage, see `Run.stage`.
        estimate: makes the result.
    """
    run, observed, solution = state.run, state.observed, state.solution
    least = run.settings.rounds.gate_scale
    gate = least if observed.lenses else _WIDE_GATE_SIGMAS

    def compute() -> T:
        tracks = backend.tracks_of(state)
        placed = state.triangulated(tracks, observed.keypoints, gate * solution.noise)
        wide = replace(solution, landmarks=placed, noise=solution.noise * gate / least)
        camera = CameraEstimate(observed.lenses)
        return estimate(_Observations(wide, observed.keypoints, observed.shown, camera, state))

    return run.stage(name, _settings_of_camera(run), compute, returns, noted=noted)


def _from_patches(
    state: State,
    sighted: Sighted,
    name: str,
    estimate: Callable[[_Observations], T],
    returns: type[T],
    *,
    noted: bool = False,
) -> T:
    """An estimate from aligned patches; arguments as for `_from_features`."""
    run, map_ = state.run, state.map

    def compute() -> T:
        there = replace(sighted, keypoints=map_.rays(sighted.keypoints, run.rig))
        there = adjustment.rescale_noise(there, map_.solution, run.settings)
        gate = run.settings.rounds.aligned[0]
        placed = state.triangulated(there.tracks, there.keypoints, gate)
        solution = replace(map_.solution, noise=1.0, landmarks=placed)
        shown = stitching.corrected(sighted.keypoints, map_.field, run.rig)
        return estimate(_Observations(solution, there.keypoints, shown, map_.camera(), state))

    return run.stage(name, _settings_of_camera(run), compute, returns, noted=noted)


def _axes_known(run: Run) -> bool:
    """True if no stabiliser has rotated panoramas against the lenses, or settings give the axes."""
    return run.frames.format.lens_axes_known or run.settings.camera.lens_yaws_deg is not None


def _settings_of_camera(run: Run) -> list[object]:
    """Settings that estimates of the camera rest on."""
    camera = run.settings.camera
    left_out = {"name", "baseline_mm", "readout_ms"}
    left_out |= {"lens_yaws_deg"} if camera.lens_yaws_deg is None else set()
    given = camera.model_dump(exclude=left_out)
    return [
        run.solving_key(),
        given,
        camera.readout(),
        camera.inverse_stitch_radius(1.0),
        run.settings.seed,
    ]
