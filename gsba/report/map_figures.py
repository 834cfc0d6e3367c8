"""Figures of an exported map that the verdict's tests look at."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsba.bundle.map_strength import neighbour_shifts, position_errors
from gsba.bundle.predicted_steps import step_deviations
from gsba.bundle.scale_handover import scale_changes
from gsba.types import FrameSet, PoseStatus, Reconstruction, RunStart

_ERROR_RATIO = 3.0  # largest error of a map's positions over the one that covariances foretell, of
# 19 in 20 maps that are right
_CONFIDENCE = 0.95
_NO_START = {RunStart.PAIRS, "none"}  # sources of poses of a run that has no poses at its start


@dataclass(frozen=True, slots=True)
class Figures:
    """Figures of the exported map. NaN = not known."""

    frames: int  # of the run, without those that were fetched for the map alone
    exported: int  # of these, in the exported map
    points: int
    # Part of the extent by which no position is further off, in 19 of 20 maps.
    position_error: float
    neighbour_pixels: float  # the same of points in a neighbour's picture, median of the frames
    extent_metres: float  # NaN = no scale
    # (n,) steps that no image shows: their poses are those of the start.
    held_steps: tuple[int, ...]
    false_steps: int  # number of the start's steps that images contradict
    unrefined: tuple[int, ...]  # (n,) frames whose poses are those of the start
    scale_changes: tuple[float, ...]  # (F - 1,) that may hide at each step, see `scale_handover`
    moved_by_scale: tuple[float, ...]  # (F - 1,) part of the extent by which such a change moves
    # positions of the smaller side
    deviations: tuple[float, ...]  # (F - 1,) of steps from those that far frames predict

    @property
    def num_steps(self) -> int:
        """Number of steps in the exported map."""
        return len(self.deviations)


def measure(report: Mapping[str, Any], main: Reconstruction, shown: FrameSet) -> Figures:
    """Figures of a run.

    Args:
        report: content of report.json.
        main: the exported map.
        shown: its frames.
    """
    extent = float(np.linalg.norm(np.ptp(main.world_T_rigs[:, :3, 3], axis=0)))
    known = len(main.points_world) > 0 and extent > 0
    width = max(kind.panorama_width for kind in shown.formats)
    shifts = neighbour_shifts(main) * _ERROR_RATIO * width / (2 * np.pi)
    shifts, checks = shifts[np.isfinite(shifts)], report["trajectory"] or {}
    unknown = (math.nan,) * (len(shown) - 1)
    changes = moved = deviations = unknown
    if known:
        changes = tuple(scale_changes(main, shown.recording_of_frame).tolist())
        sides = _smaller_sides(main.world_T_rigs[:, :3, 3]) / extent
        # The best similarity takes up half.
        moved = tuple((np.array(changes) * np.maximum(sides, 1e-9) / 2).tolist())
        deviations = tuple(step_deviations(main).tolist())
    return Figures(
        frames=report["summary"]["frames"] - report["summary"].get("frames_fetched", 0),
        exported=len(shown.chosen()),
        points=len(main.points_world),
        position_error=_position_error(main) / extent if known else math.nan,
        neighbour_pixels=float(np.median(shifts)) if len(shifts) else math.nan,
        extent_metres=extent * _metres_per_unit(report),
        held_steps=_held_steps(report, shown.names),
        false_steps=len(checks.get("false_steps", ())),
        unrefined=tuple(np.flatnonzero(main.pose_statuses != PoseStatus.REFINED).tolist()),
        scale_changes=changes,
        moved_by_scale=moved,
        deviations=deviations,
    )


def _position_error(main: Reconstruction) -> float:
    """Length, map units, by which no position is further off in 19 of 20 maps."""
    if main.joint_errors is None:
        return math.nan
    errors = position_errors(main.world_T_rigs, main.joint_errors.draws)
    errors = errors[:, np.isfinite(errors).all(axis=0)]
    if not errors.size:
        return math.nan
    return _ERROR_RATIO * float(np.quantile(errors.max(axis=1), _CONFIDENCE))


def _smaller_sides(positions: np.ndarray) -> np.ndarray:
    """Extent (F - 1,) of the frames (F, 3) before or behind each step, the smaller of both."""
    sides = []
    for some in (positions, positions[::-1]):
        boxes = np.maximum.accumulate(some) - np.minimum.accumulate(some)
        sides.append(np.linalg.norm(boxes[:-1], axis=1))
    return np.minimum(sides[0], sides[1][::-1])


def _metres_per_unit(report: Mapping[str, Any]) -> float:
    """Metres per map unit by GPS or by the lenses' baseline; NaN = not known."""
    gps = (report.get("gps") or {}).get("metres_per_unit") or {}
    if gps.get("1"):
        return float(gps["1"])
    return float((report.get("camera") or {}).get("metres_per_unit") or math.nan)


def _held_steps(report: Mapping[str, Any], names: Sequence[str]) -> tuple[int, ...]:
    """Steps of the exported map whose poses the start alone gives, by their first frames' rows."""
    checks, rows = report["trajectory"] or {}, {name: row for row, name in enumerate(names)}
    if {row["coarse_pose"] for row in report["frames"]} <= _NO_START:
        return ()
    false = set(map(tuple, checks.get("false_steps", ())))
    held = [step for step in map(tuple, checks.get("unseen_steps", ())) if step not in false]
    return tuple(rows[a] for a, b in held if a in rows and b in rows)
