"""Contents of a run folder for a page: figures of its report, the camera, its path from above."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from gsba.app.progress import Progress
from gsba.bundle.found_camera import FoundCamera
from gsba.bundle.lens_centres import LensCentres
from gsba.bundle.readout import CameraEstimate
from gsba.config import CameraSettings
from gsba.pipeline.stage_titles import LENS_CENTRES, READOUTS, RECONSTRUCTION, is_one_of
from gsba.report.camera_findings import of_camera
from gsba.report.html.figures import viewing_axes
from gsba.report.maps import format_frame_counts
from gsba.store.folder import STAGES, is_run_folder
from gsba.store.records import RecordError, load_arrays, load_record
from gsba.types import rows_across

T = TypeVar("T")

_NO_MAP: dict[str, Any] = {"stage": "", "path": [], "points": [], "colors": None, "starts": []}
_POSES, _POINTS, _COLORS = "world_T_rigs", "points_world", "point_colors"
_MAPS, _OBSERVED, _OBSERVERS = "components", "observation_points", "observation_frames"
_LEVELS = {"good to train": "good", "look at these places": "look", "do not train": "stop"}
_FILES = ("report.html", "trajectory.tum", "points.ply", "poses.csv", "config.toml")


def overview(run: Path) -> dict[str, Any]:
    """Figures of a finished run for a page; "finished" is False where there is no report yet."""
    try:
        report = json.loads((run / "report.json").read_text(encoding="utf-8"))
        summary, counts = report["summary"], format_frame_counts(report)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return {"finished": False, "run": is_run_folder(run)}
    return {
        "finished": True,
        "run": True,
        "summary": summary,
        "counts": counts,
        "notes": report.get("notes", []),
        "camera": report.get("camera"),
        "verdict": _verdict(report),
        "map_sizes": [
            one.get("frames") for one in report.get("maps") or () if isinstance(one, dict)
        ],
        "recordings": [
            str(one["name"])
            for one in report.get("recordings") or ()
            if isinstance(one, dict) and "name" in one
        ],
        "files": [name for name in _FILES if (run / name).is_file()],
        "figures": sorted(path.name for path in run.glob("figures/*.png")),
    }


def brief_facts(run: Path) -> dict[str, str]:
    """Facts about a run for a list: its verdict, and how many frames were refined."""
    found = overview(run)
    if not found["finished"]:
        return {"state": "not finished"}
    verdict = found["verdict"]
    facts = {"verdict": verdict["level"]} if verdict else {}
    return facts | {"refined": found["counts"]}


def _verdict(report: dict[str, Any]) -> dict[str, Any] | None:
    """Verdict of a report: "level" (good, look or stop), "sentence", "reasons" (lines) and names of
    the frames to leave out; None = none."""
    found = report.get("verdict")
    if not isinstance(found, dict) or not found.get("sentence"):
        return None
    level = str(found.get("level"))
    reasons = [one for one in found.get("reasons") or () if isinstance(one, dict)]
    return {
        "level": _LEVELS.get(level, level if level in _LEVELS.values() else "look"),
        "sentence": str(found["sentence"]).removeprefix(f"{level}: "),
        "reasons": [str(one["line"]) for one in reasons if "line" in one],
        "doubted": sorted(
            {name for one in reasons if one.get("leave_out") for name in one.get("frames") or ()}
        ),
    }


def camera_so_far(run: Path, done: Sequence[str]) -> list[str]:
    """Lines about the camera from the results of stages that have ended; done: names of these
    stages, in order."""
    centres = _latest(run, done, LENS_CENTRES, LensCentres)
    if centres is None:
        return []
    readout = _latest(run, done, READOUTS, CameraEstimate)
    found = FoundCamera(centres, readout=readout)
    content, notes = of_camera(found, None, 1.0, CameraSettings(), True)
    return notes if content["taken"] else [f"two lenses were not found: {content['reason']}"]


def map_so_far(run: Path, progress: Progress) -> dict[str, Any]:
    """The newest path and points of a run from above: of odometry, then of the latest stage.

    Files of stages are renamed into place when they are whole; one that is replaced meanwhile is
    left out.

    Returns:
        "stage", name of the stage or "odometry", "" where there is nothing; "path" (F, 2), None
        where a frame is not in the largest map, and "points" (P, 2) in two level axes, "colors"
        (P, 3) or None, "starts", the rows at which a map of its own begins.
    """
    names = progress.names()[::-1]
    if RECONSTRUCTION in names:  # the stage after it has the same poses, without colours
        names.insert(0, RECONSTRUCTION)
    for name in names:
        found = _map_of_stage(run, name)
        if found is not None:
            return found
    if not progress.keyframes:
        return _NO_MAP
    maps = [number for number, _ in progress.keyframes]
    starts = [k for k in range(len(maps)) if k == 0 or maps[k] != maps[k - 1]]
    at = np.array([position for _, position in progress.keyframes])
    points = np.array(progress.points or np.zeros((0, 3)))
    axes = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])  # level as the first frame is
    return {"stage": "odometry"} | _plan(at, points, axes, None, starts)


def finished_map(run: Path) -> dict[str, Any]:
    """The map of a finished run from above, as `map_so_far` gives it."""
    return _map_of_stage(run, RECONSTRUCTION) or _NO_MAP


def _map_of_stage(run: Path, name: str) -> dict[str, Any] | None:
    """The map that a stage has stored, from above; None = it has stored none."""
    path = run / STAGES / f"{name}.npz"
    try:
        names = (_POSES, _POINTS, _COLORS, _MAPS, _OBSERVED, _OBSERVERS)
        arrays = load_arrays(path, names) if path.is_file() else {}
    except (RecordError, OSError):
        return None
    if _POSES not in arrays or arrays[_POSES].shape[1:] != (4, 4) or _POINTS not in arrays:
        return None
    poses, points, colors = arrays[_POSES], arrays[_POINTS], arrays.get(_COLORS)
    at = poses[:, :3, 3]
    if len(maps := arrays.get(_MAPS, ())) == len(at):  # other maps have worlds of their own
        inside = np.equal(maps, 0)
        at = np.where(inside[:, None], at, np.nan)
        seen = np.unique(arrays[_OBSERVED][inside[arrays[_OBSERVERS]]])
        poses, points = poses[inside], points[seen]
        colors = None if colors is None else colors[seen]
    return {"stage": name} | _plan(at, points, viewing_axes(poses)[0], colors, [0])


def _plan(
    at: np.ndarray,
    points: np.ndarray,
    axes: np.ndarray,
    colors: np.ndarray | None,
    starts: list[int],
) -> dict[str, Any]:
    """Positions (F, 3) and some of the points (P, 3) in level axes and up, as plain lists."""
    finite = np.isfinite(at.sum(axis=1))
    centre = np.median(at[finite], axis=0) if finite.any() else np.zeros(3)
    extent = float(np.ptp(at[finite], axis=0).max(initial=0.0)) or 1.0
    rows = rows_across(len(points), 4000)
    shown = (points[rows] - centre) @ axes.T if len(points) else np.zeros((0, 3))
    near = np.all(np.abs(shown) < 2 * extent, axis=1)  # NaN is not
    digits = max(0, 4 - int(np.floor(np.log10(extent))))
    path = ((at - centre) @ axes.T)[:, :2].round(digits).tolist()
    return {
        "path": [one if known else None for one, known in zip(path, finite.tolist(), strict=True)],
        "points": shown[near, :2].round(digits).tolist(),
        "colors": colors[rows][near].tolist() if colors is not None and len(points) else None,
        "starts": starts,
    }


def _latest(run: Path, done: Sequence[str], stages: Sequence[str], returns: type[T]) -> T | None:
    """Result of the latest of these stages, by the patterns of their names; None = none of them."""
    for name in reversed(done):
        if is_one_of(name, stages):
            try:
                return load_record(run / STAGES / f"{name}.npz", returns)
            except RecordError:
                continue
    return None
