"""A run from frames and a coarse trajectory to refined poses, a cloud and datasets."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsba import masking, photometric, read, video
from gsba.adjust import Adjustment
from gsba.config import RefineSettings
from gsba.config_file import to_toml
from gsba.export import ExportFormat, export, write_points
from gsba.line import ExtraFactors, Line
from gsba.log import GsbaError
from gsba.misfit import refuse_useless
from gsba.motion import describe
from gsba.placement import EXIF, Placement, check, place
from gsba.report import build_report, take_notes, write_poses, write_report
from gsba.report_html import write_html
from gsba.segment import Segment
from gsba.store import RunStore, atomic_write, load_stage
from gsba.types import CoarsePoses, Counts, FrameSet, PoseSource, Reconstruction, Trajectory

logger = logging.getLogger(__name__)

_GAUGE = (
    "Sim(3)-aligned to the coarse trajectory over its refined SLAM poses: its world and scale; "
    "covariances hold the first pose and the distance to the frame furthest from it"
)
_OUTPUTS = (
    "trajectory.tum",
    "coarse.tum",
    "poses.csv",
    "points.ply",
    "config.toml",
    "report.json",
    "report.html",
)
_OWN_GAUGE = (
    "no trajectory: the first frame's axes, and the median step of the start as the unit; "
    "covariances hold the first pose and the distance to the frame furthest from it"
)


@dataclass(frozen=True, slots=True)
class RunResult:
    """What `refine` leaves in memory; the rest is in the run's folder."""

    out: Path
    frames: FrameSet
    coarse: CoarsePoses  # before
    reconstruction: Reconstruction  # after
    report: dict[str, Any]  # the content of report.json


