"""Fixtures that several files share."""

import logging
from pathlib import Path

import numpy as np
import pytest
from cameras_home import Home, make_home, make_two_sizes
from one_gallery import oval_walk
from tiny_run import Case, make_case

from gsba.demo import DemoWalk


@pytest.fixture(scope="session")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """A tiny rendered walk and its finished run; copy it before going on from it."""
    return make_case(tmp_path_factory.mktemp("pipeline"))


@pytest.fixture(scope="session")
def oval(tmp_path_factory: pytest.TempPathFactory) -> DemoWalk:
    """A small rendered walk once around; tests only read it."""
    return oval_walk(tmp_path_factory.mktemp("oval") / "walk")


@pytest.fixture(scope="session")
def cameras_home(oval: DemoWalk, tmp_path_factory: pytest.TempPathFactory) -> Home:
    """Recordings by different cameras; runs of them may be put into its folder."""
    return make_home(tmp_path_factory.mktemp("cameras"), oval)


@pytest.fixture(scope="session")
def two_sizes(cameras_home: Home) -> Path:
    """A finished run of recordings of two sizes; copy it before going on from it."""
    return make_two_sizes(cameras_home)


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
