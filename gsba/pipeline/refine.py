"""A run from frames and a coarse trajectory, or from several recordings of a place, to refined
poses, a cloud and datasets."""

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from gsba.bundle.families import Family
from gsba.camera.fisheye import turned
from gsba.compilation import compile_ahead
from gsba.config import CameraSettings, RefineSettings
from gsba.frames.recordings import combine
from gsba.frames.scan import warn_of_repeats
from gsba.log import GsbaError, following
from gsba.masks import merging
from gsba.masks.segmentation import Segment
from gsba.odometry import Odometry
from gsba.photometric import direct
from gsba.pipeline import (
    acceptance,
    backend,
    camera,
    densify,
    each_recording,
    finished_run,
    frontend,
    inputs,
    outputs,
    patch_rounds,
    tour,
    unusable_frames,
)
from gsba.pipeline.outputs import RunResult
from gsba.pipeline.prior import Prior
from gsba.pipeline.recordings import GivenRecording, Recording, names_of, with_camera, with_videos
from gsba.pipeline.run import Evidence, Journal, RecordingEvidence, Run
from gsba.pipeline.stage_titles import title_of
from gsba.pipeline.state import State
from gsba.placement import check
from gsba.report.html import add_odometry
from gsba.report.time_left import LoggedTimeLeft, tell_size
from gsba.store import cluster
from gsba.store.store import RunStore
from gsba.trajectory.conventions import Convention
from gsba.trajectory.misread import TurnedAboutForwardError
from gsba.types import CoarsePoses, FrameSet, Reconstruction, RunStart, VerifiedPairs

if TYPE_CHECKING:
    from distributed import Client

logger = logging.getLogger(__name__)
T = TypeVar("T")

__all__ = ["RunResult", "refine", "refine_each", "refine_recordings", "solve"]


@threadpool_limits.wrap(limits=1, user_api="blas")  # frames have threads; sums keep their order
def refine(
    frames: Path | str,
    trajectory: Path | str | Sequence[Path | str] | None,
    out: Path | str,
    settings: RefineSettings | None = None,
    *,
    keyframes: Path | None = None,
    masks: merging.Masks = merging.AUTO,
    segment: Segment | None = None,
    timestamps: Path | None = None,
    fps: float | None = None,
    calibration: Path | None = None,
    circles: Sequence[tuple[float, float, float]] = (),
    imu: Path | None = None,
    odometry: bool | None = None,
    fresh: bool = False,
    families: Sequence[Family] = (),
    client: "Client | None" = None,
) -> RunResult:
    """Refine the pose of every frame, and write poses, cloud, report and datasets to `out`.

    Args:
        frames: folder of panoramas, raw fisheyes, .360 tracks or cube faces; or a video.
        trajectory: T_world_rig, see `gsba.trajectory`. Several are pieces of one run on one clock,
            and the first one's world is kept. None = start from the images alone.
        out: folder of the run; a second call re-runs what depends on settings that changed.
        settings: see `gsba.config`.
        keyframes: trajectory file of the same run's keyframes: they lead.
        masks: a file or a folder, "auto" and other words, or several: see `merging.choose`.
        segment: a command or a callable that masks faces; see `gsba.masks.segmentation.segmented`.
        timestamps: times of the frames (and of a KITTI trajectory's rows).
        fps: frames per second, where no file gives times; of a video: frames kept per second.
        calibration, circles: of the lenses of raw fisheyes; see `frames.scan`.
        imu: a gyro's and an accelerometer's, see `gsba.imu.files`; None = those of a raw video.
        odometry: follow a video without a trajectory; None = if it is open which frames to take.
        fresh: forget an earlier run in `out`.
        families: residuals of your own, see `gsba.Family`, beside those of settings.factors.
        client: of a Dask scheduler whose workers take shards of stages; None = threads here.

    Raises:
        GsbaError: an input or setting that cannot be used.
    """
    out, settings = Path(out), settings or RefineSettings()
    own = keyframes, masks, timestamps, fps, calibration, circles, imu, odometry
    recording = Recording(frames, trajectory, "", *own)
    one = GivenRecording.of(recording, "", Convention.parse(settings.read.trajectory_format))
    settings = with_camera(settings, [one])
    check(settings.placement, baseline=settings.camera.baseline())
    chosen, readings = merging.choose(masks, segment), inputs.read_gyro(imu, one.folder)
    origin, source, left = one.files, one.folder, LoggedTimeLeft()
    with following(left):
        (one,), fresh, extracted = with_videos([one], out, origin, settings, fresh)
    start = RunStart.TRAJECTORY
    if one.walk is not None:  # made of these very images: no evidence beside them
        start, settings = RunStart.ODOMETRY, inputs.for_odometry(settings)
    found = one.scanned()
    timed = tuple(inputs.timed(one.trajectories, found))
    evidence = Evidence(timed, readings, families=tuple(families), start=start)
    begin = Start.of(found, evidence, settings)
    hired = cluster.hire(client, one.folder, settings)
    with RunStore(out, origin, fresh, hired, title_of) as store, following(left):
        store.records.update(extracted)  # their time is the run's, too
        return refine_from(store, settings, chosen, evidence, begin, source, one.walk)


