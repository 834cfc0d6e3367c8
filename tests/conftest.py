"""Fixtures that several files share."""

import logging

import numpy as np
import pytest
from tiny_run import Case, make_case


@pytest.fixture(scope="session")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """A tiny rendered walk and its finished run; copy it before going on from it."""
    return make_case(tmp_path_factory.mktemp("pipeline"))


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator of the test's own: what it draws hangs on no other test."""
    return np.random.default_rng(0)


@pytest.fixture(autouse=True)
def _untouched_log() -> None:
    """The log as if no command had run before, in another test or a fixture of many."""
    for name in ("gsba", "factors"):
        logger = logging.getLogger(name)
        logger.handlers.clear()
        logger.setLevel(logging.NOTSET)
        logger.propagate = True
