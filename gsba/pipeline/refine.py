"""A run from frames and a coarse trajectory to refined poses, a cloud and datasets."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from threadpoolctl import threadpool_limits

from gsba import video
from gsba.bundle import self_calibration
from gsba.bundle.families import Family
from gsba.bundle.fixes import FrameFixes
from gsba.camera.fisheye import Pair, turned
from gsba.camera.lens import Lenses
from gsba.config import RefineSettings
from gsba.frames.dual_fisheye import SEAM
from gsba.frames.scan import scan
from gsba.imu.readings import Readings
from gsba.loop_closure import connectivity
from gsba.masks import merging
from gsba.masks.segmentation import Segment
from gsba.odometry import Odometry
from gsba.photometric import direct
from gsba.pipeline import acceptance, backend, densify, frontend, inputs, outputs, patch_rounds
from gsba.pipeline.frontend import ObservedFrames
from gsba.pipeline.map import Map
from gsba.pipeline.outputs import RunResult
from gsba.pipeline.prior import Prior
from gsba.pipeline.run import Journal, Run
from gsba.placement import check
from gsba.report.html import add_odometry
from gsba.store import cluster
from gsba.store.store import RunStore
from gsba.trajectory.axes import quarter_turn
from gsba.types import (
    CoarsePoses,
    FrameSet,
    Matches,
    PoseSource,
    Solution,
    Trajectory,
    VerifiedPairs,
)

if TYPE_CHECKING:
    from distributed import Client

logger = logging.getLogger(__name__)

_Cut = tuple[Pair, bool]
_PASSES = 3  # over raw pairs, from the pictures
_RECUT = np.deg2rad(0.03)  # change of what their pixels show that is worth another
_CALIBRATIONS = 4  # of raw lenses, and the map matched anew under them, at most
_CALIBRATED = np.deg2rad(0.01)  # change of what pixels show that is no more worth another

__all__ = ["RunResult", "refine", "solve"]


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
        trajectory: TUM, KITTI or stella_vslam map.msg; T_world_rig. Several are pieces of one run
            on one clock, and the first one's world is kept. None = start from the images alone.
        out: folder of the run; a second call re-runs what depends on settings that changed.
        settings: see `gsba.config`.
        keyframes: trajectory file of the same run's keyframes: they lead.
        masks: a file or a folder, "auto", "distractors", "none", or several: see `merging.choose`.
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
    frames, out = Path(frames), Path(out)
    settings = inputs.with_baseline(settings or RefineSettings(), calibration)
    check(settings.placement, baseline=settings.camera.baseline())
    chosen, readings = merging.choose(masks, segment), inputs.read_gyro(imu, frames)
    origin = {"frames": frames} | inputs.trajectory_files(trajectory, keyframes)
    given = inputs.read_trajectories(origin, timestamps)  # fails before hours of decoding
    walk, asked = None, (fps, fresh, odometry, chosen, calibration)
    if video.is_video(frames):
        given, settings, walk = inputs.take_frames(out, origin, given, settings, *asked)
        frames, timestamps, fps, fresh = out / "frames", None, None, False
    lenses = calibration, inputs.given_circles(circles, calibration)
    found = scan(frames, timestamps, fps, chosen.given, not given, *lenses)
    start = _start_of(found, given, settings)
    with RunStore(out, origin, fresh, cluster.hire(client, frames, settings)) as store:
        begin = partial(_begin, store, given, settings, chosen, families, readings)
        if walk is not None:
            start = _with_fetched(store, origin["frames"], walk, start, given, settings, begin)
        return _refine(*begin(start), given, len(origin) == 1, walk)


@dataclass(frozen=True, slots=True)
class _Start:
    """Frames and what is known of where they are."""

    frames: FrameSet
    coarse: CoarsePoses
    fixes: FrameFixes | None  # by GPS; None = there are none


def _start_of(frames: FrameSet, given: Sequence[Trajectory], settings: RefineSettings) -> _Start:
    fixes = inputs.positions_of(frames, settings)
    return _Start(frames, inputs.coarse_poses(frames, given, settings), fixes)


def _with_fetched(
    store: RunStore,
    video_file: Path,
    walk: Odometry,
    start: _Start,
    given: Sequence[Trajectory],
    settings: RefineSettings,
    begin: Callable[[_Start], tuple[Run, Prior]],
) -> _Start:
    """The start with more frames of a video where the map of features is weak."""

    def measure(some: FrameSet) -> Prior:
        run, prior = begin(_start_of(some, given, settings))
        return _map_features(run, frontend.extract(run), prior, given)[0]

    given_frames = start.frames
    whole = densify.fetch_where_weak(store, video_file, walk, given_frames, settings, measure)
    return start if whole is given_frames else _start_of(whole, given, settings)


def _begin(
    store: RunStore,
    given: Sequence[Trajectory],
    settings: RefineSettings,
    chosen: merging.Choice,
    families: Sequence[Family],
    readings: Readings | None,
    start: _Start,
) -> tuple[Run, Prior]:
    """A run on frames that are masked as asked, and what is believed of the trajectory at first."""
    families = [*families, *inputs.families_of(start.frames, settings)]
    coarse, journal = start.coarse, Journal()
    frames = merging.before(store, start.frames, chosen)
    if chosen.distractors:
        how = settings, journal, families
        frames = _without_distractors(store, frames, coarse, given, *how)
    sensors = readings, start.fixes, families
    run = Run.begin(store, frames, coarse, settings, journal, False, *sensors)
    return run, Prior.of(coarse)


def _refine(
    run: Run,
    prior: Prior,
    given: Sequence[Trajectory],
    images_alone: bool,
    walk: Odometry | None,
) -> RunResult:
    """A run from its frames to what it leaves behind, its video's odometry in the report."""
    in_pieces = prior.coarse.segments is not None
    run, seen, prior, world = _solve_raw(run, prior, given)
    result = backend.reconstruct(run, seen, prior, world)
    if images_alone or prior.absent:
        acceptance.require_motion(run.frames, result, in_pieces)
    lenses = backend.keep_lenses(run, world, result)
    written = outputs.write(run, prior, world, result, lenses)
    if walk is not None:
        add_odometry(written.out / "report.html", walk)
    return written


