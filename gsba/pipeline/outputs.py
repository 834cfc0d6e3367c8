"""What a run leaves behind: poses, cloud, datasets and the report."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsba.bundle.stitching import describe as describe_field
from gsba.config_file import to_toml
from gsba.export import ExportFormat, export, write_points
from gsba.log import GsbaError
from gsba.loop_closure import merged_map
from gsba.loop_closure.connectivity import largest, taken
from gsba.pipeline import timing
from gsba.pipeline.backend import Line
from gsba.placement.placement import Placement, place
from gsba.report.html import residual_sphere, write_html
from gsba.report.report import build_report, plain, take_notes, write_poses, write_report
from gsba.store.store import atomic_write, load_stage
from gsba.trajectory.files import write_tum
from gsba.trajectory.judgement import describe
from gsba.types import CoarsePoses, Counts, FrameSet, PoseSource, Reconstruction, Trajectory

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


def load_run(out: Path) -> tuple[Reconstruction, FrameSet]:
    """Result of a finished run and the frames it was made from: the largest of its maps.

    Raises:
        GsbaError: `out` is no finished run, or was edited.
    """
    reconstruction = load_stage(out, "reconstruction", Reconstruction)
    frames = load_stage(out, "frames", FrameSet)
    if not _fit_together(reconstruction, frames):
        raise GsbaError(f"{out}: its results do not fit together: refine again with --fresh")
    frames = replace(frames, correction=reconstruction.correction)
    main, shown = taken(reconstruction, frames, largest(reconstruction))
    if not (np.isfinite(main.world_T_rigs).all() and np.isfinite(main.points_world).all()):
        raise GsbaError(f"{out}: its poses or points are no numbers: refine again with --fresh")
    if not (np.isfinite(shown.timestamps).all() and (np.diff(shown.timestamps) > 0).all()):
        raise GsbaError(f"{out}: its frames are in no order of time: refine again with --fresh")
    return main, shown


def _fit_together(reconstruction: Reconstruction, frames: FrameSet) -> bool:
    """Whether arrays have the lengths that others speak of."""
    result, num = reconstruction, len(frames.names)
    points, seen = (sum(a.shape[:1]) for a in (result.points_world, result.observation_points))
    shapes = (
        (result.world_T_rigs, (num, 4, 4)),
        (result.pose_covariances, (num, 6, 6)),
        (result.pose_statuses, (num,)),
        (result.points_world, (points, 3)),
        (result.point_colors, (points, 3)),
        (result.point_errors, (points,)),
        (result.observation_points, (seen,)),
        (result.observation_frames, (seen,)),
        (result.observation_bearings, (seen, 3)),
        (result.observation_sigmas, (seen,)),
        (frames.timestamps, (num,)),
    )
    if (joint := result.joint_errors) is not None:
        drawn = (*joint.draws.shape[:1], num, 6)
        shapes += ((joint.neighbours, (num - 1, 6, 6)), (joint.draws, drawn))
    indices = ((result.observation_points, points), (result.observation_frames, num))
    return (
        all(array.shape == shape for array, shape in shapes)
        and len(frames.paths) == len(frames.mask_paths) == num > 0
        and (result.components is None or result.components.shape == (num,))
        and all(i.size == 0 or (i.min() >= 0 and i.max() < most) for i, most in indices)
    )


def write(line: Line, reconstruction: Reconstruction) -> RunResult:
    """Poses, cloud, report and datasets; of several maps that nothing ties together the largest."""
    store, settings, frames, coarse = line.store, line.settings, line.corrected, line.coarse
    out, rows = store.root, largest(reconstruction)
    main, shown = taken(reconstruction, frames, rows)
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
