"""Data that takes long to make, made once for all workers of a test run."""

import fcntl
import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest

T = TypeVar("T")


class MadeOnce:
    """Makes each named value in the first worker that needs it; the others read it.

    All workers see the same folders: tests only read what lies there, or copy it before they change
    it.
    """

    def __init__(self, factory: pytest.TempPathFactory) -> None:
        base = factory.getbasetemp()
        if "PYTEST_XDIST_WORKER" in os.environ:  # each worker has a folder of its own in this one
            base = base.parent
        self._folder = base / "made-once"
        self._folder.mkdir(exist_ok=True)

    def __call__(self, name: str, make: Callable[[Path], T]) -> T:
        """The value that `make` returns, called with a new folder for its files.

        Workers that need the value while one makes it wait. The value must be picklable.
        """
        folder, stored = self._folder / name, self._folder / f"{name}.pickle"
        with (self._folder / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # closing the file releases it
            if not stored.exists():
                shutil.rmtree(folder, ignore_errors=True)  # left by a worker that failed
                folder.mkdir()
                stored.write_bytes(pickle.dumps(make(folder)))
        return pickle.loads(stored.read_bytes())