def _solve_raw(
    run: Run, prior: Prior, given: Sequence[Trajectory]
) -> tuple[Run, ObservedFrames, Prior, Map]:
    """The method; raw pairs anew, cut by what their lenses turned out to be, where that is far off.

    Returns:
        The run that it was in the end, its keypoints, and what `solve` gives.
    """
    known = [run.settings.model_dump(exclude={"export", "placement"}), run.families.digests()]
    known += [] if run.imu is None else [run.imu.digest]
    known += [] if run.fixes is None else [run.fixes.digest()]
    counts, frames = dict(run.journal.counts), run.frames
    n, best = 0, None  # the pass before: what it rests on, steps without matches, its result
    while True:
        name, after, better = f"recut{n}", run.chain.latest, None
        kept = run.store.stored(f"{name}_undone", known, bool, after)
        if frames.fisheyes is not None and not kept:
            better = run.store.stored(name, known, _Cut, after)
        if better is None:
            seen = frontend.extract(run)
            believed, world = solve(run, seen, prior, given)
            unseen = int(believed.trust.unseen_steps.sum())
            if best is not None and unseen > best[1]:
                logger.info("frames cut anew match at fewer steps: the pass before is kept")
                run.store.stage(f"recut{n - 1}_undone", known, lambda: True, bool, best[0])
                return best[2]
            best = after, unseen, (run, seen, believed, world)
            better = None if kept or n == _PASSES - 1 else _cut_better(prior.coarse, world)
            if better is None:
                return best[2]
            run.store.stage(name, known, lambda found=better: found, _Cut, after)
        n, (fisheyes, found) = n + 1, better
        again = Journal(dict(counts))
        frames = replace(frames, fisheyes=fisheyes, lenses_nominal=False)
        frames = merging.recut(run.store, frames, n)
        beside = run.imu, run.fixes, run.families.members
        run = Run.begin(run.store, frames, prior.coarse, run.settings, again, found, *beside)


