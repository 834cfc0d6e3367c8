"""A run from frames and a coarse trajectory to refined poses, a cloud and datasets."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsba import read
from gsba.config import RefineSettings
from gsba.config_file import to_toml
from gsba.export import ExportFormat, export, write_points
from gsba.line import ExtraFactors, Line
from gsba.misfit import refuse_useless
from gsba.motion import describe
from gsba.report import build_report, take_notes, write_poses, write_report
from gsba.store import RunStore, atomic_write, load_stage
from gsba.types import CoarsePoses, Counts, FrameSet, PoseSource, Reconstruction, Trajectory

logger = logging.getLogger(__name__)

_GAUGE = (
    "Sim(3)-aligned to the coarse trajectory over its refined SLAM poses: its world and scale; "
    "covariances hold the first pose and the distance to the frame furthest from it"
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
    masks: Path | None = None,
    timestamps: Path | None = None,
    fps: float | None = None,
    fresh: bool = False,
    extra_factors: ExtraFactors | None = None,
) -> RunResult:
    """Refine the pose of every frame, and write poses, cloud, report and datasets to `out`.

    A second call with the same `out` takes up finished stages; a changed setting re-runs what
    depends on it.

    Args:
        frames: folder of 2:1 panoramas or of cube faces.
        trajectory: TUM, KITTI or stella_vslam map.msg; T_world_rig. None = start from the images
            alone: the first step's length is the unit and the first frame the world.
        out: folder of the run.
        settings: see `gsba.config`.
        keyframes: second trajectory file of the same run, with its keyframes: they lead.
        masks: one ERP mask for all frames, or a folder of one for each; white = use.
        timestamps: times of the frames (and of a KITTI trajectory's rows).
        fps: frames per second, where no file gives times.
        fresh: forget an earlier run in `out`.
        extra_factors: makes factors of your own on the keys graph.X(frame); they join every
            bundle adjustment (and those are then never resumed).

    Raises:
        GsbaError: an input or setting that cannot be used.
    """
    frames, out = Path(frames), Path(out)
    settings = settings or RefineSettings()
    frame_set = read.scan(frames, timestamps, fps, masks)
    given = {"trajectory": trajectory, "keyframes": keyframes}
    origin = {name: Path(path) for name, path in given.items() if path is not None}
    coarse = _coarse(frame_set, origin, timestamps, settings)
    with RunStore(out, {"frames": frames, **origin}, fresh) as store:
        line = Line(store, frame_set, coarse, settings, extra_factors)
        neighbours, rounds = line.judge(line.match_neighbours()), settings.rounds
        solved = line.solve("chain", [neighbours.matches], line.start(), rounds.chain)
        adjacent = line.match_along_epipolars(solved)
        near = line.match_known_points("near", solved, loops_closed=False)
        solved = line.solve("dense", [adjacent, near], solved, rounds.dense)
        loops, solved = line.close_loops(solved)
        solved = line.solve("closed", [adjacent, near, loops.matches], solved, rounds.loops)
        for number in range(1, rounds.map_passes + 1):
            wide = line.match_known_points(f"everywhere{number}", solved, loops_closed=True)
            solved = line.solve(f"refined{number}", [adjacent, wide], solved, rounds.refined)
        reconstruction = line.reconstruct(solved)
        return _write(line, reconstruction)


def _coarse(
    frames: FrameSet, given: Mapping[str, Path], timestamps: Path | None, settings: RefineSettings
) -> CoarsePoses:
    """Pose of every frame from the trajectory files given, if any."""
    if "trajectory" not in given:
        return read.without_trajectory(frames)
    trajectory = read.read_trajectory(given["trajectory"], timestamps)
    if "keyframes" in given:
        keyframes = read.read_trajectory(given["keyframes"], timestamps)
        trajectory = read.follow_keyframes(trajectory, keyframes)
    coarse = read.associate(frames, trajectory, settings.read)
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


def _write(line: Line, reconstruction: Reconstruction) -> RunResult:
    """Poses, cloud, report and datasets."""
    store, settings, frames, coarse = line.store, line.settings, line.frames, line.coarse
    out = store.root
    trajectory = Trajectory(frames.timestamps, reconstruction.world_T_rigs)
    read.write_tum(out / "trajectory.tum", trajectory)
    write_poses(out / "poses.csv", frames, coarse, reconstruction)
    write_points(out / "points.ply", reconstruction)
    atomic_write(out / "config.toml", lambda path: path.write_text(to_toml(settings)))
    for name in settings.export.formats:
        _export(line, ExportFormat(name), reconstruction)
    undone = [n for n, s in line.solutions.items() if not all(r.accepted for r in s.rounds)]
    judgement, findings = describe(line.trust, frames) if line.trust else ({}, [])
    notes = findings + take_notes(frames, coarse, reconstruction, undone)
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
    for name in ("trajectory.tum", "poses.csv", "points.ply", "config.toml", "report.json"):
        store.claim(out / name)
    return RunResult(out, frames, coarse, reconstruction, report)


def _export(line: Line, to: ExportFormat, reconstruction: Reconstruction) -> None:
    folder, name = line.store.root / to.value, f"export-{to.value}"
    if not folder.exists():
        line.store.forget(name)

    def compute() -> Counts:
        export(reconstruction, line.frames, folder, to, line.settings.export.face_size)
        return Counts(len(line.frames), len(line.frames), "frames")

    line.store.stage(name, line.settings.export.face_size, compute, Counts, [line.latest])
    line.store.claim(folder)
