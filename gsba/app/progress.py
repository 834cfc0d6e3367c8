"""The progress of a job from its events: stages, speed, time left, warnings, the path so far."""

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsba.report.time_left import TimeLeft, in_words


def read_events(path: Path, offset: int = 0) -> tuple[list[dict[str, Any]], int]:
    """Whole lines of a file of events from an offset on, and the offset behind them.

    A line that is no JSON object is left out.
    """
    try:
        with path.open("rb") as file:
            file.seek(offset)
            content = file.read()
    except OSError:
        return [], offset
    whole = content[: content.rfind(b"\n") + 1]
    found = []
    for line in whole.splitlines():
        try:
            entry = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if isinstance(entry, dict):
            found.append(entry)
    return found, offset + len(whole)


@dataclass
class Progress:
    """Stages, speed, warnings and path of a job, by the events since its latest start."""

    stages: list[dict[str, Any]] = field(default_factory=list)  # ended ones: name, title, seconds,
    # resumed
    stage: dict[str, Any] | None = None  # the one that runs: name, title, time
    work: dict[str, Any] | None = None  # in it: what, done, total, rate, note, time
    warnings: list[str] = field(default_factory=list)
    error: str = ""  # line that the command ended with
    last: float | None = None  # time of the last event
    keyframes: list[tuple[int, list[float]]] = field(default_factory=list)  # map and position
    points: list[list[float]] = field(default_factory=list)  # that keyframes see
    time_left: TimeLeft = field(default_factory=TimeLeft)

    def add(self, entry: Mapping[str, Any]) -> None:
        """Take up an event."""
        kind = entry.get("event")
        if kind == "start":
            self.__init__()
        self.last = entry.get("time", self.last)
        self.time_left.add(entry)
        if kind == "stage":
            self.stage, self.work = dict(entry), None
        elif kind == "done":
            if entry.get("name") not in self.names():  # runs take up their own stages again
                self.stages.append(dict(entry))
            self.stage = self.work = None
        elif kind == "progress":
            self.work = dict(entry)
        elif kind == "log" and entry.get("level") in ("WARNING", "ERROR", "CRITICAL"):
            text = str(entry.get("text"))
            if text not in self.warnings and len(self.warnings) < 200:
                self.warnings.append(text)
        elif kind == "error":
            self.error = str(entry.get("text"))
        elif kind == "end":
            self.stage = self.work = None
        elif kind == "keyframe":
            position, points = entry.get("position"), entry.get("points", [])
            if _finite(position):
                self.keyframes.append((entry.get("map", 0), list(position or ())))
            self.points += [list(point) for point in points if _finite(point)]
            if len(self.points) > 8000:
                self.points = self.points[::2]

    def names(self) -> list[str]:
        """Names of the stages that have ended, in order."""
        return [str(stage.get("name")) for stage in self.stages]

    def table(self) -> dict[str, Any]:
        """Plain values for JSON; "left" is the time that the whole run still takes, in words."""
        seconds = self.time_left.seconds(time.time())
        return {
            "stages": self.stages,
            "stage": self.stage,
            "work": self.work,
            "left": "" if seconds is None else in_words(seconds),
            "warnings": self.warnings,
            "error": self.error,
            "last": self.last,
            "keyframes": len(self.keyframes),
        }


def _finite(values: Sequence[Any] | None) -> bool:
    return bool(values) and all(isinstance(v, int | float) and math.isfinite(v) for v in values)