def _cut_better(coarse: CoarsePoses, world: Map) -> _Cut | None:
    """What raw pairs are better cut by, in the trajectory's axes, and whether that was found, not
    given; None = they are cut well."""
    lenses = world.lenses
    if lenses.reference_calibration is None:
        return None
    found, turn = self_calibration.now(lenses), np.eye(3)
    if (coarse.sources == PoseSource.SLAM).any():
        turn = quarter_turn(coarse, world.solution.world_T_rigs)
    off = self_calibration.apart(lenses, replace(lenses, fisheyes=None))
    if off < _RECUT and np.array_equal(turn, np.eye(3)):
        return None
    logger.info("lenses are %.2f deg from what panoramas were cut by: all anew", np.rad2deg(off))
    return turned(found, turn), lenses.fisheyes is not None


def solve(
    run: Run, seen: ObservedFrames, prior: Prior, given: Sequence[Trajectory]
) -> tuple[Prior, Map]:
    """The method: from keypoints and a coarse trajectory to poses and points.

    A stage that is optional takes a map and gives one: it is left out by leaving out its line.

    Args:
        run: what no stage changes.
        seen: keypoints of the frames.
        prior: what is believed of the trajectory at first.
        given: its files, for a clock to be set right.

    Returns:
        What is believed in the end, and the map; of a camera that only turned one without points.

    Raises:
        GsbaError: images that do not match, or that contradict the trajectory.
    """
    families = run.settings.direct_families()
    prior, seen, world, along = _map_features(run, seen, prior, given)
    if prior.turning_only:
        return prior, world
    seen, solved, along = _look_closer(run, seen, prior, world.solution, along)
    # The map matched anew from itself; lenses that neighbours hide may show in it.
    solved, matches = _match_from_itself(run, seen, prior, solved, along)
    if not world.lenses and run.frames.fisheyes is None:
        seen, world = _find_camera(run, seen, prior, matches, solved, "again_")
        if world.lenses:
            solved, _ = _match_from_itself(run, seen, prior, world.solution, along, "again_")
    # Below a pixel: patches, pixels, splats.
    world = replace(world, solution=solved, observed=seen.shown)
    prior, world = patch_rounds.align(run, prior, world)
    if "photometric" in families:
        world = backend.refine_photometric(run, prior, world)
    if "splat" in families:
        world = backend.refine_on_splat(run, prior, world)
    prior = backend.align_imu(run, prior, world.solution, "imu_final", with_noise=False)
    return prior, backend.measure_camera(run, prior, world)


def _map_features(
    run: Run, seen: ObservedFrames, prior: Prior, given: Sequence[Trajectory]
) -> tuple[Prior, ObservedFrames, Map, Matches]:
    """One map of all frames' features, the camera that sees them, and how well images hold it.

    Returns:
        What is believed by then, the keypoints through that camera, the map, and the matches of
        neighbours.
    """
    rounds = run.settings.rounds
    # Neighbours in time, and what they say of the trajectory and its clock.
    prior, near = frontend.match_neighbours(run, seen, prior, given)
    prior, near = frontend.judge_trajectory(run, seen, prior, near)
    prior = frontend.align_imu(run, seen, prior, near)
    if prior.turning_only:
        return prior, seen, Map.of(prior.start(), seen.shown), near.matches
    # A chain of relative poses, then all that neighbours have in common.
    prior, start = backend.align_gauge(run, prior, prior.start(), "gauge")
    solved = backend.adjust(run, seen, prior, "chain", [near.matches], start, rounds.chain)
    along = frontend.match_along_epipolars(run, seen, solved)
    known = frontend.match_known_points(run, seen, solved, "near", loops_closed=False)
    solved = backend.adjust(run, seen, prior, "dense", [along, known], solved, rounds.dense)
    # One map, its loops closed, and the camera.
    prior, solved, matches = _merge_maps(run, seen, prior, near, solved, [along, known])
    prior, solved, loops = frontend.close_loops(run, seen, prior, solved)
    along, matches = matches[0], [*matches, loops]
    prior, solved = backend.align_gauge(run, prior, solved, "gauge_closed")
    solved = backend.adjust(run, seen, prior, "closed", matches, solved, rounds.loops)
    prior = backend.align_imu(run, prior, solved, "imu_closed")
    seen, world = _find_camera(run, seen, prior, matches, solved)
    solved = world.solution
    prior = backend.align_imu(run, prior, solved, "imu_camera", with_noise=bool(world.lenses))
    prior = backend.measure_strength(run, seen, prior, solved)
    return prior, seen, world, along


