"""Jobs for workers elsewhere, and what happens to them in the field."""

import ctypes
import os
import pickle
import resource
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from gsba.disk import atomic_write
from gsba.export.pictures import FrameWriter, SharedPixels
from gsba.store.shards import Job, Threads, even_blocks

R = TypeVar("R")


@dataclass(frozen=True)
class Squares:
    """Squares of numbers; every item worked on leaves a line in a file."""

    numbers: np.ndarray
    log: Path
    mishap: str = ""  # what befalls the worker, once
    at: int = -1  # the number at which it does
    size: int = 2  # items of a block
    title: str = "squares"
    returns: Any = np.ndarray

    def __len__(self) -> int:
        return len(self.numbers)

    def __call__(self, item: int) -> np.ndarray:
        number = self.numbers[item]
        with self.log.open("a") as log:
            log.write(f"{number}\n")
        if number == self.at and self._first():
            getattr(self, f"_{self.mishap}")()
        if number == self.at and self.mishap == "always dies":
            os.kill(os.getpid(), signal.SIGKILL)
        return np.full(1000 if self.mishap != "dies_while_writing" else 5_000_000, number) ** 2

    def blocks(self) -> Sequence[tuple[int, int]]:
        return even_blocks(len(self.numbers), self.size)

    def part(self, start: int, stop: int) -> "Squares":
        return replace(self, numbers=self.numbers[start:stop])

    def done(self) -> list[int]:
        """Numbers that were worked on, in any order."""
        return sorted(map(int, self.log.read_text().split())) if self.log.exists() else []

    def _first(self) -> bool:
        """Whether nobody was here before."""
        marker = self.log.with_suffix(f".{self.mishap}")
        if not hasattr(self, f"_{self.mishap}") or marker.exists():
            return False
        marker.touch()
        return True

    def _dies(self) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    def _dies_while_writing(self) -> None:
        """As soon as the result's temporary file is there."""
        folder = self.log.parent / "shards"

        def watch() -> None:
            while not list(folder.glob(".gsba-tmp-*")):
                pass
            os.kill(os.getpid(), signal.SIGKILL)

        threading.Thread(target=watch, daemon=True).start()

    def _keeps_the_lock(self) -> None:
        """As compiled code that does not let other threads of Python run."""
        ctypes.PyDLL(None).sleep(6)

    def _is_slow(self) -> None:
        time.sleep(15)

    def _finds_no_space(self) -> None:
        """No file may grow any more."""
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))


class Parts(Threads):
    """Does parts of two items, each as a worker elsewhere gets it."""

    def at_most(self, num: int) -> "Parts":
        return self

    def map_shards(self, job: Job[R]) -> Iterator[R]:
        for start, stop in even_blocks(len(job), 2):
            part = pickle.loads(pickle.dumps(job.part(start, stop)))
            yield from map(part, range(len(part)))


@dataclass(frozen=True, slots=True)
class DiesWriting(FrameWriter):
    """Kills the worker in the middle of a picture of one frame, once."""

    at: str  # name of the frame

    def __call__(self, shown: SharedPixels) -> None:
        marker = self.files.folder.with_name("died")
        if shown.frames.names[shown.f] == self.at and not marker.exists():
            marker.touch()
            atomic_write(self.images(shown)[1], self._half)

    def _half(self, temporary: Path) -> None:
        temporary.write_bytes(b"half")
        os.kill(os.getpid(), signal.SIGKILL)
