"""The verdict on a run: whether its exported map is good to train on, and if not, where and why.

Tests of figures that a finished run knows. Each that fails gives a reason: the frames that it holds
for, the cause, and what to do. Limits are set by maps of known truth, of which those that are off
by more than a hundredth of their extent shall not pass (benchmarks/results/verdict.md).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from gsba.bundle.map_strength import neighbour_shifts, position_errors
from gsba.bundle.predicted_steps import predictable_steps, step_deviations
from gsba.report.maps import MIN_SHARE_OF_A_MAP
from gsba.types import FrameSet, PoseStatus, Reconstruction, RunStart

MAX_POSITION_ERROR = 0.01  # of the extent, of a map that is good to train on
MAX_DEVIATION = 0.2  # of a step from the one that far frames predict, part of its length
MIN_PREDICTED_SHARE = 0.5  # of the steps, that far frames predict
MAX_HELD_SHARE = 0.25  # of the steps, that no image shows, or that frames far away contradict
MAX_CONTRADICTED_SHARE = 0.1  # of the steps of the start; above it, the others are in doubt, too
MIN_PATCHES_FOUND = 0.5  # of the patches
_ERROR_RATIO = 3.0  # largest error of a map's positions over the one that covariances foretell: nine
# in ten good maps stay below
_CONFIDENCE = 0.95
_MAX_NAMED_FRAMES = 6  # of a reason, in a line of text


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

    def line(self) -> str:
        """Place, cause and remedy in a line."""
        return f"{_named(self.frames)}{self.cause}; {self.remedy}"


@dataclass(frozen=True, slots=True)
class Figures:
    """What the tests look at, of the exported map. NaN = not known."""

    frames: int  # of the run, without those that were fetched for the map alone
    exported: int  # of these, in the exported map
    fetched: int  # frames in the exported map that were fetched for it alone
    points: int
    position_error: float  # part of the extent by which the worst frame may be off, of 19 in 20 maps
    neighbour_pixels: float  # by which points may be off in a neighbour's picture, median of frames
    extent_metres: float  # NaN = no scale
    deviations: tuple[float, ...]  # of each step from the one that far frames predict
    unpredicted: tuple[int, ...]  # steps that far frames could predict, and do not
    held_steps: tuple[int, ...]  # steps that no image shows: their poses are those of the start
    unrefined: tuple[int, ...]  # frames whose poses are those of the start
    patches_found: float  # share of the patches that were found in the pictures of other frames


@dataclass(frozen=True, slots=True)
class Verdict:
    """Level, the sentence that says it, the reasons, and the figures that were tested."""

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
    """Verdict on a run.

    Args:
        report: content of report.json.
        main: the exported map.
        shown: its frames.
    """
    figures = measure(report, main, shown)
    levels = list(Level)
    found = _reasons(figures, report, shown.names)
    reasons = tuple(sorted(found, key=lambda one: levels.index(one.level), reverse=True))
    level = reasons[0].level if reasons else Level.GOOD
    return Verdict(level, _sentence(level, figures, reasons, report), reasons, figures)


def measure(report: Mapping[str, Any], main: Reconstruction, shown: FrameSet) -> Figures:
    """What the tests look at; arguments as of `judge`."""
    positions, joint = main.world_T_rigs[:, :3, 3], main.joint_errors
    extent = float(np.linalg.norm(np.ptp(positions, axis=0)))
    error, pixels = math.nan, math.nan
    if joint is not None and extent > 0 and len(main.points_world):
        worst = position_errors(main.world_T_rigs, joint.draws)
        worst = worst[:, np.isfinite(worst).all(axis=0)]
        if worst.size:
            error = _ERROR_RATIO * np.quantile(worst.max(axis=1), _CONFIDENCE) / extent
        width = max(kind.panorama_width for kind in shown.formats)
        shifts = neighbour_shifts(main) * width / (2 * np.pi)
        if np.isfinite(shifts).any():
            pixels = float(np.nanmedian(shifts))
    deviations = step_deviations(main) if len(main.points_world) else np.zeros(0)
    unknown = np.isnan(deviations) & predictable_steps(len(deviations) + 1)
    fetched = len(report["frame_lists"].get("fetched", ()))
    inside = len(shown) - len(shown.chosen())
    return Figures(
        frames=report["summary"]["frames"] - fetched,
        exported=len(shown) - inside,
        fetched=inside,
        points=len(main.points_world),
        position_error=float(error),
        neighbour_pixels=pixels,
        extent_metres=extent * _metres_per_unit(report),
        deviations=tuple(deviations.tolist()),
        unpredicted=tuple(np.flatnonzero(unknown).tolist()),
        held_steps=_held_steps(report, shown.names),
        unrefined=tuple(np.flatnonzero(main.pose_statuses != PoseStatus.REFINED).tolist()),
        patches_found=_patches_found(report),
    )


def _metres_per_unit(report: Mapping[str, Any]) -> float:
    """Metres per map unit by GPS or by the lenses' baseline; NaN = not known."""
    gps = (report.get("gps") or {}).get("metres_per_unit") or {}
    if gps.get("1"):
        return float(gps["1"])
    return float((report.get("camera") or {}).get("metres_per_unit") or math.nan)