def _match_from_itself(
    run: Run, seen: ObservedFrames, prior: Prior, solved: Solution, along: Matches, prefix: str = ""
) -> tuple[Solution, list[Matches]]:
    """The map after its own points were looked for everywhere, and the matches it is made of."""
    rounds, matches = run.settings.rounds, [along]
    for n in range(1, rounds.map_passes + 1):
        wide = frontend.match_known_points(run, seen, solved, f"{prefix}everywhere{n}")
        final = n == rounds.map_passes and not run.settings.patches.rounds
        name, matches = f"{prefix}refined{n}", [along, wide]
        solved = backend.adjust(run, seen, prior, name, matches, solved, rounds.refined, final)
    return solved, matches


def _merge_maps(
    run: Run,
    seen: ObservedFrames,
    prior: Prior,
    near: VerifiedPairs,
    solved: Solution,
    matches: list[Matches],
) -> tuple[Prior, Solution, list[Matches]]:
    """Parts of the map that nothing ties together, joined where they meet; and their matches."""
    parts = backend.scattered(run, prior, near, solved)
    if parts is None:
        return prior, solved, matches
    prior, merged = backend.merge_maps(run, seen, prior, solved, parts)
    across = frontend.match_across(run, seen, merged, parts)
    along, known = (connectivity.within(some, parts) for some in matches)
    matches, gates = [along, known, across], run.settings.rounds.loops
    solved = backend.adjust(run, seen, prior, "joined", matches, merged.solved, gates)
    along = frontend.match_along_epipolars(run, seen, solved, "adjacent2")
    return prior, solved, [along, known, across]


def _find_camera(
    run: Run,
    seen: ObservedFrames,
    prior: Prior,
    matches: Sequence[Matches],
    solved: Solution,
    prefix: str = "",
) -> tuple[ObservedFrames, Map]:
    """Lenses and readout, before gates take what tells of them; and the map that these give.

    Args:
        prefix: of the names of stages.
    """
    settings = run.settings
    if settings.camera.model == "central" or not run.frames.panoramic:
        return seen, Map.of(solved, seen.shown)
    if run.frames.fisheyes is not None:
        return _find_raw_camera(run, seen, prior, matches, solved)
    looking = seen.through(Lenses())
    guess = None
    if not run.frames.lens_axes_known:
        guess = backend.guess_axes(run, looking, prior, f"{prefix}axes", matches, solved)
        looking = seen.through(guess.lenses)
    band, better, gates = np.deg2rad(settings.camera.seam_deg), solved, settings.rounds.loops
    looking = seen.through(replace(looking.lenses, band_rad=float(band)))
    for n in range(2):  # on trial, then judged by what is matched with them
        name = f"{prefix}lenses{n}"
        found = backend.find_lenses(run, looking, prior, name, matches, better)
        if not found.lenses:
            return seen, Map.of(solved, seen.shown, found)
        looking, name = seen.through(found.lenses), f"{prefix}lensed{n}"
        better = backend.adjust(run, looking, prior, name, matches, better, gates)
        gates = settings.rounds.dense
        if n == 0:
            name = f"{prefix}adjacent_lenses"
            along = frontend.match_along_epipolars(run, looking, better, name)
            wide = frontend.match_known_points(run, looking, better, f"{prefix}wide_lenses")
            matches = [along, wide]
    name = f"{prefix}stitch_radius"
    radius = backend.find_stitch_radius(run, looking, prior, name, matches, better)
    if not radius.reason:
        looking, name = seen.through(radius.lenses), f"{prefix}lensed2"
        better = backend.adjust(run, looking, prior, name, matches, better, gates)
    world = replace(Map.of(better, seen.shown, found), axes=guess, radius=radius)
    return _settle_camera(run, looking, prior, matches, world, f"{prefix}settled")


