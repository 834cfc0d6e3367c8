"""Time left that `gsba refine` states, against the time that the run then took.

    python -m benchmarks.time_left record EVENTS REFINE_ARGUMENTS...
    python -m benchmarks.time_left fit EVENTS...    # prints _COSTS of gsba/report/time_left.py
    python -m benchmarks.time_left table EVENTS...  # of other runs than those of the fit

`record` runs `gsba refine` in this process and writes its events with clocks of the processor. The
time of both other commands is the processor time of the thread that computes stages, and a half of
that of the others: seconds of two cores that do nothing else.
"""

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import nnls

from gsba.report.time_left import (
    FEATURES,
    OPTIONAL,
    PHASES,
    UNDER_LENSES,
    Size,
    TimeLeft,
    in_words,
    is_single,
    phase_of,
)

SHARES = (0.1, 0.25, 0.5, 0.75)  # of a run, after which its time left is compared


class _Recorder:
    """Follower that writes each event with two more clocks."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", buffering=1)

    def add(self, entry: Mapping[str, Any]) -> None:
        clocks = {"cpu": time.process_time(), "thread": time.thread_time()}
        self._file.write(json.dumps({**entry, **clocks}) + "\n")

    def note(self) -> str:
        return ""


def record(path: Path) -> None:
    """Run the command of `sys.argv` in this process, and write its events."""
    from gsba.cli import main
    from gsba.log import following

    recorder = _Recorder(path)
    recorder.add({"event": "begin", "time": time.time() - time.process_time()})
    try:
        with following(recorder):
            main()
    finally:
        recorder.add({"event": "exit", "time": time.time()})


def read(path: Path) -> list[dict[str, Any]]:
    """Events of a recorded run, with `quiet`: seconds since its start on two quiet cores."""
    events = [json.loads(line) for line in path.read_text().splitlines()]
    for entry in events:
        entry["quiet"] = 0.5 * (entry["cpu"] + entry["thread"])
    return events


@dataclass(frozen=True, slots=True)
class _Spent:
    """A phase of a pass of a run."""

    phase: int
    size: Size
    seconds: float  # on two quiet cores
    serial: float  # of these, seconds of one thread alone
    total: float  # seconds of the whole run


def spent(events: Sequence[dict[str, Any]]) -> list[_Spent]:
    """Phases of a run; those that the last pass has left out with no time."""
    size, at, under_lenses, told = None, None, False, TimeLeft()
    rows: list[tuple[int, int, Size, float, float]] = []
    passes = 0
    for entry in events:
        if entry["event"] == "run":
            size = Size.of(entry)
        if entry["event"] != "end":
            told.add({**entry, "time": entry["quiet"]})
        if size is None or told.size is None or entry["event"] not in ("stage", "exit"):
            continue
        name = entry.get("name", "")
        under_lenses |= UNDER_LENSES.fullmatch(name) is not None
        number = phase_of(name)
        if at is not None and number != at[0]:
            known = replace(at[1], observations=told.size.observations, more=told.size.more)
            rows.append((at[0], passes, known, *(entry[c] - at[2][c] for c in ("quiet", "thread"))))
            passes += number is not None and number <= FEATURES < at[0]
            at = None
        if at is None and number is not None:
            at = number, size, entry
    if size is None:
        return []
    last = {phase for phase, number, *_ in rows if number == passes}
    size = replace(size, more=told.size is not None and told.size.more)
    rows += [(n, passes, size, 0.0, 0.0) for n in range(1, len(PHASES)) if n not in last]
    total = events[-1]["quiet"]
    return [
        _Spent(
            phase,
            replace(size, lenses=float(under_lenses), uncut=size.uncut and not number),
            seconds,
            serial,
            total,
        )
        for phase, number, size, seconds, serial in rows
    ]


def fit(runs: Sequence[Sequence[dict[str, Any]]]) -> None:
    """Print the phases with costs that fit the shares of all runs best, none below zero."""
    rows = [row for events in runs for row in spent(events)]
    for number in range(len(PHASES)):
        # Costs of an optional phase are fitted to the runs that had it.
        chosen = [r for r in rows if r.phase == number and (r.seconds or number not in OPTIONAL)]
        weights = np.array([1 / (row.seconds + 0.4 * row.total) for row in chosen])
        terms = np.array([row.size.terms(number) for row in chosen]) * weights[:, None]
        costs, _ = nnls(terms, np.array([row.seconds for row in chosen]) * weights)
        serial = sum(row.serial for row in chosen) / sum(row.seconds for row in chosen)
        print(f"    ({', '.join(f'{value:.3g}' for value in (serial, *costs))}),")


def stated(
    events: Sequence[dict[str, Any]], clock: str
) -> list[tuple[float, tuple[float, float] | None]]:
    """Seconds that were left at each of SHARES of a run, and the least and most that were stated
    (None = nothing was)."""
    began, end = (events[n]["time"] if clock == "time" else 0.0 for n in (0, -1))
    end = end if clock == "time" else events[-1]["quiet"]
    found = []
    for share in SHARES:
        now, whole = began + share * (end - began), TimeLeft()
        for entry in events:
            if entry[clock] <= now:
                whole.add({**entry, "time": entry[clock]})
        found.append(((1 - share) * (end - began), whole.seconds(now)))
    return found


def holds(left: float, seconds: tuple[float, float]) -> bool:
    """True if a statement is right: its one duration, or the nearer end of its range, within a
    third."""
    least, most = seconds
    if is_single(seconds):
        least = most = (least * most) ** 0.5
    return 2 / 3 * least <= left <= 4 / 3 * most


def main() -> None:
    """See the module's docstring."""
    if sys.argv[1:2] == ["record"]:
        path, sys.argv[1:] = Path(sys.argv[2]), ["refine", *sys.argv[3:]]
        record(path)
        return
    parser = argparse.ArgumentParser(description="Time left against the time taken.")
    parser.add_argument("what", choices=["fit", "table"])
    parser.add_argument("--clock", choices=["quiet", "time"], default="quiet")
    parser.add_argument("events", type=Path, nargs="+")
    given = parser.parse_args()
    runs = {path.stem: read(path) for path in given.events}
    if given.what == "fit":
        fit(list(runs.values()))
        return
    print(f"| run | s |{''.join(f' {share:.0%} |' for share in SHARES)}")
    print("|---|---:|" + len(SHARES) * "---:|")
    table = {name: stated(events, given.clock) for name, events in runs.items()}
    for name, row in table.items():
        cells = [f"{left:.0f}: {in_words(told) if told else ''}" for left, told in row]
        print(f"| {name} | {runs[name][-1]['quiet']:.0f} | {' | '.join(cells)} |")
    for title, chosen in (("one duration", True), ("a range", False)):
        cells = []
        for column in zip(*table.values(), strict=True):
            told = [(left, one) for left, one in column if one]
            told = [(x, one) for x, one in told if is_single(one) == chosen]
            cells.append(f"{sum(holds(*one) for one in told)} of {len(told)}")
        print(f"| right within a third, {title} | | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
