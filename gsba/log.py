"""Expected failures, the log on the terminal, and progress bars."""

import logging
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from functools import cache
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from rich.console import Console

T = TypeVar("T")


class GsbaError(Exception):
    """Input or setting that cannot be used: one line with the problem, its place and the remedy."""


class StoppedError(GsbaError):
    """Work that an outside cause ended, and that resumes when it is run again."""


def show_log(level: int = logging.INFO) -> None:
    """Send the log of gsba and its factors to stderr, for the command line.

    On a terminal, log lines do not disturb the progress bar.

    Args:
        level: lowest level shown, e.g. `logging.WARNING` for a quiet run.
    """
    if sys.stderr.isatty():
        from rich.logging import RichHandler

        handler = RichHandler(console=_console(), show_path=False, rich_tracebacks=False)
        handler.setFormatter(logging.Formatter("%(message)s"))
    else:
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s", "%X"))
    for name in ("gsba", "factors"):
        logger = logging.getLogger(name)
        logger.handlers[:] = [handler]
        logger.setLevel(level)
        logger.propagate = False


def brief(text: str, most: int = 60) -> str:
    """Text of at most `most` characters; of a longer one the middle is left out."""
    kept = most // 2 - 1
    return text if len(text) <= most else f"{text[:kept]}...{text[-kept + 1 :]}"


def track(
    items: Iterable[T],
    description: str,
    total: int | None = None,
    done: int = 0,
    note: Callable[[], str] | None = None,
) -> Iterator[T]:
    """Yield `items` and show a progress bar on stderr, on a terminal unless the run is quiet.

    Args:
        items: work to do.
        description: of the work.
        total: number of items, those done before among them; None = len(items).
        done: items that were done before.
        note: gives a text that stands behind the speed.
    """
    if not (sys.stderr.isatty() and logging.getLogger("gsba").isEnabledFor(logging.INFO)):
        yield from items
        return
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
    if total is None and isinstance(items, Sized):
        total = len(items)
    began = time.monotonic()
    with Progress(*columns, console=_console(), transient=True) as bar:
        task = bar.add_task(description, total=total, completed=done, note="")
        for count, item in enumerate(items, start=1):
            yield item
            speed = count / max(time.monotonic() - began, 1e-6)
            more = "" if note is None else f", {note()}"
            bar.update(task, completed=done + count, note=f"{speed:.3g} a second{more}")


@cache
def _console() -> "Console":
    """Console on stderr that progress bars and log lines share, so that they do not overlap."""
    from rich.console import Console

    return Console(stderr=True)
