"""Maps of a run in its report; each has its own world, and the largest one is exported."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsba.geometry import extent_of
from gsba.types import FrameSet, PoseStatus, Reconstruction, RunStart

MIN_SHARE_IN_ONE_MAP = 0.9  # of a run's frames; a run with fewer in its largest map is partial
MIN_SHARE_OF_A_MAP = 0.5  # of a run's frames; fewer are no map of the place
_MAX_SHOWN_SPANS = 3  # spans of a map's frames in a line of the table


@dataclass(frozen=True, slots=True)
class MapSummary:
    """One map of a run. Lengths are in the map's own unit."""

    map: int  # its number, 1 = the largest, which is exported
    frames: int  # number of frames in it
    refined: int  # number of these that images constrain
    steps: int  # number of steps from one frame to the next in time within the map
    points: int  # number of scene points
    extent: float  # map units, diagonal of the box around its frames' positions
    spans: tuple[tuple[str, str], ...]  # names of the first and last frame of each run of frames
    reason: str | None  # reason why it is not joined to a larger map; None = largest, or unknown


def summarize_maps(
    reconstruction: Reconstruction, frames: FrameSet, reasons: Sequence[str | None] = ()
) -> tuple[MapSummary, ...]:
    """Summaries of a reconstruction's maps, the largest first; frames in no map are left out.
    `reasons`: reason why each map is not joined to a larger one, the largest map first; there may
    be fewer reasons than maps."""
    found = []
    for number in range(1, reconstruction.num_maps + 1):
        rows = reconstruction.frames_of_map(number)
        part = reconstruction.of_map(number)
        positions = part.world_T_rigs[:, :3, 3]
        breaks = np.flatnonzero(np.diff(rows) > 1)
        first, last = rows[[0, *(breaks + 1)]], rows[[*breaks, -1]]
        found.append(
            MapSummary(
                number,
                len(rows),
                int(np.count_nonzero(part.pose_statuses == PoseStatus.REFINED)),
                len(rows) - len(first),
                len(part.points_world),
                extent_of(positions),
                tuple((frames.names[a], frames.names[b]) for a, b in zip(first, last, strict=True)),
                (reasons[number - 1] or None) if number <= len(reasons) else None,
            )
        )
    return tuple(found)


def is_partial(maps: Sequence[MapSummary], num_frames: int) -> bool:
    """True if less than `MIN_SHARE_IN_ONE_MAP` of a run's frames are in its largest map."""
    return maps[0].frames < MIN_SHARE_IN_ONE_MAP * num_frames


def format_outcome(report: Mapping[str, Any], run: object) -> str:
    """Outcome of a finished run, for a terminal.

    The first line counts the frames of the exported map, and then those of other maps. A table
    follows if there are several maps, and then the reasons of the verdict, and the verdict.

    Args:
        report: content of report.json.
    """
    summary, maps = report["summary"], report["maps"]
    residual, found = summary["median_residual_deg"], "rotations only, no points"
    if residual is not None:
        found = f"{summary['points']} points, median residual {residual:.4f} deg"
    first = f"{format_frame_counts(report)}, {found}: {run}"
    verdict, table = report["verdict"], _table(maps) if len(maps) > 1 else []
    shown, reasons = verdict["reasons"][:5], list[str]()
    for one in shown:
        reasons += [f"- {one['line']}"]
        if one["command"]:
            reasons += ["  " + one["command"].replace("RUN", shlex.quote(str(run)))]
    more = len(verdict["reasons"]) - len(shown)
    reasons += [f"- {more} more in report.html"] if more > 0 else []
    return "\n".join([first, *table, *reasons, verdict["sentence"]])


def format_frame_counts(report: Mapping[str, Any]) -> str:
    """Number of refined frames by a report.json of any version, and in brackets where the other
    frames are."""
    numbers = {"exported": report["summary"]["refined"], **report["summary"]}

    def number(name: str) -> int:
        return numbers.get(name, 0)

    others, start = number("maps") - 1, report.get("start", RunStart.TRAJECTORY)
    where = "another map" if others == 1 else f"{others} other maps"
    counts = {
        f"with the pose of the {start}": number("exported") - number("refined"),
        f"in {where}": number("frames_in_other_maps"),
        "in no map": number("frames_in_no_map"),
        "unusable": number("frames_unusable"),
        "more strengthened the map, and datasets skip them": number("fetched"),
    }
    parts = [f"{count} {where}" for where, count in counts.items() if count]
    refined = number("refined") - number("fetched")
    frames = number("frames") + number("frames_unusable") - number("frames_fetched")
    text = f"{refined} of {frames} frames refined"
    return f"{text} ({', '.join(parts)})" if parts else text


def _table(maps: Sequence[Mapping[str, Any]]) -> list[str]:
    """Table of maps in aligned columns, as lines."""
    names = ("map", "frames", "steps", "points")
    rows = [[*names, "extent", "first to last frame", "why it was not joined"]]
    for one in maps:
        spans = [a if a == b else f"{a} to {b}" for a, b in one["spans"]]
        more = [f"{len(spans) - _MAX_SHOWN_SPANS} more"] if len(spans) > _MAX_SHOWN_SPANS else []
        where = ", ".join([*spans[:_MAX_SHOWN_SPANS], *more])
        counts = [str(one[name]) for name in names]
        rows.append([*counts, f"{one['extent']:.4g}", where, one["reason"] or ""])
    if not any(row[-1] for row in rows[1:]):
        rows = [row[:-1] for row in rows]
    widths = [max(len(row[c]) for row in rows) for c in range(len(rows[0]))]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
