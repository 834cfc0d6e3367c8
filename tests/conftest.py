"""Fixtures that several files share."""

import gc
import hashlib
import logging
import os
import pickle
import shutil
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from threading import get_ident
from typing import Any

# Read as NumPy and PyTorch load: workers fill the cores, and more threads would wait by spinning.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pytest
from cameras_home import (
    Home,
    make_beside_faces,
    make_beside_fisheyes,
    make_home,
    make_two_sizes,
)
from growing_home import GrowingHome, make_growing_home
from made_once import MadeOnce
from one_gallery import oval_walk
from tiny_run import PLAIN, Case, make_case

from gsba.demo import DemoWalk
from gsba.demo.gallery import build_gallery
from gsba.features import SiftExtractor
from gsba.loop_closure import retrieval
from gsba.matching import verification

gc.disable()  # while tests are collected: nothing of them goes away

# Files and folders whose tests take longest begin first, so that no worker is left alone with them.
# While the first file compiles the pipeline's kernels, the next ones need none of them.
_FIRST = (
    "pipeline/test_growing_cameras.py",
    "pipeline/test_growing.py",
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


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


@cache
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
def home(oval: DemoWalk, made_once: MadeOnce) -> Home:
    """Recordings by different cameras; runs of them may be put into its folder."""
    return made_once("cameras", lambda folder: make_home(folder, oval))


@pytest.fixture(scope="session")
def single_run(growing_home: GrowingHome, made_once: MadeOnce) -> Path:
    """A finished run of the first recording, its own copy: a run is held while it grows."""
    return made_once("single", lambda to: Path(shutil.copytree(growing_home.run, to / "run")))


@pytest.fixture(scope="session")
def two_sizes(home: Home, made_once: MadeOnce) -> Path:
    """A finished run of recordings of two sizes; copy it before going on from it."""
    return made_once("two-sizes", lambda folder: make_two_sizes(home, folder))


@pytest.fixture(scope="session")
def growing_home(oval: DemoWalk, made_once: MadeOnce) -> GrowingHome:
    """Two recordings of one place and a run of the first one; tests only read them."""
    return made_once("growing", lambda folder: make_growing_home(folder, oval))


@pytest.fixture(scope="session")
def faces_run(home: Home, made_once: MadeOnce) -> Path:
    """A finished run of panoramas and cube faces; copy it before going on from it."""
    return made_once("faces-run", lambda folder: make_beside_faces(home, folder))


@pytest.fixture(scope="session")
def fisheyes_run(home: Home, made_once: MadeOnce) -> Path:
    """A finished run of panoramas and raw fisheyes; copy it before going on from it."""
    return made_once("fisheyes-run", lambda folder: make_beside_fisheyes(home, folder))


@pytest.fixture(scope="session")
def plain_run(case: Case, made_once: MadeOnce) -> Path:
    """The tiny walk's run without patches."""
    return made_once("plain", lambda folder: case.refine(folder / "run", PLAIN).out)


def _kept(find: Callable, folder: Path) -> Callable:
    """The function; a folder keeps what it finds, by the content of its arguments."""

    def found(*given: Any) -> Any:
        content = hashlib.sha1(find.__qualname__.encode())
        for one in given:
            array = isinstance(one, np.ndarray)
            fact = repr((one.shape, one.dtype) if array else one)
            assert " at 0x" not in fact, f"an address says nothing of the content: {fact}"
            content.update(fact.encode() + (one.tobytes() if array else b""))
        kept = folder / content.hexdigest()
        if not kept.exists():
            new = kept.with_suffix(f".{os.getpid()}-{get_ident()}")
            new.write_bytes(pickle.dumps(find(*given)))
            new.rename(kept)
        return pickle.loads(kept.read_bytes())

    return found


def _settings_of(extractor: SiftExtractor) -> str:
    sift = extractor._sift
    return f"SIFT of {sift.getNFeatures()} keypoints from {sift.getContrastThreshold()}"


@pytest.fixture(scope="session", autouse=True)
def _found_once(made_once: MadeOnce) -> Iterator[None]:
    """Dozens of runs read the same pictures: keypoints of a face, the pose of a pair and words of
    descriptors are found once for all workers, and the demo's gallery is built once."""
    folder = made_once("found", lambda folder: folder)
    gallery = cache(lambda: made_once("gallery", lambda _: build_gallery()))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SiftExtractor, "__repr__", _settings_of)
        for owner, name in (
            (SiftExtractor, "__call__"),
            (verification, "sampled_pose"),
            (retrieval, "_centres"),
        ):
            patch.setattr(owner, name, _kept(getattr(owner, name), folder))
        patch.setattr("gsba.demo.gallery.build_gallery", gallery)
        yield


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