def _held_steps(report: Mapping[str, Any], names: Sequence[str]) -> tuple[int, ...]:
    """Steps of the exported map whose pose the start alone gives, by their first frames' rows."""
    checks, rows = report["trajectory"] or {}, {name: row for row, name in enumerate(names)}
    if {row["coarse_pose"] for row in report["frames"]} <= {RunStart.PAIRS, "none"}:
        return ()  # there is no start that could hold a step
    false = set(map(tuple, checks.get("false_steps", ())))
    held = [step for step in map(tuple, checks.get("unseen_steps", ())) if step not in false]
    return tuple(rows[a] for a, b in held if a in rows and b in rows)


def _patches_found(report: Mapping[str, Any]) -> float:
    """Share of patches that other frames' pictures show where the map has them, last round."""
    counts = [
        stage["counts"][0]
        for stage in report["stages"]
        if stage["name"].removeprefix("align").isdigit() and stage["counts"]
    ]
    return counts[-1]["kept"] / counts[-1]["received"] if counts and counts[-1]["received"] else math.nan


def _reasons(figures: Figures, report: Mapping[str, Any], names: Sequence[str]) -> list[Reason]:
    """All tests that fail."""
    if not figures.points:
        return [
            Reason(
                Level.REFUSED,
                (),
                "the camera turned on the spot: there are rotations and no points",
                "walk while you film: a trainer needs parallax",
            )
        ]
    tests = (_frames_out, _held, _uncertain, _contradicted, _unconfirmed, _unlike)
    return [reason for test in tests for reason in test(figures, report, names)]


def _frames_out(
    figures: Figures, report: Mapping[str, Any], names: Sequence[str]
) -> list[Reason]:
    """Frames that are not in the exported map, or that images do not constrain."""
    found = []
    if figures.exported < figures.frames:
        level = Level.LOOK
        if figures.exported < MIN_SHARE_OF_A_MAP * figures.frames:
            level = Level.REFUSED
        inside = {*names, *report["frame_lists"].get("fetched", ())}
        out = tuple(row["name"] for row in report["frames"] if row["name"] not in inside)
        why = next((one["reason"] for one in report["maps"][1:] if one["reason"]), "")
        cause = "not in the exported map: no matches tie them to it"
        remedy = "film the way between without a pause next time, and slowly through doors"
        if len(report["maps"]) > 1:
            remedy = f"gsba export RUN --map 2 exports the next map; {remedy}"
        found.append(Reason(level, out, f"{cause} ({why})" if why else cause, remedy))
    if figures.unrefined:
        found.append(
            Reason(
                Level.LOOK,
                tuple(names[f] for f in figures.unrefined),
                f"hardly any matches: the pose is that of the {start_of(report)}",
                "leave these frames out of the training, or give sharper ones",
            )
        )
    return found


def _held(figures: Figures, report: Mapping[str, Any], names: Sequence[str]) -> list[Reason]:
    """Steps that no image shows."""
    held = figures.held_steps
    if not held:
        return []
    num = max(figures.exported + figures.fetched - 1, 1)
    false, doubt = len(report["trajectory"]["false_steps"]), ""
    if false > MAX_CONTRADICTED_SHARE * num:
        doubt = f", though images contradict it at {_of(false, num, 'step')}"
    return [
        Reason(
            Level.REFUSED if len(held) > MAX_HELD_SHARE * num else Level.LOOK,
            _ends(held, names),
            f"no image shows {_of(len(held), num, 'step')}: there the {start_of(report)} is "
            f"believed as it is{doubt}",
            "compare both sides of the place in gsba view RUN; next time walk slower there, with "
            "more light, or give frames closer together",
        )
    ]


def _uncertain(figures: Figures, report: Mapping[str, Any], names: Sequence[str]) -> list[Reason]:
    """Positions that the images hold too loosely."""
    error = figures.position_error
    if not error > MAX_POSITION_ERROR:
        return []
    return [
        Reason(
            Level.REFUSED if error > 10 * MAX_POSITION_ERROR else Level.LOOK,
            (),
            f"positions may be off by {100 * error:.2g} % of the path's extent: few points are "
            "seen from several places",
            "walk further than a few steps, and back to the start; sharper or larger pictures help",
        )
    ]


