"""Fixtures that several files share."""

import logging
from collections.abc import Iterator

import pytest
from tiny_run import Case, make_case


@pytest.fixture(scope="session")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """A tiny rendered walk and its finished run; copy it before going on from it."""
    return make_case(tmp_path_factory.mktemp("pipeline"))


@pytest.fixture(autouse=True)
def _own_log() -> Iterator[None]:
    """What a command does to the log ends with its test: others look at what is logged."""
    loggers = [logging.getLogger(name) for name in ("gsba", "factors")]
    before = [(one.handlers[:], one.level, one.propagate) for one in loggers]
    yield
    for one, (handlers, level, propagate) in zip(loggers, before, strict=True):
        one.handlers[:], one.propagate = handlers, propagate
        one.setLevel(level)