@threadpool_limits.wrap(limits=1, user_api="blas")  # frames have threads; sums keep their order
def refine_recordings(
    recordings: Sequence[Recording],
    out: Path | str,
    settings: RefineSettings | None = None,
    *,
    segment: Segment | None = None,
    fresh: bool = False,
    families: Sequence[Family] = (),
    client: "Client | None" = None,
) -> RunResult:
    """Refine the poses of several recordings of a place in one world with one scale.

    Recordings are joined by the places that they share; those that share none stay maps of their
    own. The world is that of the first recording with a trajectory.

    Args:
        recordings: at least two, each on a clock of its own. Those of one layout, size and
            calibration are of one camera, unless they name different ones.
        out, settings, segment, fresh, families, client: see `gsba.refine`.

    Raises:
        GsbaError: a recording or a setting that cannot be used; the message names the recording.
    """
    if len(recordings) < 2:
        raise GsbaError("give two recordings or more; gsba.refine refines one")
    given = {"segment": segment, "fresh": fresh, "families": families, "client": client}
    return refine_each(recordings, Path(out), settings, **given)


def refine_each(
    recordings: Sequence[Recording],
    out: Path,
    settings: RefineSettings | None = None,
    *,
    segment: Segment | None = None,
    fresh: bool = False,
    families: Sequence[Family] = (),
    client: "Client | None" = None,
    adapt: Callable[[Mapping[str, FrameSet]], Mapping[str, tuple[FrameSet, CameraSettings]]]
    | None = None,
) -> RunResult:
    """Refine recordings, one or more, in one run as `refine_recordings` does. `adapt` gives frames
    as they are to be read, and settings of their camera, from frames by the name of their
    recording."""
    plain = settings or RefineSettings()
    convention = Convention.parse(plain.read.trajectory_format)
    given = [
        GivenRecording.of(one, name, convention)
        for one, name in zip(recordings, names_of(recordings), strict=True)
    ]
    settings = with_camera(plain, given)
    check(settings.placement, baseline=settings.camera.baseline())
    chosen = merging.Choice.joined(
        {one.name: merging.choose(one.recording.masks, segment) for one in given}
    )
    origin = {name: path for one in given for name, path in one.files.items()}
    given, fresh, extracted = with_videos(given, out, origin, settings, fresh)
    found = {one.name: one.scanned() for one in given}
    plain_of = dict.fromkeys(found, plain)
    if adapt is not None:
        read = adapt(found)
        found = {name: frames for name, (frames, _) in read.items()}
        plain_of = {
            name: plain.model_copy(update={"camera": own}) for name, (_, own) in read.items()
        }
        settings = with_camera(plain_of[given[0].name], given)
    if any(one.walk for one in given):  # no evidence beside the images that they are made of
        settings = settings.with_faint_priors()
    models = {one.name: one.recording.camera for one in given}
    frames = combine(found, {name: model for name, model in models.items() if model})
    evidence = Evidence(
        families=tuple(families),
        recordings=tuple(
            one.evidence(found[one.name], settings, plain_of[one.name]) for one in given
        ),
    )
    start = Start.of(frames, evidence, settings)
    hired = cluster.hire(client, frames.paths[0][0], settings)
    with RunStore(out, origin, fresh, hired, title_of) as store:
        store.records.update(extracted)  # their time is the run's, too
        return refine_from(store, settings, chosen, evidence, start, given[0].folder, None)


