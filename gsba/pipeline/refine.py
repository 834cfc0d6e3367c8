"""A run from frames and a coarse trajectory to refined poses, a cloud and datasets."""

from collections.abc import Sequence
from pathlib import Path

from threadpoolctl import threadpool_limits

from gsba import video
from gsba.bundle import rotation_only
from gsba.config import RefineSettings
from gsba.frames.scan import scan
from gsba.masks import merging
from gsba.masks.segmentation import Segment
from gsba.photometric import direct
from gsba.pipeline import inputs, outputs, timing
from gsba.pipeline.backend import Line
from gsba.pipeline.frontend import ExtraFactors
from gsba.pipeline.outputs import RunResult
from gsba.placement.placement import check
from gsba.store.finished import load_run
from gsba.store.store import RunStore
from gsba.types import (
    CoarsePoses,
    Counts,
    FrameSet,
    Reconstruction,
    Solution,
    Trajectory,
    VerifiedPairs,
)

__all__ = ["RunResult", "load_run", "refine"]


@threadpool_limits.wrap(limits=1, user_api="blas")  # frames have threads; sums keep their order
def refine(
    frames: Path | str,
    trajectory: Path | str | Sequence[Path | str] | None,
    out: Path | str,
    settings: RefineSettings | None = None,
    *,
    keyframes: Path | None = None,
    masks: merging.Masks = None,
    segment: Segment | None = None,
    timestamps: Path | None = None,
    fps: float | None = None,
    fresh: bool = False,
    extra_factors: ExtraFactors | None = None,
) -> RunResult:
    """Refine the pose of every frame, and write poses, cloud, report and datasets to `out`.

    A second call with the same `out` takes up finished stages; a changed setting re-runs what
    depends on it.

    Args:
        frames: folder of 2:1 panoramas or of cube faces, or a video, for `out`/frames.
        trajectory: TUM, KITTI or stella_vslam map.msg; T_world_rig. Several are pieces of one run
            on one clock, and the first one's world is kept. None = start from the images alone:
            the first step's length is the unit and the first frame the world.
        out: folder of the run.
        settings: see `gsba.config`.
        keyframes: second trajectory file of the same run, with its keyframes: they lead.
        masks: one ERP mask for all frames, or a folder of one for each, white = use; "carrier" (or
            "auto") and "distractors" to find what carries the camera or moves; or several of these.
        segment: a command or a callable that masks faces; see `gsba.masks.segmentation.segmented`.
        timestamps: times of the frames (and of a KITTI trajectory's rows).
        fps: frames per second, where no file gives times; of a video: frames kept per second.
        fresh: forget an earlier run in `out`.
        extra_factors: makes factors of your own on the keys graph.X(frame); they join every
            bundle adjustment (and those are then never resumed).

    Raises:
        GsbaError: an input or setting that cannot be used.
    """
    frames, out = Path(frames), Path(out)
    settings, origin = settings or RefineSettings(), {"frames": frames}
    check(settings.placement)
    chosen = merging.choose(masks, segment)
    origin |= inputs.trajectory_files(trajectory, keyframes)
    given = inputs.read_trajectories(origin, timestamps)  # fails before hours of decoding
    if video.is_video(frames):
        inputs.extract_frames(out, origin, settings, fps, fresh)
        frames, timestamps, fps, fresh = out / "frames", None, None, False
    frame_set = scan(frames, timestamps, fps, chosen.given, order_suffices=not given)
    check(settings.placement, frame_set)
    coarse = inputs.coarse_poses(frame_set, given, settings)
    with RunStore(out, origin, fresh) as store:
        frame_set, counts = merging.before(store, frame_set, chosen), {}
        if chosen.distractors:
            frame_set, counts = _without_distractors(store, frame_set, coarse, given, settings)
        line = Line(store, frame_set, coarse, settings, extra_factors)
        line.counts |= counts
        neighbours = _neighbours(line, given)
        found = _turned(line) if line.turns_only else line.reconstruct(_solve(line, neighbours))
        return outputs.write(line, found)


def _neighbours(line: Line, given: Sequence[Trajectory]) -> VerifiedPairs:
    """Neighbours in time, and what they say of the trajectory and its clock."""
    return line.judge(timing.match_neighbours(line, given, inputs.coarse_poses))


def _solve(line: Line, neighbours: VerifiedPairs) -> Solution:
    """All stages from verified neighbours to the last solution."""
    settings, rounds = line.settings, line.settings.rounds
    solved = line.solve("chain", [neighbours.matches], line.start(), rounds.chain)
    adjacent = line.match_along_epipolars(solved)
    near = line.match_known_points("near", solved, loops_closed=False)
    solved = line.solve("dense", [adjacent, near], solved, rounds.dense)
    solved, matches = line.register(neighbours, solved, [adjacent, near])
    loops, solved = line.close_loops(solved)
    solved = line.solve("closed", [*matches, loops.matches], solved, rounds.loops)
    solved, adjacent = line.look_closer(solved, matches[0])
    for number in range(1, rounds.map_passes + 1):
        wide = line.match_known_points(f"everywhere{number}", solved, loops_closed=True)
        final = number == rounds.map_passes and settings.align.rounds == 0
        solved = line.solve(f"refined{number}", [adjacent, wide], solved, rounds.refined, final)
    for number in range(1, settings.align.rounds + 1):
        sighted = line.align(number, solved)
        solved = line.straighten(number, sighted, line.solve_aligned(number, sighted, solved))
    if "photometric" in settings.factors:
        solved = line.solve_photometric(solved)
    if "splat" in settings.factors:
        solved = line.refine_on_splat(solved)
    return solved


def _turned(line: Line) -> Reconstruction:
    """Rotations alone, of a camera that stayed in one place."""
    settings = line.settings
    key = [settings.matching, settings.rounds.min_observations]

    def compute() -> Reconstruction:
        return rotation_only.run(line.context, line.start().world_T_rigs, line.coarse)

    return line.store.stage("reconstruction", key, compute, Reconstruction, [line.latest])


def _without_distractors(
    store: RunStore,
    frames: FrameSet,
    coarse: CoarsePoses,
    given: Sequence[Trajectory],
    settings: RefineSettings,
) -> tuple[FrameSet, dict[str, list[Counts]]]:
    """Frames without what a first solution, plainer than the last, does not explain."""
    direct.check(frames, settings)  # before the first solution, not after
    aligned = settings.align.model_copy(update={"rounds": 0})
    families = tuple(name for name in settings.factors if name not in ("photometric", "splat"))
    plain = settings.model_copy(update={"align": aligned, "factors": families})
    with store.named("first"):
        line = Line(store, frames, coarse, plain, None)
        neighbours = _neighbours(line, given)
        if line.turns_only:
            return frames, {}
        solved = _solve(line, neighbours)
    after, threads = f"first-{line.latest}", line.num_threads
    frames, counts = merging.after(store, frames, solved, after, threads)
    return frames, {"distractors": [counts]}