def _find_raw_camera(
    run: Run, seen: ObservedFrames, prior: Prior, matches: Sequence[Matches], solved: Solution
) -> tuple[ObservedFrames, Map]:
    """As `_find_camera`, of raw pairs: where their lenses are, and what they are."""
    looking = seen.through(Lenses(band_rad=float(SEAM), reference_calibration=run.frames.fisheyes))
    better, gates = solved, run.settings.rounds.loops
    for n in range(2):
        found = backend.find_lenses(run, looking, prior, f"lenses{n}", matches, better)
        looking = seen.through(found.lenses)
        better = backend.adjust(run, looking, prior, f"lensed{n}", matches, better, gates)
        gates = run.settings.rounds.dense
    world = Map.of(better, seen.shown, found)
    looking, world = _settle_camera(run, looking, prior, matches, world, "settled")
    if run.lenses_found:  # patches say more of them than features do
        read = world.camera()
        free = replace(read.lenses, fisheyes=read.lenses.reference_calibration)
        return looking, world.with_camera(replace(read, lenses=free))
    known = backend.self_calibrate_lenses(
        run, looking, prior, "calibrated", matches, world.solution
    )
    world = replace(world, calibrated=known)
    if known.reason:
        return looking, world
    world = world.with_camera(replace(world.camera(), lenses=known.lenses))
    looking = seen.through(world.lenses)
    looking, world = _settle_camera(run, looking, prior, matches, world, "recalibrated")
    for n in range(_CALIBRATIONS):
        before, solved = world.lenses, world.solution
        along = frontend.match_along_epipolars(run, looking, solved, f"adjacent_raw{n}")
        wide = frontend.match_known_points(run, looking, solved, f"wide_raw{n}")
        matches, name = [along, wide], f"calibrated{n}"
        looking, world = _settle_camera(run, looking, prior, matches, world, name)
        if self_calibration.apart(before, world.lenses) < _CALIBRATED:
            break
    return looking, world


def _settle_camera(
    run: Run,
    looking: ObservedFrames,
    prior: Prior,
    matches: Sequence[Matches],
    world: Map,
    name: str,
) -> tuple[ObservedFrames, Map]:
    """All that is known of the camera found together, how rows are read first."""
    solved, read = world.solution, world.camera()
    if read.lenses.readout_motion is None:
        read = backend.find_readout(run, looking, prior, f"{name}_readout", matches, solved)
    looking = looking.through(read.lenses)
    solved, read = backend.settle_camera(run, looking, prior, name, matches, solved, read)
    return looking.through(read.lenses), replace(world, solution=solved).with_camera(read)


def _look_closer(
    run: Run, seen: ObservedFrames, prior: Prior, solved: Solution, along: Matches
) -> tuple[ObservedFrames, Solution, Matches]:
    """More keypoints where images hold the map poorly, and the map that these give."""
    weak = prior.weak_frames()
    if run.settings.weak_frames.mode == "off" or not weak.any():
        return seen, solved, along
    seen = frontend.extract_more(run, seen, weak)
    along = frontend.match_along_epipolars(run, seen, solved, "adjacent_closer")
    placed = backend.place(run, seen, prior, "placed_closer", [along], solved)
    wide = frontend.match_known_points(run, seen, placed, "wide_closer")
    gates = run.settings.rounds.dense
    solved = backend.adjust(run, seen, prior, "dense_closer", [along, wide], placed, gates)
    return seen, solved, along


def _without_distractors(
    store: RunStore,
    frames: FrameSet,
    coarse: CoarsePoses,
    given: Sequence[Trajectory],
    settings: RefineSettings,
    journal: Journal,
    families: Sequence[Family],
) -> FrameSet:
    """Frames without what a first solution, plainer than the last, does not explain."""
    direct.check(frames, settings)  # before the first solution, not after
    with store.named("first"):
        run = Run.begin(store, frames, coarse, settings.plainer(), families=families)
        prior, world = solve(run, frontend.extract(run), Prior.of(coarse), given)
    if prior.turning_only:
        return frames
    first = f"first-{run.chain.latest[0]}"
    frames, counts = merging.after(store, frames, world.solution, first)
    journal.note("distractors", counts)
    return frames
