"""A run from frames and a coarse trajectory to refined poses, a cloud and datasets."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsba import read, registered, tripod, video
from gsba.adjust import Adjustment
from gsba.carrier import Carrier, find_carrier, write_carrier
from gsba.components import largest, taken
from gsba.config import RefineSettings
from gsba.config_file import to_toml
from gsba.export import ExportFormat, export, write_points
from gsba.line import ExtraFactors, Line
from gsba.log import GsbaError
from gsba.misfit import refuse_useless
from gsba.motion import Trust, describe
from gsba.placement import Placement, check, place
from gsba.report import build_report, take_notes, write_poses, write_report
from gsba.report_html import write_html
from gsba.store import RunStore, atomic_write, fingerprint, load_stage
from gsba.types import (
    CoarsePoses,
    Counts,
    FrameSet,
    PoseSource,
    Reconstruction,
    Trajectory,
    VerifiedPairs,
)

logger = logging.getLogger(__name__)

_GAUGE = (
    "Sim(3)-aligned to the coarse trajectory over its refined SLAM poses: its world and scale; "
    "covariances hold the first pose and the distance to the frame furthest from it"
)
AUTO = "auto"  # in place of masks: find the carrier
_OUTPUTS = (
    "trajectory.tum",
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
    trajectory: Path | str | Sequence[Path | str] | None,
    out: Path | str,
    settings: RefineSettings | None = None,
    *,
    keyframes: Path | None = None,
    masks: Path | str | None = None,
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
        trajectory: TUM, KITTI or stella_vslam map.msg; T_world_rig. Several are pieces of one run,
            on one clock, each with a world and scale of its own: the first one's are kept. None =
            start from the images alone: the first step's length is the unit and the first frame
            the world.
        out: folder of the run.
        settings: see `gsba.config`.
        keyframes: second trajectory file of the same run, with its keyframes: they lead.
        masks: one ERP mask for all frames, or a folder of one for each; white = use; or "auto".
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
    mask_files = None if masks is None or masks == AUTO else Path(masks)
    origin |= _trajectories(trajectory, keyframes)
    given = _given(origin, timestamps)  # fails before hours of decoding, not after
    if video.is_video(frames):
        _extract(out, origin, settings, fps, fresh)
        frame_set, fresh = read.scan(out / "frames", masks=mask_files), False
    else:
        frame_set = read.scan(frames, timestamps, fps, mask_files)
    coarse = _coarse(frame_set, given, settings)
    with RunStore(out, origin, fresh) as store:
        if masks == AUTO:
            frame_set = _without_carrier(store, frame_set)
        line = Line(store, frame_set, coarse, settings, extra_factors)
        neighbours = line.judge(line.match_neighbours())
        if line.trust is not None and line.trust.turning_only:
            return _write(line, _turned(line, line.trust))
        return _write(line, line.reconstruct(_solve(line, neighbours, settings)))


def _turned(line: Line, trust: Trust) -> Reconstruction:
    """Rotations alone, of a camera that stayed in one place."""
    settings = line.settings
    key = [settings.matching, settings.rounds.min_observations]

    def compute() -> Reconstruction:
        return tripod.run(line.context, trust.world_T_rigs, line.coarse)

    return line.store.stage("reconstruction", key, compute, Reconstruction, [line.latest])


def _solve(line: Line, neighbours: VerifiedPairs, settings: RefineSettings) -> Adjustment:
    """All stages from verified neighbours to the last solution."""
    rounds = settings.rounds
    solved = line.solve("chain", [neighbours.matches], line.start(), rounds.chain)
    adjacent = line.match_along_epipolars(solved)
    near = line.match_known_points("near", solved, loops_closed=False)
    matches = [adjacent, near]
    solved = line.solve("dense", matches, solved, rounds.dense)
    solved, matches = line.register(neighbours, solved, matches)
    loops, solved = line.close_loops(solved)
    solved = line.solve("closed", [*matches, loops.matches], solved, rounds.loops)
    for number in range(1, rounds.map_passes + 1):
        wide = line.match_known_points(f"everywhere{number}", solved, loops_closed=True)
        final = number == rounds.map_passes and settings.align.rounds == 0
        solved = line.solve(f"refined{number}", [matches[0], wide], solved, rounds.refined, final)
    for number in range(1, settings.align.rounds + 1):
        solved = line.solve_aligned(number, line.align(number, solved), solved)
    if "photometric" in settings.factors:
        solved = line.solve_photometric(solved)
    return solved


def _trajectories(
    trajectory: Path | str | Sequence[Path | str] | None, keyframes: Path | None
) -> dict[str, Path]:
    """The files that poses come from, by what they are."""
    given = [trajectory] if isinstance(trajectory, Path | str) else list(trajectory or ())
    if keyframes is not None and len(given) > 1:
        raise GsbaError("keyframes go with one trajectory: give either several, or keyframes")
    origin = {f"trajectory{n or ''}": Path(path) for n, path in enumerate(given)}
    return origin if keyframes is None else origin | {"keyframes": Path(keyframes)}


def _given(origin: Mapping[str, Path], timestamps: Path | None) -> list[Trajectory]:
    """The trajectories of the files of a run, in pieces that each have a world of their own."""
    given = [path for name, path in origin.items() if name.startswith("trajectory")]
    pieces = [read.read_trajectory(path, timestamps) for path in given]
    if "keyframes" in origin:
        keyframes = read.read_trajectory(origin["keyframes"], timestamps)
        pieces = [read.follow_keyframes(pieces[0], keyframes)]
    return [part for piece in pieces for part in read.split_restarts(piece)]


def _coarse(frames: FrameSet, given: Sequence[Trajectory], settings: RefineSettings) -> CoarsePoses:
    """Start poses of frames, refused where no video could have them."""
    if not given:
        return read.without_trajectory(frames)
    coarse = read.associate_pieces(frames, given, settings.read)
    refuse_useless(coarse)
    if np.ptp(coarse.world_T_rigs[:, :3, 3], axis=0).max() == 0:
        logger.warning("the trajectory only turns: positions come from the images alone")
        return read.without_trajectory(frames)
    return coarse


def load_run(out: Path) -> tuple[Reconstruction, FrameSet]:
    """Result of a finished run and the frames it was made from: the largest of its maps.

    Raises:
        GsbaError: `out` is no finished run.
    """
    reconstruction = load_stage(out, "reconstruction", Reconstruction)
    frames = load_stage(out, "frames", FrameSet)
    return taken(reconstruction, frames, largest(reconstruction))


def _extract(
    out: Path, origin: dict[str, Path], settings: RefineSettings, fps: float | None, fresh: bool
) -> None:
    """Write the frames of the video that a run is about to `out`/frames."""
    chosen = settings.video
    if fps is not None:
        if not fps > 0:
            raise GsbaError(f"--fps {fps}: must be a positive number of frames per second")
        chosen = chosen.model_copy(update={"fps": fps, "every": None, "at": None})
    with RunStore(out, origin, fresh) as store:
        video.extract(origin["frames"], out / "frames", chosen, replace=True)
        store.claim(out / "frames")


def _without_carrier(store: RunStore, frames: FrameSet) -> FrameSet:
    """Frames whose mask leaves out the carrier, if there is one."""
    inputs = fingerprint(path for group in frames.paths for path in group)
    found = store.stage("carrier", inputs, lambda: find_carrier(frames), Carrier)
    path = store.root / "carrier.png"
    if not (path.exists() and store.records["carrier"].resumed):  # a new file would undo all stages
        write_carrier(found, frames, store.root)
    for name in ("carrier.png", "carrier_check.jpg"):
        store.claim(store.root / name)
    if not found.share:
        return frames
    return replace(frames, mask_paths=(path,) * len(frames))


def _write(line: Line, reconstruction: Reconstruction) -> RunResult:
    """Poses, cloud, report and datasets; of several maps that nothing ties together the largest."""
    store, settings, frames, coarse = line.store, line.settings, line.frames, line.coarse
    out, rows = store.root, largest(reconstruction)
    main, shown = taken(reconstruction, frames, rows)
    read.write_tum(out / "trajectory.tum", Trajectory(shown.timestamps, main.world_T_rigs))
    write_poses(out / "poses.csv", frames, coarse, reconstruction)
    write_points(out / "points.ply", main)
    atomic_write(out / "config.toml", lambda path: path.write_text(to_toml(settings)))
    placement = place(main, shown, settings.placement)
    for name in settings.export.formats:
        _export(line, ExportFormat(name), main, shown, placement)
    undone = [n for n, s in line.solutions.items() if not all(r.accepted for r in s.rounds)]
    undone += [name for name in line.undone if name not in undone]
    judgement, findings = describe(line.trust, frames) if line.trust else ({}, [])
    joined, more = registered.describe(line.registered, line.joints, frames)
    notes = findings + more
    notes += take_notes(frames, coarse, reconstruction, undone, line.frame_weights)
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
        trajectory=judgement | joined,
    )
    write_report(out / "report.json", report)
    page = report | {"frames": [report["frames"][f] for f in rows]}
    start = replace(coarse, world_T_rigs=coarse.world_T_rigs[rows], sources=coarse.sources[rows])
    write_html(out / "report.html", shown, start, main, page)
    for name in _OUTPUTS:
        store.claim(out / name)
    return RunResult(out, frames, coarse, reconstruction, report)


def _export(
    line: Line,
    to: ExportFormat,
    reconstruction: Reconstruction,
    frames: FrameSet,
    placement: Placement,
) -> None:
    folder, name = line.store.root / to.value, f"export-{to.value}"
    if not folder.exists():
        line.store.forget(name)

    def compute() -> Counts:
        size = line.settings.export.face_size
        export(reconstruction, frames, folder, to, size, placement)
        return Counts(len(line.frames), len(frames), "frames")

    key = [line.settings.export.face_size, placement.to_json()]
    line.store.stage(name, key, compute, Counts, [line.latest])
    line.store.claim(folder)
