"""Expected failures, the log on the terminal, progress bars, and events for other programs."""

import json
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sized
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

if TYPE_CHECKING:
    from rich.console import Console

T = TypeVar("T")

EVENTS = "GSBA_EVENTS"  # environment variable that names the file of events


class GsbaError(Exception):
    """Input or setting that cannot be used: one line with the problem, its place and the remedy."""

    def begin_with(self, place: str) -> None:
        """Put a place before the line."""
        self.args = (f"{place}: {self}",)


class StoppedError(GsbaError):
    """Work that an outside cause ended, and that resumes when it is run again."""


class Follower(Protocol):
    """Object that takes each event, and has a word for all progress bars."""

    def add(self, entry: Mapping[str, Any], /) -> None:
        """Take up an event."""
        ...

    def note(self) -> str:
        """Text beside progress bars; "" = none."""
        ...


_followers: list[Follower] = []
_following = threading.RLock()  # what a follower logs is an event, too


def show_log(level: int = logging.INFO) -> None:
    """Send the log of gsba and its factors to stderr, from `level` on; on a terminal, log lines do
    not disturb the progress bar."""
    if sys.stderr.isatty():
        from rich.logging import RichHandler

        handler = RichHandler(console=_console(), show_path=False, rich_tracebacks=False)
        handler.setFormatter(logging.Formatter("%(message)s"))
    else:
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s", "%X"))
    for name in ("gsba", "factors"):
        logger = logging.getLogger(name)
        logger.handlers[:] = [handler, _EventHandler()]
        logger.setLevel(level)
        logger.propagate = False


@contextmanager
def held_until_computing() -> Iterator[None]:
    """Hold lines of level INFO back until a stage is computed. Where none is, one line says so in
    their place, as they repeat those of an earlier call. With `-v` nothing is held back."""
    logger = logging.getLogger("gsba")
    shown = [one for one in logger.handlers if not isinstance(one, _EventHandler)]
    if logger.isEnabledFor(logging.DEBUG) or not shown:
        yield
        return
    held = _HeldLines(shown[0])
    shown[0].addFilter(held)
    try:
        with following(held):
            yield
        if held.resumed and not held.released:
            held.drop()
            stages, seconds = len(held.resumed), sum(held.resumed.values())
            text = "nothing changed: %d stages of an earlier call resumed, which took %.0f s"
            logger.info(text, stages, seconds)
    finally:
        held.release()
        shown[0].removeFilter(held)


def brief(text: str, most: int = 60) -> str:
    """Text of at most `most` characters; of a longer one the middle is left out."""
    kept = most // 2 - 1
    return text if len(text) <= most else f"{text[:kept]}...{text[-kept + 1 :]}"


def event(kind: str, **values: object) -> None:
    """Pass an event to those that follow it, and append it, as one line of JSON, to the file that
    GSBA_EVENTS names, if it is set. A file that cannot be written ends no run.

    Args:
        kind: kind of the event, the entry "event" of the line; "time" is seconds since 1970.
        values: further entries, plain values for JSON.
    """
    entry = {"event": kind, "time": round(time.time(), 3), **values}
    with _following:
        for follower in _followers:
            follower.add(entry)
    path = os.environ.get(EVENTS)
    if not path:
        return
    line = json.dumps(entry) + "\n"
    with suppress(OSError):
        file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        try:
            os.write(file, line.encode())  # one call: lines of two processes do not mix
        finally:
            os.close(file)


@contextmanager
def following(follower: Follower) -> Iterator[None]:
    """Pass all events within this context to a follower."""
    _followers.append(follower)
    try:
        yield
    finally:
        _followers.remove(follower)


def track(
    items: Iterable[T],
    description: str,
    total: int | None = None,
    done: int = 0,
    note: Callable[[], str] | None = None,
) -> Iterator[T]:
    """Yield `items` and show their progress, as a bar on a terminal's stderr unless the run is
    quiet, and as events (see `event`), out of `total`, with a note behind the speed."""
    with_bar = sys.stderr.isatty() and logging.getLogger("gsba").isEnabledFor(logging.INFO)
    if not (with_bar or _followers or os.environ.get(EVENTS)):
        yield from items
        return
    if total is None and isinstance(items, Sized):
        total = len(items)
    work = {"what": description, "total": total}
    event("progress", **work, done=done, rate=None, note="")
    began = told = drawn = time.monotonic()
    silent = nullcontext(lambda count, note: None)
    with _bar(description, total, done) if with_bar else silent as show:
        for count, item in enumerate(items, start=1):
            yield item
            now, last = time.monotonic(), done + count == total
            due = now - told > 0.5 or last  # s between two events
            draws = with_bar and (now - drawn > 0.1 or last)
            if not (draws or due):
                continue
            speed, more = count / max(now - began, 1e-6), "" if note is None else note()
            if draws:
                drawn = now
                parts = [f"{speed:.3g} a second", more, *(one.note() for one in _followers)]
                show(done + count, ", ".join(filter(None, parts)))
            if due:
                told = now
                event("progress", **work, done=done + count, rate=round(speed, 4), note=more)


@contextmanager
def _bar(description: str, total: int | None, done: int) -> Iterator[Callable[[int, str], None]]:
    """Show a progress bar; yields a function that takes the number of items done and a note."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=_console(), transient=True) as bar:
        task = bar.add_task(description, total=total, completed=done, note="")
        yield lambda count, note: bar.update(task, completed=count, note=note)


class _HeldLines(logging.Filter):
    """Filter of a handler that holds lines back until it is released, by work that begins."""

    def __init__(self, handler: logging.Handler) -> None:
        super().__init__()
        self.released = False
        self.resumed: dict[str, float] = {}  # stage -> seconds of the call that computed it
        self._handler = handler
        self._lines: list[logging.LogRecord] = []

    def filter(self, record: logging.LogRecord) -> bool:
        """False for a line that is held back."""
        if self.released or record.levelno != logging.INFO:
            return True
        self._lines.append(record)
        return False

    def release(self) -> None:
        """Show the lines that were held back, and hold no others."""
        self.released = True
        lines, self._lines = self._lines, []
        for record in lines:
            self._handler.handle(record)

    def drop(self) -> None:
        """Show none of the lines that were held back, and hold no others."""
        self._lines = []
        self.release()

    def add(self, entry: Mapping[str, Any]) -> None:
        """Take up an event; see `Follower`."""
        if entry["event"] == "stage" and not self.released:
            self.release()
        elif entry["event"] == "done":
            self.resumed[str(entry["name"])] = float(entry["seconds"])

    def note(self) -> str:
        """No text beside progress bars."""
        return ""


class _EventHandler(logging.Handler):
    """Log handler that passes lines of the log on as events."""

    def emit(self, record: logging.LogRecord) -> None:
        event("log", level=record.levelname, text=record.getMessage())


@cache
def _console() -> "Console":
    """Console on stderr that progress bars and log lines share, so that they do not overlap."""
    from rich.console import Console

    return Console(stderr=True)
