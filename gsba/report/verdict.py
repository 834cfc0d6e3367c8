"""The verdict on a run: whether its exported map is good to train on, and if not, where and why.
Limits are set by maps of known truth: those that are off by more than a hundredth of their extent
shall not pass (benchmarks/results/verdict.md)."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from gsba.bundle.map_strength import (
    neighbour_shifts,
    overlap_ratios,
    position_errors,
    scale_changes,
    step_deviations,
)
from gsba.geometry import extent_of
from gsba.odometry.tour_order import MIN_FRAMES
from gsba.report.maps import MIN_SHARE_OF_A_MAP
from gsba.types import FrameSet, PoseStatus, Reconstruction, RunStart

_ERROR_RATIO = 3.0  # largest error of a map's positions over the one that covariances foretell, of
# 19 in 20 maps that are right
_NO_START = {RunStart.PAIRS, "none"}  # sources of poses of a run that has no poses at its start


@dataclass(frozen=True, slots=True)
class Figures:
    """Figures of the exported map. NaN = not known."""

    frames: int  # given, without those that were fetched for the map alone
    exported: int  # of these, in the exported map
    points: int
    # Part of the extent by which no position is further off, in 19 of 20 maps.
    position_error: float
    # Pixels by which a point may be off in a neighbour's picture, median of the frames.
    neighbour_pixels: float
    extent_metres: float  # NaN = no scale
    # (n,) steps that no image shows: their poses are those of the start.
    held_steps: tuple[int, ...]
    false_steps: int  # number of the start's steps that images contradict
    # Number of steps between frames of the run that match nothing; 0 of a run that has a start.
    unmatched_steps: int
    unrefined: tuple[int, ...]  # (n,) frames whose poses are those of the start
    scale_changes: tuple[float, ...]  # (F - 1,) that may hide at each step, see `scale_handover`
    moved_by_scale: tuple[float, ...]  # (F - 1,) part of the extent by which such a change moves
    # positions of the smaller side
    deviations: tuple[float, ...]  # (F - 1,) of steps from those that far frames predict
    overlaps: tuple[float, ...]  # (F - 1,) of the frames of each step, over the expected one

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
    extent = extent_of(main.world_T_rigs[:, :3, 3])
    known = len(main.points_world) > 0 and extent > 0
    width = max(kind.panorama_width for kind in shown.formats)
    shifts = neighbour_shifts(main) * _ERROR_RATIO * width / (2 * np.pi)
    counted = report["summary"]
    shifts, checks = shifts[np.isfinite(shifts)], report["trajectory"] or {}
    unknown = (math.nan,) * (len(shown) - 1)
    changes = moved = deviations = overlaps = unknown
    if known:
        changes = tuple(scale_changes(main, shown.recording_of_frame).tolist())
        sides = _smaller_sides(main.world_T_rigs[:, :3, 3]) / extent
        # The best similarity takes up half.
        moved = tuple((np.array(changes) * np.maximum(sides, 1e-9) / 2).tolist())
        deviations = tuple(step_deviations(main).tolist())
        overlaps = tuple(overlap_ratios(main, shown.recording_of_frame).tolist())
    return Figures(
        frames=counted["frames"]
        + counted.get("frames_unusable", 0)
        - counted.get("frames_fetched", 0),
        exported=len(shown.chosen()),
        points=len(main.points_world),
        position_error=_position_error(main) / extent if known else math.nan,
        neighbour_pixels=float(np.median(shifts)) if len(shifts) else math.nan,
        extent_metres=extent * _metres_per_unit(report),
        held_steps=_held_steps(report, shown.names),
        false_steps=len(checks.get("false_steps", ())),
        unmatched_steps=len(checks.get("unseen_steps", ())) if _has_no_start(report) else 0,
        unrefined=tuple(np.flatnonzero(main.pose_statuses != PoseStatus.REFINED).tolist()),
        scale_changes=changes,
        moved_by_scale=moved,
        deviations=deviations,
        overlaps=overlaps,
    )


def _position_error(main: Reconstruction) -> float:
    """Length, map units, by which no refined position is further off in 19 of 20 maps."""
    refined = main.pose_statuses == PoseStatus.REFINED  # others are a reason of their own
    if main.joint_errors is None:  # a part was held or moved as it is: covariances bound errors
        squares = np.trace(main.pose_covariances[refined, 3:, 3:], axis1=1, axis2=2)
        squares = squares[np.isfinite(squares)]
        return _ERROR_RATIO * 2 * float(np.sqrt(squares.max())) if len(squares) else math.nan
    errors = position_errors(main.world_T_rigs, main.joint_errors.draws)
    errors = errors[:, refined & np.isfinite(errors).all(axis=0)]
    if not errors.size:
        return math.nan
    return _ERROR_RATIO * float(np.quantile(errors.max(axis=1), 0.95))


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


def _has_no_start(report: Mapping[str, Any]) -> bool:
    """True if images alone gave all poses at the start."""
    return {row["coarse_pose"] for row in report["frames"]} <= _NO_START


def _held_steps(report: Mapping[str, Any], names: Sequence[str]) -> tuple[int, ...]:
    """Steps of the exported map whose poses the start alone gives, by their first frames' rows."""
    checks, rows = report["trajectory"] or {}, {name: row for row, name in enumerate(names)}
    if _has_no_start(report):
        return ()
    held = checks.get("held_steps", ())
    return tuple(rows[a] for a, b in held if a in rows and b in rows)