@dataclass(frozen=True, slots=True)
class Start:
    """Frames, where trajectories put them, and what else is known of them."""

    frames: FrameSet
    coarse: CoarsePoses
    evidence: Evidence

    @classmethod
    def of(cls, frames: FrameSet, evidence: Evidence, settings: RefineSettings) -> "Start":
        """With the GPS fixes and the families of packages that settings ask for."""
        made = inputs.families_of(frames, settings)
        if evidence.recordings:
            coarse = each_recording.joined_poses([one.coarse for one in evidence.recordings])
        else:
            coarse = inputs.coarse_poses(frames, evidence.trajectories, settings)
        return cls(frames, coarse, replace(evidence, families=(*made, *evidence.families)))

    def on(self, frames: FrameSet, settings: RefineSettings) -> "Start":
        """The start with its frames (F,) as given: with other masks, or stills in another order,
        for which GPS fixes and families of packages are made anew, as they number frames."""
        families = self.evidence.families
        if frames.names != self.frames.names:
            made = inputs.families_of(frames, settings)
            families = (*made, *families[len(made) :])
        return replace(self, frames=frames, evidence=replace(self.evidence, families=families))

    def without(
        self, blank: tuple[str, ...], odd: tuple[str, ...], settings: RefineSettings
    ) -> "Start":
        """The start without unusable frames, which it lists."""
        if not blank and not odd:
            return self
        kept = np.array([name not in (*blank, *odd) for name in self.frames.names])
        rows, recordings = np.flatnonzero(kept), list[RecordingEvidence]()
        for one in self.evidence.recordings:
            own = np.flatnonzero(kept[self.frames.recordings[one.name]])
            recordings.append(replace(one, coarse=one.coarse.taken(own)))
        left = self.on(self.frames.taken(rows), settings)
        evidence = replace(left.evidence, recordings=tuple(recordings), blank=blank, odd=odd)
        return replace(left, coarse=self.coarse.taken(rows), evidence=evidence)

    def ready(self, store: RunStore, settings: RefineSettings) -> "Start":
        """The start as earlier attempts have found: without unusable frames, and stills in their
        order."""
        known = unusable_frames.known(store, self.frames, self.coarse, self.evidence, settings)
        left = self.without(*known, settings)
        return left.on(tour.in_known_order(store, left.frames, settings), settings)


