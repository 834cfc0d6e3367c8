"""Fixtures that several files share."""

import logging
import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read as NumPy loads: workers fill the cores


import numpy as np
import pytest
from cameras_home import Home, make_home, make_two_sizes
from made_once import MadeOnce
from one_gallery import oval_walk
from tiny_run import Case, make_case

from gsba.demo import DemoWalk

# Files and folders whose tests take longest begin first, so that no worker is left alone with them.
# While the first file compiles the pipeline's kernels, the next ones need none of them.
_FIRST = (
    "pipeline/test_growing_cameras.py",
    "scans",
    "loop_closure",
    "pipeline",
    "localization",
    "examples",
    "demo",
    "odometry",
    "parts",
    "masks",
    "placement",
    "bundle",
    "factors",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order files by how long they take; each file's tests stay in one worker and in order."""
    items.sort(key=lambda item: _place_in_queue(item.path))


def _place_in_queue(path: Path) -> int:
    tests = Path(__file__).parent
    found = (n for n, first in enumerate(_FIRST) if path.is_relative_to(tests / first))
    return next(found, len(_FIRST))


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> MadeOnce:
    """Values that are made once for all workers of a test run."""
    return MadeOnce(tmp_path_factory)


@pytest.fixture(scope="session")
def case(made_once: MadeOnce) -> Case:
    """A tiny rendered walk and its finished run; copy it before going on from it."""
    return made_once("case", make_case)


@pytest.fixture(scope="session")
def oval(made_once: MadeOnce) -> DemoWalk:
    """A small rendered walk once around; tests only read it."""
    return made_once("oval", lambda folder: oval_walk(folder / "walk"))


@pytest.fixture(scope="session")
def cameras_home(oval: DemoWalk, made_once: MadeOnce) -> Home:
    """Recordings by different cameras; runs of them may be put into its folder."""
    return made_once("cameras", lambda folder: make_home(folder, oval))


@pytest.fixture(scope="session")
def two_sizes(cameras_home: Home, made_once: MadeOnce) -> Path:
    """A finished run of recordings of two sizes; copy it before going on from it."""
    return made_once("two-sizes", lambda folder: make_two_sizes(cameras_home, folder))


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