MAX_POSITION_ERROR = 0.01  # of the extent, of a map that is good to train on
MAX_UNSHARP_ERROR = 0.1  # of the extent; beyond, images do not determine the map
MAX_CONTRADICTED_SHARE = 0.25  # of the steps, by far frames
MAX_HELD_SHARE = 0.5  # of the steps, by the start alone
MAX_DOUBTED_SHARE = 0.25  # of the steps, by a start that images contradict elsewhere
MAX_LOOSE_SHARE = 0.5  # of the steps, where the scale is not carried on and no start gives it
MAX_UNMATCHED_SHARE = 0.25  # of a run's steps, where frames are missing and no start is given
MAX_RESIDUAL_RATIO = 3.0  # of a frame, in the median one's: right maps have up to 1.9
MIN_OBSERVATIONS_SHARE = 0.05  # of a frame, of the median one's: right maps have .09 and more
MIN_OVERLAP_RATIO = 0.4  # of a step, over the one that those beside it promise: right maps have .44
MAX_FALSE_SHARE = 0.1  # of the start's steps; above it the others are in doubt, too
_MAX_NAMED_FRAMES = 6  # of a reason, in a line of text
_LOOK_AROUND = "gsba view RUN"
_WITHOUT_DOUBTED = "gsba export RUN --to colmap --without doubted"


class Level(StrEnum):
    """Levels of the verdict, from the best on."""

    GOOD = "good to train"
    LOOK = "look at these places"
    REFUSED = "do not train"


@dataclass(frozen=True, slots=True)
class Reason:
    """A test that failed."""

    level: Level
    frames: tuple[str, ...]  # names of the frames that it holds for; () = the whole map
    cause: str
    remedy: str  # what to do
    leave_out: bool = False  # `gsba export --without doubted` leaves the frames out
    command: str = ""  # that does what can be done now, of the run's folder RUN; "" = none

    def placed_cause(self) -> str:
        """Place and cause in a line."""
        place = f"{', '.join(self.frames)}: " if self.frames else ""
        if len(self.frames) > _MAX_NAMED_FRAMES:
            place = f"{self.frames[0]} to {self.frames[-1]} ({len(self.frames)} frames): "
        return place + self.cause

    def line(self) -> str:
        """Place, cause and remedy in a line."""
        return f"{self.placed_cause()}; {self.remedy}"