def refine_from(
    store: RunStore,
    settings: RefineSettings,
    chosen: merging.Choice,
    given: Evidence,
    start: Start,
    source: Path,
    walk: Odometry | None,
) -> RunResult:
    """Run all stages, from frames to written outputs; `walk` is the odometry that chose the
    frames."""
    compile_ahead("refine")
    warn_of_repeats(start.frames)
    if walk is not None:
        # The start with more frames of a video where the map of features is weak
        if start.coarse.segments is not None:
            acceptance.refuse_vehicle_in_pieces(_begin(store, settings, chosen, start).frames)

        def measure(some: FrameSet) -> Prior:
            run = _begin(store, settings, chosen, Start.of(some, given, settings))
            return _map_features(frontend.extract(run)).prior

        frames = start.frames
        segmented = callable(chosen.segment) or chosen.segment
        known = [chosen.carrier, chosen.distractors, start.evidence.digests(), segmented]
        whole = densify.fetch_where_weak(store, source, walk, frames, settings, measure, known)
        start = start if whole is frames else Start.of(whole, given, settings)
    state, result = _attempted(
        lambda: _begin(store, settings, chosen, start),
        lambda run: _solve_or_turn(run, walk is not None),
    )
    lenses = camera.keep_lenses(state, result)
    finished_run.keep(state)
    written = outputs.write(state, result, lenses)
    if walk is not None:
        add_odometry(written.out / "report.html", walk)
    return written


def _attempted(begin: Callable[[], Run], solution: Callable[[Run], T]) -> T:
    """A run's solution; where a run finds unusable frames, or the order of stills, that of another
    run, which begins with what the first one has found."""
    for _ in range(3):  # frames without keypoints, without matches, and the order
        with suppress(unusable_frames.UnusableFramesError, tour.OrderFoundError):
            return solution(begin())
    return solution(begin())


def _solve_or_turn(run: Run, followed: bool) -> tuple[State, Reconstruction]:
    """The last state and its result; rotations alone where only a turn on the spot is proved."""
    try:
        state = _solve_raw(run)
        result = backend.reconstruct(state)
        if followed or state.prior.absent:  # the images alone have to show motion
            acceptance.require_motion(run.frames, result)
        return state, result
    except acceptance.NoPositions as error:
        if run.evidence.recordings or not (followed or run.coarse.absent):
            raise
        turn = frontend.prove_turn(frontend.extract(run))
        if turn is None:
            raise
        logger.warning("%s", error)
    logger.warning("most matches agree on rotations, over all gaps: rotations alone are refined")
    result = backend.reconstruct(turn)
    acceptance.require_motion(run.frames, result)  # a vehicle seems to turn on the spot
    return turn, result


def _begin(store: RunStore, settings: RefineSettings, chosen: merging.Choice, start: Start) -> Run:
    by_odometry = start.evidence.start is RunStart.ODOMETRY
    width = max(kind.panorama_width for kind in start.frames.formats)
    given = not (start.coarse.absent or by_odometry)
    tell_size(settings, start.frames, width, given)
    journal, frames = Journal(), merging.before(store, start.frames, chosen)
    if chosen.distractors:
        frames = _without_distractors(store, settings, chosen, start.on(frames, settings), journal)
    start = start.on(frames, settings).ready(store, settings)
    return Run.begin(store, start.frames, start.coarse, settings, start.evidence, journal)


def _without_distractors(
    store: RunStore,
    settings: RefineSettings,
    chosen: merging.Choice,
    start: Start,
    journal: Journal,
) -> FrameSet:
    """The frames, in the order given, with masks of what a first, plainer solution does not
    explain."""
    plainer = settings.plainer()
    direct.check(start.frames, settings)  # before the first solution, not after

    def begin() -> Run:
        first = start.ready(store, plainer)
        # Drift over the whole path does not show in what frames near one another do not explain.
        near = tuple(family for family in first.evidence.families if not family.limits_drift)
        evidence = replace(first.evidence, imu=None, families=near)
        return Run.begin(store, first.frames, first.coarse, plainer, evidence)

    with store.named("first"):
        run, state = _attempted(begin, lambda run: (run, solve(frontend.extract(run))))
    if state.prior.turning_only:
        return start.frames
    first = f"first-{run.latest[0]}"
    masked, counts = merging.after(store, run.frames, chosen, state.solution, first)
    journal.note("distractors", counts)
    masks = dict(zip(start.frames.names, start.frames.mask_paths, strict=True))
    masks |= dict(zip(masked.names, masked.mask_paths, strict=True))
    return replace(start.frames, mask_paths=tuple(masks.values()))