def refine(
    frames: Path | str,
    trajectory: Path | str | None,
    out: Path | str,
    settings: RefineSettings | None = None,
    *,
    keyframes: Path | None = None,
    masks: masking.Masks = None,
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
        trajectory: TUM, KITTI or stella_vslam map.msg; T_world_rig. None = start from the images
            alone: the first step's length is the unit and the first frame the world.
        out: folder of the run.
        settings: see `gsba.config`.
        keyframes: second trajectory file of the same run, with its keyframes: they lead.
        masks: one ERP mask for all frames, or a folder of one for each; white = use; "carrier" (or
            "auto") to find what carries the camera, "distractors" for what moves by itself; or
            several of these.
        segment: a command or a callable that masks faces; see `gsba.segment.segmented`.
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
    chosen = masking.choose(masks, segment)
    paths = {"trajectory": trajectory, "keyframes": keyframes}
    origin |= {name: Path(path) for name, path in paths.items() if path is not None}
    given = _given(origin, timestamps)  # fails before hours of decoding, not after
    if video.is_video(frames):
        _extract(out, origin, settings, fps, fresh)
        frame_set, fresh = read.scan(out / "frames", masks=chosen.given), False
    else:
        frame_set = read.scan(frames, timestamps, fps, chosen.given)
    check(settings.placement, frame_set)
    coarse = _coarse(frame_set, given, settings)
    with RunStore(out, origin, fresh) as store:
        frame_set, counts = masking.before(store, frame_set, chosen), {}
        if chosen.distractors:
            frame_set, counts = _without_distractors(store, frame_set, coarse, settings)
        line = Line(store, frame_set, coarse, settings, extra_factors)
        line.counts |= counts
        return _write(line, line.reconstruct(_solve(line, settings)))


def _solve(line: Line, settings: RefineSettings) -> Adjustment:
    """All stages from the coarse trajectory to the last solution."""
    neighbours, rounds = line.judge(line.match_neighbours()), settings.rounds
    solved = line.solve("chain", [neighbours.matches], line.start(), rounds.chain)
    adjacent = line.match_along_epipolars(solved)
    near = line.match_known_points("near", solved, loops_closed=False)
    solved = line.solve("dense", [adjacent, near], solved, rounds.dense)
    loops, solved = line.close_loops(solved)
    solved = line.solve("closed", [adjacent, near, loops.matches], solved, rounds.loops)
    for number in range(1, rounds.map_passes + 1):
        wide = line.match_known_points(f"everywhere{number}", solved, loops_closed=True)
        final = number == rounds.map_passes and settings.align.rounds == 0
        solved = line.solve(f"refined{number}", [adjacent, wide], solved, rounds.refined, final)
    for number in range(1, settings.align.rounds + 1):
        solved = line.solve_aligned(number, line.align(number, solved), solved)
    if "photometric" in settings.factors:
        solved = line.solve_photometric(solved)
    return solved


def _given(origin: Mapping[str, Path], timestamps: Path | None) -> Trajectory | None:
    """The trajectory of the files of a run, if any."""
    if "trajectory" not in origin:
        return None
    trajectory = read.read_trajectory(origin["trajectory"], timestamps)
    if "keyframes" in origin:
        keyframes = read.read_trajectory(origin["keyframes"], timestamps)
        trajectory = read.follow_keyframes(trajectory, keyframes)
    return trajectory


def _coarse(frames: FrameSet, given: Trajectory | None, settings: RefineSettings) -> CoarsePoses:
    """Start poses of frames, refused where no video could have them."""
    if given is None:
        return read.without_trajectory(frames)
    coarse = read.associate(frames, given, settings.read)
    refuse_useless(coarse)
    if np.ptp(coarse.world_T_rigs[:, :3, 3], axis=0).max() == 0:
        logger.warning("the trajectory only turns: positions come from the images alone")
        return read.without_trajectory(frames)
    return coarse


def load_run(out: Path) -> tuple[Reconstruction, FrameSet]:
    """Result of a finished run and the frames it was made from.

    Raises:
        GsbaError: `out` is no finished run.
    """
    reconstruction = load_stage(out, "reconstruction", Reconstruction)
    return reconstruction, load_stage(out, "frames", FrameSet)


def _extract(
    out: Path, origin: dict[str, Path], settings: RefineSettings, fps: float | None, fresh: bool
) -> None:
    """Write the frames of the video that a run is about to `out`/frames."""
    chosen = settings.video
    if settings.placement.gps == EXIF:
        raise GsbaError("--gps exif: a video's frames have no tags; give positions as a file")
    if fps is not None:
        if not fps > 0:
            raise GsbaError(f"--fps {fps}: must be a positive number of frames per second")
        chosen = chosen.model_copy(update={"fps": fps, "every": None, "at": None})
    with RunStore(out, origin, fresh) as store:
        video.extract(origin["frames"], out / "frames", chosen, replace=True)
        store.claim(out / "frames")


def _without_distractors(
    store: RunStore, frames: FrameSet, coarse: CoarsePoses, settings: RefineSettings
) -> tuple[FrameSet, dict[str, list[Counts]]]:
    """Frames without what a first solution, plainer than the last, does not explain."""
    photometric.check(frames, settings)  # before the first solution, not after
    plain = settings.model_copy(
        update={
            "align": settings.align.model_copy(update={"rounds": 0}),
            "factors": tuple(name for name in settings.factors if name != "photometric"),
        }
    )
    with store.named("first"):
        line = Line(store, frames, coarse, plain, None)
        solved = _solve(line, plain)
    after, threads = f"first-{line.latest}", line.num_threads
    frames, counts = masking.after(store, frames, solved, after, threads)
    return frames, {"distractors": [counts]}


def _write(line: Line, reconstruction: Reconstruction) -> RunResult:
    """Poses, cloud, report and datasets."""
    store, settings, frames, coarse = line.store, line.settings, line.frames, line.coarse
    out = store.root
    trajectory = Trajectory(frames.timestamps, reconstruction.world_T_rigs)
    read.write_tum(out / "trajectory.tum", trajectory)
    (out / "coarse.tum").unlink(missing_ok=True)
    if (coarse.sources != PoseSource.NONE).any():
        read.write_tum(out / "coarse.tum", Trajectory(frames.timestamps, coarse.world_T_rigs))
    write_poses(out / "poses.csv", frames, coarse, reconstruction)
    write_points(out / "points.ply", reconstruction)
    atomic_write(out / "config.toml", lambda path: path.write_text(to_toml(settings)))
    placement = place(reconstruction, frames, settings.placement)
    for name in settings.export.formats:
        _export(line, ExportFormat(name), reconstruction, placement)
    undone = [n for n, s in line.solutions.items() if not all(r.accepted for r in s.rounds)]
    undone += [name for name in line.undone if name not in undone]
    judgement, findings = describe(line.trust, frames) if line.trust else ({}, [])
    notes = findings + take_notes(frames, coarse, reconstruction, undone, line.frame_weights)
    report = build_report(
        settings=settings,
        frames=frames,
        coarse=coarse,
        reconstruction=reconstruction,
        stages=store.records.values(),
        counts=line.counts,
        solver=[{"stage": name, "rounds": s.rounds} for name, s in line.solutions.items()],
        gauge=_GAUGE if (coarse.sources != PoseSource.NONE).any() else _OWN_GAUGE,
        notes=notes,
        trajectory=judgement,
    )
    write_report(out / "report.json", report)
    write_html(out / "report.html", frames, coarse, reconstruction, report)
    for name in _OUTPUTS:
        store.claim(out / name)
    return RunResult(out, frames, coarse, reconstruction, report)


def _export(
    line: Line, to: ExportFormat, reconstruction: Reconstruction, placement: Placement
) -> None:
    folder, name = line.store.root / to.value, f"export-{to.value}"
    if not folder.exists():
        line.store.forget(name)

    def compute() -> Counts:
        size = line.settings.export.face_size
        export(reconstruction, line.frames, folder, to, size, placement)
        return Counts(len(line.frames), len(line.frames), "frames")

    key = [line.settings.export.face_size, placement.to_json()]
    line.store.stage(name, key, compute, Counts, [line.latest])
    line.store.claim(folder)