@dataclass(frozen=True, slots=True)
class Verdict:
    """The level, a sentence for the user, the reasons with the worst first, and the figures."""

    level: Level
    sentence: str
    reasons: tuple[Reason, ...]
    figures: Figures

    def to_json(self) -> dict[str, Any]:
        """Section `verdict` of report.json."""
        found = asdict(self)
        for row, reason in zip(found["reasons"], self.reasons, strict=True):
            row["line"] = reason.line()
        return found


def judge(report: Mapping[str, Any], main: Reconstruction, shown: FrameSet) -> Verdict:
    """Verdict on a run."""
    return verdict_on(measure(report, main, shown), report, shown.names)


def verdict_on(figures: Figures, report: Mapping[str, Any], names: Sequence[str]) -> Verdict:
    """Verdict on the figures of an exported map of frames `names` (F,)."""
    levels = list(Level)
    found = _Tests(figures, report, names).failed()
    reasons = tuple(sorted(found, key=lambda one: levels.index(one.level), reverse=True))
    level = reasons[0].level if reasons else Level.GOOD
    parts = [f"all {figures.frames} frames are in one map"]
    if figures.exported < figures.frames:
        parts = [f"{figures.exported} of {figures.frames} frames are in the map"]
    # Where a step is in doubt, covariances do not tell how far the map is off.
    doubted = any(one.level == Level.REFUSED or one.frames for one in reasons)
    parts += [reasons[0].placed_cause()] if doubted else [_accuracy(figures)]
    parts += [_camera(report)] if level != Level.REFUSED else []
    return Verdict(level, f"{level}: {'; '.join(filter(None, parts))}", reasons, figures)