def _solve_raw(run: Run) -> State:
    """The method; raw pairs cut anew by what their lenses turned out to be, if that is far off."""
    evidence = run.evidence
    known = [run.settings.model_dump(exclude={"export", "placement"}), run.families.digests()]
    known += [] if evidence.imu is None else [evidence.imu.digest]
    counts, frames = dict(run.journal.counts), run.frames
    n, best = 0, None  # the pass before: the stage it rests on, number of steps without matches,
    # state, records of its stages
    while True:
        name, after, better = f"recut{n}", list(run.latest), None
        kept = run.store.stored(f"{name}_undone", known, bool, after)
        if any(kind.fisheyes is not None for kind in frames.formats) and not kept:
            better = run.store.stored(name, known, camera.Cuts, after)
        if better is None:
            try:
                state = solve(frontend.extract(run))
            except TurnedAboutForwardError as error:
                lenses = frames.formats[0].fisheyes
                if n or len(frames.formats) > 1 or lenses is None:
                    raise
                logger.info(
                    "raw pictures are turned against the trajectory about its forward axis: "
                    "cut anew"
                )
                better = ((turned(lenses, error.ours_R_theirs), False),)
            else:
                unseen = int(state.prior.trust.unseen_steps.sum())
                if best is not None and unseen > best[1]:
                    logger.info("frames cut anew match at fewer steps: the pass before is kept")
                    before, _, state, records = best
                    # Frames, stages and features on disk become those of the pass that is kept
                    passed = state.run
                    given = passed.frames, run.coarse, run.settings, evidence
                    Run.begin(run.store, *given, lenses_found=passed.lenses_found)
                    run.store.records.update(records)
                    run.store.stage(f"recut{n - 1}_undone", known, lambda: True, bool, before)
                    for frame, features in zip(frames.names, state.observed.features, strict=True):
                        features[frame]
                    return state
                best, last = (after, unseen, state, dict(run.store.records)), bool(kept) or n == 2
                better = None if last else camera.better_calibration(run.coarse, state.map)
                if better is None:
                    return state
            run.store.stage(name, known, lambda found=better: found, camera.Cuts, after)
        n, found = n + 1, tuple(bool(cut and cut[1]) for cut in better)
        again = Journal(dict(counts))
        frames = frames.with_formats(
            [
                kind
                if cut is None
                else replace(
                    kind, fisheyes=cut[0], lenses_nominal=kind.lenses_nominal and not cut[1]
                )
                for kind, cut in zip(frames.formats, better, strict=True)
            ]
        )
        cameras = [c for c, cut in enumerate(better) if cut is not None]
        frames = merging.recut(run.store, frames, n, cameras)
        run = Run.begin(run.store, frames, run.coarse, run.settings, evidence, again, found)


def solve(state: State) -> State:
    """The method: from keypoints and a coarse trajectory to poses and points.

    A stage takes a state and gives one. One that is optional is left out by leaving out its line.

    Args:
        state: keypoints of the frames and the trajectory, as `frontend.extract` gives it.

    Returns:
        The state with the final map; of a camera that only turned, a map without points.

    Raises:
        GsbaError: images that do not match, or that contradict the trajectory.
    """
    families = state.run.settings.direct_families()
    state = _map_features(state)
    if state.prior.turning_only:
        return state
    state = _add_keypoints_where_weak(state)
    # Known points are matched in all frames; lenses that neighbours hide may show then.
    state = _match_from_itself(state)
    if camera.sought_cameras(state, again=True):
        before = [bool(one.lenses) for one in state.map.cameras]
        state = camera.find_camera(state, "again_")
        if [bool(one.lenses) for one in state.map.cameras] != before:
            state = _match_from_itself(state, "again_")
    # Below a pixel: patches, pixels, splats.
    state = patch_rounds.align(state.with_verified(VerifiedPairs.none()))  # lets matches go
    if "photometric" in families:
        state = backend.refine_photometric(state)
    if "splat" in families:
        state = backend.refine_on_splat(state)
    state = frontend.align_gyro_to_map(state, "imu_final", with_noise=False)
    return camera.measure_camera(state)


