"""Lines of the log that a call without work does not repeat."""

import io
import logging
from collections.abc import Callable, Iterator

import pytest

from gsba.log import GsbaError, event, held_until_computing, show_log

LOGGER = logging.getLogger("gsba.test")


@pytest.fixture
def lines(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], list[str]]]:
    """Lines shown since the last call, without their times."""
    shown = io.StringIO()
    monkeypatch.setattr("sys.stderr", shown)
    loggers = [logging.getLogger(name) for name in ("gsba", "factors")]
    before = [(one.handlers[:], one.level, one.propagate) for one in loggers]
    show_log()

    def taken() -> list[str]:
        text = shown.getvalue()
        shown.seek(0)
        shown.truncate()
        return [line.split(" ", 1)[1] for line in text.splitlines()]

    yield taken
    for one, (handlers, level, propagate) in zip(loggers, before, strict=True):
        one.handlers[:], one.propagate = handlers, propagate
        one.setLevel(level)


def test_a_call_that_computes_nothing_shows_one_line(lines: Callable[[], list[str]]) -> None:
    with held_until_computing():
        LOGGER.info("8 frames")
        event("progress", what="checking frames", total=8, done=8)
        for name in ("one", "two", "two"):
            event("done", name=name, seconds=2.0, resumed=True)
        LOGGER.warning("dark")
    LOGGER.info("after")
    expected = "INFO nothing changed: 2 stages of an earlier call resumed, which took 4 s"
    assert lines() == ["WARNING dark", expected, "INFO after"]


def test_lines_are_shown_when_a_stage_is_computed(lines: Callable[[], list[str]]) -> None:
    with held_until_computing():
        LOGGER.info("8 frames")
        event("done", name="one", seconds=2.0, resumed=True)
        assert lines() == []
        event("stage", name="two", title="match")
        assert lines() == ["INFO 8 frames"]
        event("done", name="two", seconds=1.0, resumed=False)
        LOGGER.info("matched")
    assert lines() == ["INFO matched"]


def test_lines_are_shown_before_a_failure(lines: Callable[[], list[str]]) -> None:
    with pytest.raises(GsbaError, match="no times"), held_until_computing():
        LOGGER.info("8 frames")
        raise GsbaError("no times")
    assert lines() == ["INFO 8 frames"]


def test_details_are_never_held_back(lines: Callable[[], list[str]]) -> None:
    logging.getLogger("gsba").setLevel(logging.DEBUG)
    with held_until_computing():
        LOGGER.info("8 frames")
        event("done", name="one", seconds=2.0, resumed=True)
    assert lines() == ["INFO 8 frames"]