@dataclass(frozen=True, slots=True)
class _Tests:
    """The tests; each gives a reason or more where it fails."""

    figures: Figures
    report: Mapping[str, Any]
    names: Sequence[str]  # (F,) of the frames

    def failed(self) -> Iterator[Reason]:
        """Reasons of all tests that fail."""
        if self.figures.points:
            yield from self._in_unknown_order()
        yield from self._frames_out()
        if not self.figures.points:
            cause = "the camera turned on the spot: there are rotations and no points"
            yield Reason(Level.REFUSED, (), cause, "walk while you film: a trainer needs parallax")
            return
        yield from self._unrefined()
        yield from self._misfitting()
        yield from self._loosely_held()
        yield from self._held()
        yield from self._shown_by_two_frames()
        yield from self._cut()
        yield from self._loosely_scaled()
        yield from self._uncertain()
        yield from self._contradicted()

    @property
    def _start(self) -> str:
        return self.report.get("start", RunStart.TRAJECTORY)

    def _frames_out(self) -> Iterator[Reason]:
        """Frames that are not in the exported map."""
        exported, num = self.figures.exported, self.figures.frames
        if unusable := tuple(self.report["frame_lists"].get("unusable", ())):
            cause = (
                f"{len(unusable)} of {num} frames show next to nothing, or nothing of what both "
                "frames beside them show, and are left out"
            )
            remedy = "see whether the lens was covered, the picture is blurred or the file damaged"
            yield Reason(Level.LOOK, unusable, cause, remedy)
        if exported + len(unusable) == num:
            return
        inside = {*self.names, *self.report["frame_lists"].get("fetched", ())}
        out = tuple(row["name"] for row in self.report["frames"] if row["name"] not in inside)
        level = Level.REFUSED if exported < MIN_SHARE_OF_A_MAP * num else Level.LOOK
        cause = f"no matches tie {len(out)} of {num} frames to the exported map"
        remedy = "film the way between without a pause next time, and slowly through doors"
        several = len(self.report["maps"]) > 1
        command = "gsba export RUN --to colmap --map 2" if several else ""
        unmatched = self.figures.unmatched_steps
        if unmatched > MAX_UNMATCHED_SHARE * (num - 1):
            doubt = (
                f"{unmatched} of {num - 1} neighbours do not match: frames so far apart may have "
                "matched what only looks alike"
            )
            yield Reason(Level.REFUSED, (), doubt, "give frames closer together")
            command = ""  # the next map is in doubt, too
        elif command:
            remedy = f"export the next map; {remedy}"
        # neighbours over a pause are not compared
        if unmatched and several and not self.report.get("recordings"):
            remedy += "; if the way has no gap there, give even times (--timestamps FILE)"
        yield Reason(level, out, cause, remedy, command=command)

    def _in_unknown_order(self) -> Iterator[Reason]:
        """Stills whose order may not be that of the way (`odometry.tour_order`)."""
        wrong = "a place that repeats makes a wrong map"
        if self.report.get("order_doubted"):
            cause = (
                "neighbours by the times given are hardly more alike than any two frames: if the "
                f"way had another order, {wrong}"
            )
            remedy = "check --fps or --timestamps: frames must be in the order of the way"
            yield Reason(Level.LOOK, tuple(self.names), cause, remedy)
        if self.report.get("timed", True):
            return
        ordered = {
            one["name"]: one["timed"] or one["with_trajectory"]
            for one in self.report.get("recordings", ())
        }
        for name, rows in self._recordings().items():
            started = not {row["coarse_pose"] for row in rows} <= _NO_START
            if len(rows) < MIN_FRAMES and not ordered.get(name, started):
                cause = (
                    f"{len(rows)} stills without times are too few to tell whether their names "
                    f"follow the way; if they do not, {wrong}"
                )
                remedy = "if their names are in order, pass --fps 1 or --timestamps"
                few = {row["name"] for row in rows}
                if exported := tuple(name for name in self.names if name in few):
                    yield Reason(Level.LOOK, exported, cause, remedy)

    def _unrefined(self) -> Iterator[Reason]:
        """Frames that images do not constrain."""
        given = {row["name"]: row.get("coarse_pose") for row in self.report["frames"]}
        of_source = dict[str, list[str]]()
        for name in (self.names[f] for f in self.figures.unrefined):
            between = given[name] in ("interpolated", "extrapolated")
            source = str(given[name]) if between else f"that of the {self._start}"
            of_source.setdefault(source, []).append(name)
        for source, names in of_source.items():
            cause = f"hardly any matches: the pose is {source}"
            remedy = "leave these frames out of the training, or give sharper ones"
            yield Reason(Level.LOOK, tuple(names), cause, remedy, True, _WITHOUT_DOUBTED)

    def _misfitting(self) -> Iterator[Reason]:
        """Frames whose points fit much worse than those of others of their recording."""
        ratios = self._parts_of_usual("median_residual_deg")
        frames = tuple(name for name in self.names if ratios[name] > MAX_RESIDUAL_RATIO)
        if frames:
            cause = (
                f"points fit up to {max(ratios[name] for name in frames):.2g} times worse than in "
                "other frames: a mirrored or edited picture fits in a wrong place"
            )
            remedy = "look at these pictures, or leave these frames out of the training"
            yield Reason(Level.LOOK, frames, cause, remedy, True, _WITHOUT_DOUBTED)

    def _loosely_held(self) -> Iterator[Reason]:
        """Frames with far fewer observations than others of their recording."""
        parts = self._parts_of_usual("observations")
        few = {name for name, part in parts.items() if 0 < part < MIN_OBSERVATIONS_SHARE}
        few -= {self.names[f] for f in self.figures.unrefined}
        if frames := tuple(name for name in self.names if name in few):
            cause = "few points hold the pose, a twentieth of other frames': a wrong one fits, too"
            remedy = "look at these pictures, or leave these frames out of the training"
            yield Reason(Level.LOOK, frames, cause, remedy, True, _WITHOUT_DOUBTED)

    def _parts_of_usual(self, key: str) -> dict[str, float]:
        """A figure of each frame over the median one of its recording, by name; 0 = not known."""
        found = dict[str, float]()
        for rows in self._recordings().values():
            figures = {row["name"]: row.get(key) or 0.0 for row in rows}
            usual = float(np.median([one for one in figures.values() if one] or [math.inf]))
            found |= {name: one / usual for name, one in figures.items()}
        return found

    def _recordings(self) -> dict[str, list[Mapping[str, Any]]]:
        """Rows of the report's frames by the name of their recording, "" = the only one."""
        found = dict[str, list[Mapping[str, Any]]]()
        for row in self.report["frames"]:
            found.setdefault(row["name"].rpartition("/")[0], []).append(row)
        return found

    def _held(self) -> Iterator[Reason]:
        """Steps that no image shows."""
        held, num = self.figures.held_steps, self.figures.num_steps
        if not held:
            return
        false, doubt, level = self.figures.false_steps, "", Level.LOOK
        if false > MAX_FALSE_SHARE * num:
            doubt = f", though images contradict it at {false} others"
        most_false = false > 0.5 * (num - len(held))  # of the steps that images show
        if most_false or len(held) > (MAX_DOUBTED_SHARE if doubt else MAX_HELD_SHARE) * num:
            level = Level.REFUSED
        if level == Level.LOOK:
            held = tuple(step for step in held if not self._is_of_unrefined(step))
            if not held:
                return
        cause = (
            f"no image shows {len(held)} of {num} steps: there the {self._start} is believed as it "
            f"is{doubt}"
        )
        remedy = (
            "compare both sides of the place; next time walk slower there, with more light, or "
            "give frames closer together"
        )
        yield Reason(level, self._ends(held), cause, remedy, command=_LOOK_AROUND)

    def _is_of_unrefined(self, step: int) -> bool:
        """True if a step ends at an unrefined frame, a reason of its own, and points that are seen
        from both sides of it hand the scale on."""
        if step not in self.figures.unrefined and step + 1 not in self.figures.unrefined:
            return False
        return 0 <= self.figures.moved_by_scale[step] <= MAX_POSITION_ERROR / 2

    @property
    def _lone(self) -> list[int]:
        """Steps of images alone across which no frame beside them matches."""
        rows = {name: row for row, name in enumerate(self.names)}
        lone = self.report.get("lone_steps", ())
        return [rows[a] for a, b in lone if a in rows and b in rows]

    def _shown_by_two_frames(self) -> Iterator[Reason]:
        """Steps that their own two frames alone show."""
        if lone := self._lone:
            cause = (
                f"{len(lone)} of {self.figures.num_steps} steps are shown by their own two frames "
                "alone: what lies behind may be another place that looks alike"
            )
            remedy = (
                "compare both sides of the place; name stills in the order of the way, or give "
                "frames closer together there"
            )
            yield Reason(Level.LOOK, self._ends(lone), cause, remedy, command=_LOOK_AROUND)

    def _cut(self) -> Iterator[Reason]:
        """Steps over which the picture changes as on no walk."""
        low = np.flatnonzero(np.array(self.figures.overlaps) < MIN_OVERLAP_RATIO).tolist()
        if low := [step for step in low if step not in (*self.figures.held_steps, *self._lone)]:
            cause = (
                f"both frames of {len(low)} of {self.figures.num_steps} steps have far fewer "
                "points in common than those of the steps beside: if the film is cut there, what "
                "lies behind may be another place that looks alike"
            )
            remedy = (
                "compare both sides of the place; if the film is cut there, refine its parts as "
                "recordings of their own (--recording)"
            )
            yield Reason(Level.LOOK, self._ends(low), cause, remedy, command=_LOOK_AROUND)

    def _loosely_scaled(self) -> Iterator[Reason]:
        """Steps over which the scale is not carried on."""
        changes = np.array(self.figures.scale_changes)
        # Of the extent, by a change of scale that may hide at a step: right maps have .0043.
        loose = np.flatnonzero(np.array(self.figures.moved_by_scale) > (MAX_POSITION_ERROR / 2))
        if not len(loose):
            return
        worst = changes[loose].max()
        size = f"by up to {100 * worst:.2g} %" if np.isfinite(worst) else "by any factor"
        cause = (
            f"few points are seen from both sides of {len(loose)} of {self.figures.num_steps} "
            f"steps: what lies behind may be larger or smaller {size}"
        )
        remedy = (
            "give frames closer together there (of a video leave --fps out), walk slowly through "
            "doors, and come back to places where you were"
        )
        ends, most = self._ends(loose.tolist()), MAX_LOOSE_SHARE * self.figures.num_steps
        free = self._start == RunStart.PAIRS and len(loose) > most
        level = Level.REFUSED if free else Level.LOOK
        yield Reason(level, ends, cause, remedy, command=_LOOK_AROUND)

    def _uncertain(self) -> Iterator[Reason]:
        """Positions that the images hold too loosely."""
        error = self.figures.position_error
        if math.isnan(error):
            cause = "how far positions may be off is not known: they have no covariances"
            remedy = "compare places that you passed twice; give more frames, further apart"
            yield Reason(Level.LOOK, (), cause, remedy, command=_LOOK_AROUND)
        if error > MAX_POSITION_ERROR:
            level = Level.REFUSED if error > MAX_UNSHARP_ERROR else Level.LOOK
            cause = f"positions may be off by {100 * error:.2g} % of the path's extent"
            remedy = "walk further than a few steps; sharper or larger pictures help"
            yield Reason(level, (), cause, remedy)

    def _contradicted(self) -> Iterator[Reason]:
        """Steps that frames further away contradict."""
        # of a step from the one that far frames predict, part of its length
        wrong = np.flatnonzero(np.array(self.figures.deviations) > 0.2).tolist()
        num = self.figures.num_steps
        if wrong:
            level = Level.REFUSED if len(wrong) > MAX_CONTRADICTED_SHARE * num else Level.LOOK
            cause = f"frames further away contradict {len(wrong)} of {num} steps"
            remedy = (
                "look for things that move, and mask them (--masks distractors); leave these "
                "frames out of the training"
            )
            yield Reason(level, self._ends(wrong), cause, remedy, True, _WITHOUT_DOUBTED)

    def _ends(self, steps: Sequence[int]) -> tuple[str, ...]:
        """Names of the frames at both ends of steps, in order."""
        return tuple(self.names[f] for f in sorted({f for s in steps for f in (s, s + 1)}))