def _map_features(state: State) -> State:
    """The map of all frames' features, without GPS fixes that its images contradict."""
    latest, run = list(state.run.latest), state.run
    mapped = _map_all(state)
    strength = mapped.prior.strength
    if strength is None or not strength.contradiction > backend.MAX_CONTRADICTION:
        return mapped
    mapped = _map_all(backend.without_fixes(state, latest))
    return replace(mapped, run=replace(mapped.run, suffix=run.suffix))


def _map_all(state: State) -> State:
    """One map of all frames' features, its camera, and its strength by images alone."""
    rounds = state.run.settings.rounds
    # Neighbours in time are matched; they check the trajectory and its clock.
    if state.run.evidence.recordings:
        state = each_recording.match_neighbours(state)
    else:
        state = frontend.match_neighbours(state)
        found = frontend.check_steps(state)
        state = tour.check_order(state, found)
        if (placed := tour.match_places(state, found)) is None:
            unusable_frames.refuse_odd(state, found)
            placed = frontend.judge_trajectory(state, found)
        state = placed
        state = frontend.align_gyro_to_neighbours(state)
    if state.prior.turning_only:
        return state
    # A chain of relative poses, then all points that neighbours share.
    state = backend.align_gauge(state, "gauge")
    gates = 60.0, 8.0  # standard deviations, from the coarse trajectory
    chain = backend.adjust(state, "chain", gates)
    # Without steps less plausible than the trajectory's.
    state = frontend.drop_implausible_steps(chain)
    state = chain if state is chain else backend.adjust(state, "chain2", gates)
    state = frontend.match_along_epipolars(state)
    state = frontend.match_known_points(state, "near", loops_closed=False)
    state = backend.adjust(state, "dense", rounds.dense)
    # One map, its loops closed, and the camera.
    parts = backend.separate_parts(state)
    if parts is not None:
        state = backend.merge_maps(state, parts)
        state = frontend.match_across(state, parts)
        state = backend.adjust(state, "joined", rounds.loops)
        state = frontend.match_along_epipolars(state, "adjacent2")
    state = frontend.close_loops(state)
    state = backend.align_gauge(state, "gauge_closed")
    state = backend.adjust(state, "closed", rounds.loops)
    state = frontend.align_gyro_to_map(state, "imu_closed")
    state = camera.find_camera(state)
    state = frontend.align_gyro_to_map(state, "imu_camera", with_noise=bool(state.map.lenses))
    return backend.measure_strength(state)


def _add_keypoints_where_weak(state: State) -> State:
    """Extract more keypoints at frames that images determine poorly, and adjust."""
    weak = state.prior.weak_frames()
    if state.run.settings.weak_frames.mode == "off" or state.observed.more or not weak.any():
        state.run.store.forget_frames(frontend.CLOSER)  # of an earlier call, or of lenses before
        return state
    state = frontend.extract_more(state, weak)
    state = frontend.match_along_epipolars(state, "adjacent_closer")
    state = backend.place_points(state, "placed_closer")
    state = frontend.match_known_points(state, "wide_closer")
    return backend.adjust(state, "dense_closer", state.run.settings.rounds.dense)


def _match_from_itself(state: State, prefix: str = "") -> State:
    rounds, patches = state.run.settings.rounds, state.run.settings.patches.rounds
    for n in range(1, rounds.map_passes + 1):
        state = frontend.match_known_points(state, f"{prefix}everywhere{n}")
        final = n == rounds.map_passes and not patches
        state = backend.adjust(state, f"{prefix}refined{n}", rounds.refined, final=final)
    return state