def _contradicted(
    figures: Figures, report: Mapping[str, Any], names: Sequence[str]
) -> list[Reason]:
    """Steps that frames further away contradict."""
    wrong = np.flatnonzero(np.array(figures.deviations) > MAX_DEVIATION).tolist()
    if not wrong:
        return []
    num = len(figures.deviations)
    return [
        Reason(
            Level.REFUSED if len(wrong) > MAX_HELD_SHARE * num else Level.LOOK,
            _ends(wrong, names),
            f"frames further away contradict {_of(len(wrong), num, 'step')}",
            "look for things that move, and mask them (--masks distractors); leave these frames "
            "out of the training",
        )
    ]


def _unconfirmed(figures: Figures, report: Mapping[str, Any], names: Sequence[str]) -> list[Reason]:
    """Steps that only their own two frames show, so that nothing contradicts a wrong one."""
    alone, num = figures.unpredicted, len(figures.deviations)
    if len(alone) <= (1 - MIN_PREDICTED_SHARE) * num:
        return []
    return [
        Reason(
            Level.LOOK,
            _ends(alone, names),
            f"only neighbours share points at {_of(len(alone), num, 'step')}: a place that looks "
            "like the next one would not be noticed",
            "give frames closer together: more of a video a second, or the video itself",
        )
    ]


def _unlike(figures: Figures, report: Mapping[str, Any], names: Sequence[str]) -> list[Reason]:
    """Pictures that differ where the map says that they show the same."""
    if not figures.patches_found < MIN_PATCHES_FOUND:
        return []
    return [
        Reason(
            Level.LOOK,
            (),
            f"{100 * (1 - figures.patches_found):.0f} % of the patches look different in "
            "neighbouring frames: these are far apart, or what repeats was taken for one thing",
            "give frames closer together; mask what moves (--masks distractors)",
        )
    ]


def start_of(report: Mapping[str, Any]) -> str:
    """What the run started from, for a sentence: "odometry", "trajectory", ..."""
    return report.get("start", RunStart.TRAJECTORY)


def _sentence(
    level: Level, figures: Figures, reasons: Sequence[Reason], report: Mapping[str, Any]
) -> str:
    """The verdict in a sentence: frames, positions, camera; of a refused map the cause."""
    parts = [f"{figures.exported} of {figures.frames} frames are in the map"]
    if figures.exported == figures.frames:
        parts = [f"all {figures.frames} frames are in one map"]
    if level == Level.REFUSED:
        parts = [next(one.cause for one in reasons if one.level == Level.REFUSED)]
    elif math.isfinite(figures.position_error):
        parts.append(_accuracy(figures))
    if level != Level.REFUSED:
        parts.append(_camera(report))
    return f"{level.value}: {'; '.join(filter(None, parts))}"


def _accuracy(figures: Figures) -> str:
    """How far positions may be off."""
    share, metres = figures.position_error, figures.extent_metres
    size = f"{100 * share:.2g} % of the path's extent"
    if math.isfinite(metres):
        size = f"{1e3 * share * metres:.2g} mm" if share * metres < 1 else f"{share * metres:.2g} m"
    pixels = _ERROR_RATIO * figures.neighbour_pixels
    shift = f", {pixels:.2g} pixels in a neighbour's picture" if math.isfinite(pixels) else ""
    return f"positions may be off by {size}{shift}"


def _camera(report: Mapping[str, Any]) -> str:
    """What was found of the camera."""
    found = report.get("camera") or {}
    if not found:
        return ""
    if not found["taken"]:
        return "the camera has one centre"
    unit, scale = ("mm", 1e3 * found["metres_per_unit"]) if found.get("metres_per_unit") else ("map units", 1.0)
    text = f"two lenses {scale * found['baseline']:.3g} {unit} apart"
    readout = found.get("readout") or {}
    return f"{text}, rows read in {readout['ms']:.3g} ms" if readout.get("taken") and readout["ms"] else text


def _of(count: int, num: int, unit: str) -> str:
    return f"{count} of {num} {unit}s"


def _ends(steps: Sequence[int], names: Sequence[str]) -> tuple[str, ...]:
    """Names of the frames at both ends of steps, in order."""
    return tuple(names[f] for f in sorted({f for step in steps for f in (step, step + 1)}))


def _named(frames: Sequence[str]) -> str:
    """Names of frames before a cause: a few, or the first and the last ones and their number."""
    if not frames:
        return ""
    if len(frames) <= _MAX_NAMED_FRAMES:
        return f"{', '.join(frames)}: "
    return f"{frames[0]} to {frames[-1]} ({len(frames)} frames): "