def _accuracy(figures: Figures) -> str:
    """Bound on the errors of positions, in words; "" = not known."""
    share, metres = figures.position_error, figures.extent_metres
    if not math.isfinite(share):
        return ""
    size = f"{100 * share:.2g} % of the path's extent"
    if math.isfinite(metres):
        size = f"{1e3 * share * metres:.2g} mm ({size})"
    pixels = figures.neighbour_pixels
    shift = f", {pixels:.2g} pixels in a neighbour's picture" if math.isfinite(pixels) else ""
    return f"positions may be off by up to {size}{shift}"


def _camera(report: Mapping[str, Any]) -> str:
    """Parts of the camera that were found, in words; "" = none were looked for."""
    found = report.get("camera") or {}
    if not found:
        return ""
    if not found["taken"]:
        return "the camera has one centre"
    metres, readout = found.get("metres_per_unit"), found.get("readout") or {}
    unit, scale = ("mm", 1e3 * metres) if metres else ("map units", 1.0)
    text = f"two lenses {scale * found['baseline']:.3g} {unit} apart"
    if found["reason"]:  # kept for their rows
        text = "two lenses in one place"
    rows = f", rows read in {readout['ms']:.3g} ms" if readout.get("ms") else ""
    return text + rows if readout.get("taken") else text
