"""What a run leaves behind: poses, cloud, datasets and the report."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gsba.bundle.stitching import describe as describe_field
from gsba.config_file import to_toml
from gsba.export import ExportFormat, export, write_points
from gsba.loop_closure import merged_map
from gsba.pipeline import timing
from gsba.pipeline.backend import Line
from gsba.placement.placement import Placement, place
from gsba.report.html import residual_sphere, write_html
from gsba.report.report import build_report, plain, take_notes, write_poses, write_report
from gsba.store.store import atomic_write
from gsba.trajectory.files import write_tum
from gsba.trajectory.judgement import describe
from gsba.types import (
    CoarsePoses,
    Counts,
    FrameSet,
    PoseSource,
    Reconstruction,
    Trajectory,
)

_GAUGE = (
    "Sim(3)-aligned to the coarse trajectory over its refined SLAM poses: its world and scale; "
    "covariances hold the first pose and the distance to the frame furthest from it"
)
_OWN_GAUGE = (
    "no trajectory: the first frame's axes, and the median step of the start as the unit; "
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


@dataclass(frozen=True, slots=True)
class RunResult:
    """What `refine` leaves in memory; the rest is in the run's folder."""

    out: Path
    frames: FrameSet
    coarse: CoarsePoses  # before
    reconstruction: Reconstruction  # after
    report: dict[str, Any]  # the content of report.json


def write(line: Line, reconstruction: Reconstruction) -> RunResult:
    """Poses, cloud, report and datasets; of several maps that nothing ties together the largest."""
    store, settings, frames, coarse = line.store, line.settings, line.corrected, line.coarse
    out, rows = store.root, reconstruction.largest_map()
    main, shown = (reconstruction.taken(rows), frames.taken(rows))
    write_tum(out / "trajectory.tum", Trajectory(shown.timestamps, main.world_T_rigs))
    start = replace(coarse, world_T_rigs=coarse.world_T_rigs[rows], sources=coarse.sources[rows])
    (out / "coarse.tum").unlink(missing_ok=True)
    if (coarse.sources != PoseSource.NONE).any():
        write_tum(out / "coarse.tum", Trajectory(shown.timestamps, start.world_T_rigs))
    write_poses(out / "poses.csv", frames, coarse, reconstruction)
    write_points(out / "points.ply", main)
    atomic_write(out / "config.toml", lambda path: path.write_text(to_toml(settings)))
    placement = place(main, shown, settings.placement)
    for name in settings.export.formats:
        _export(line, ExportFormat(name), main, shown, placement)
    report = _report(line, reconstruction)
    write_report(out / "report.json", report)
    page = report | {"frames": [report["frames"][f] for f in rows]}
    write_html(out / "report.html", shown, start, main, page)
    for name in _OUTPUTS:
        store.claim(out / name)
    return RunResult(out, frames, coarse, reconstruction, report)


def _report(line: Line, reconstruction: Reconstruction) -> dict[str, Any]:
    """The content of report.json."""
    frames, coarse = line.frames, line.coarse
    undone = [n for n, s in line.solutions.items() if not all(r.accepted for r in s.rounds)]
    undone += [name for name in line.undone if name not in undone]
    judgement, findings = describe(line.trust, frames) if line.trust else ({}, [])
    judgement, findings = timing.describe(line.clock, judgement, findings)
    joined, more = merged_map.describe(line.registered, line.joints, frames)
    told = undone, line.frame_weights, line.settings.closer.max_scale_sigma
    notes = take_notes(frames, coarse, reconstruction, *told)
    report = build_report(
        settings=line.settings,
        frames=frames,
        coarse=coarse,
        reconstruction=reconstruction,
        stages=line.store.records.values(),
        counts=line.counts,
        solver=[{"stage": name, "rounds": s.rounds} for name, s in line.solutions.items()],
        gauge=_GAUGE if (coarse.sources != PoseSource.NONE).any() else _OWN_GAUGE,
        notes=findings + more + notes,
        trajectory=judgement | joined,
        moves=line.moves,
        stitching=line.stitching and describe_field(line.stitching),
    )
    report["residual_sphere"] = plain(residual_sphere(reconstruction), digits=4)
    return report


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
