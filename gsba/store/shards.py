"""Work shared out by the frame: one interface, threads here or processes elsewhere.

A job is items that can be worked on alone and in any order. What workers elsewhere get is a part
of one: the path of a file in the run's folder that holds a block of items with what they need. They
write what they found beside it, and send back who they are and what it cost. A part is named after
its content, so that a block that is finished is never worked on again, whoever asks.
"""

import hashlib
import hmac
import io
import os
import pickle
import socket
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from gsba.disk import write_bytes
from gsba.log import GsbaError, track
from gsba.memory import freed_memory_kept
from gsba.store.records import RecordError, load_record, read_info, save_record
from gsba.version import __version__

R = TypeVar("R")
R_co = TypeVar("R_co", covariant=True)

BLOCK = 32  # consecutive frames that a worker elsewhere gets at a time
ITEMS = 256  # pairs of frames at most


class Job(Protocol[R_co]):
    """Items that can be worked on alone and in any order, from any thread.

    What is to travel can be pickled, and holds arrays, settings and paths, no pixels.
    """

    @property
    def title(self) -> str:
        """Beside the progress bar."""
        ...

    @property
    def returns(self) -> Any:
        """Type of an item's result, as `gsba.store.records` stores it."""
        ...

    def __len__(self) -> int: ...

    def __call__(self, item: int, /) -> R_co:
        """Work on one item, without threads of its own."""
        ...

    def blocks(self) -> Sequence[tuple[int, int]]:
        """Runs of items, from start to before stop, that one worker should do."""
        ...

    def part(self, start: int, stop: int, /) -> "Job[R_co]":
        """These items alone, numbered from 0, with what they need."""
        ...


@dataclass(frozen=True, slots=True)
class Spent:
    """What workers elsewhere have done so far."""

    cpu_seconds: float = 0.0
    shards: Mapping[str, int] = field(default_factory=dict)  # of each worker


class Workers(Protocol):
    """Who works on jobs."""

    def map_shards(self, job: Job[R]) -> Iterator[R]:
        """Result of each item, in order; the same to the byte whoever works."""
        ...

    def spent(self) -> Spent:
        """So far, elsewhere."""
        ...

    def at_most(self, num: int) -> "Workers":
        """The same, at so many items at a time in this process."""
        ...

    def must_see(self, paths: Sequence[Path]) -> None:
        """Refuse workers that do not see these.

        Raises:
            GsbaError: one does not.
        """
        ...


@dataclass(frozen=True, slots=True)
class Threads:
    """Threads of this process."""

    num_threads: int  # items at a time

    def map_shards(self, job: Job[R]) -> Iterator[R]:
        """See `Workers`."""
        with ThreadPoolExecutor(self.num_threads) as pool:
            running = deque(pool.submit(job, item) for item in range(len(job)))
            try:
                for _ in track(range(len(job)), job.title):
                    yield running.popleft().result()  # held no longer than it is used
            finally:
                pool.shutdown(wait=True, cancel_futures=True)

    def spent(self) -> Spent:
        """Nothing is done elsewhere."""
        return Spent()

    def at_most(self, num: int) -> "Threads":
        """See `Workers`."""
        return Threads(min(self.num_threads, num))

    def must_see(self, paths: Sequence[Path]) -> None:
        """This process sees them."""


def blocks_of_frames(frames: np.ndarray) -> list[tuple[int, int]]:
    """Runs of at most `ITEMS` items whose frames (N,), ascending, are of the same `BLOCK`."""
    cuts = np.flatnonzero(np.diff(frames // BLOCK)) + 1
    bounds = pairwise([0, *cuts.tolist(), len(frames)])
    return [(start, min(start + ITEMS, b)) for a, b in bounds for start in range(a, b, ITEMS)]


def even_blocks(num: int, size: int = BLOCK) -> list[tuple[int, int]]:
    """Runs of so many items."""
    return [(start, min(start + size, num)) for start in range(0, num, size)]


@dataclass(frozen=True, slots=True)
class StoredRecords(Generic[R]):
    """Records of frames, by number, as they lie in the run's folder."""

    paths: Mapping[int, Path]
    keys: Mapping[int, str]  # that they were saved with
    returns: type[R]

    def __call__(self, number: int) -> R:
        """One of them.

        Raises:
            GsbaError: it is not there, or is another one.
        """
        path = self.paths[number]
        try:
            if read_info(path).get("key") == self.keys[number]:
                return load_record(path, self.returns)
        except RecordError as error:
            raise GsbaError(f"{error}: run again to have it made anew") from error
        raise GsbaError(f"{path} has changed while a run used it: run again")


@dataclass(frozen=True, slots=True)
class Manifest:
    """What a worker sends back for a shard."""

    worker: str  # host and process
    seconds: float  # wall clock
    cpu_seconds: float


def write_shard(job: Job[R], folder: Path) -> tuple[Path, str]:
    """Write a part of a job for a worker.

    Args:
        job: the part.
        folder: of shards, on a disk that workers share.

    Returns:
        Its file, whose result goes to `result_path` of it, and the SHA-256 of its content, which
        `run_shard` is to be told by other ways than this disk.
    """
    content = f"{__version__}\n".encode() + _pickled(job)
    digest = hashlib.sha256(content).hexdigest()
    path = folder.absolute() / f"{digest[:32]}.job"
    write_bytes(path, content)
    return path, digest


def result_path(shard: Path) -> Path:
    """Where the result of a shard is."""
    return shard.with_suffix(".npz")


def run_shard(path: str, digest: str) -> Manifest:
    """Work on a shard, and store what is found beside it; what a worker elsewhere calls.

    A job can run any code, so that none is loaded but what the caller has made: anybody may have
    written into the folder of a run that was copied from elsewhere.

    Args:
        path: of the shard.
        digest: SHA-256 of its content, as `write_shard` gave it to the caller.

    Raises:
        GsbaError: a file that this worker does not see, one of another version of gsba, or one
            that the caller has not written.
    """
    shard, worker = Path(path), f"{socket.gethostname()}:{os.getpid()}"
    if not shard.exists():
        raise GsbaError(f"worker {worker} does not see {path}: put the run on a shared disk")
    wall, cpu = time.perf_counter(), time.thread_time()
    content = shard.read_bytes()
    if not hmac.compare_digest(hashlib.sha256(content).hexdigest(), digest):
        raise GsbaError(f"{path} is not what this run wrote there: end what else writes to it")
    version, _, pickled = content.partition(b"\n")
    if version != __version__.encode():
        raise GsbaError(f"worker {worker} has gsba {__version__}, the run has {version.decode()}")
    job = pickle.loads(pickled)
    with freed_memory_kept():  # Dask has workers return it at once
        results = tuple(job(item) for item in range(len(job)))
    save_record(result_path(shard), results, {"key": shard.stem})
    return Manifest(worker, time.perf_counter() - wall, time.thread_time() - cpu)


def load_shard(shard: Path, returns: Any) -> tuple[Any, ...] | None:
    """Results of a shard's items; None where there are none that can be used."""
    try:
        path = result_path(shard)
        if read_info(path).get("key") == shard.stem:
            return load_record(path, tuple[returns, ...])
    except RecordError:
        pass
    return None


class _Pickler(pickle.Pickler):
    """Values alone: equal ones give equal bytes, however they share their parts."""

    def reducer_override(self, obj: object) -> Any:
        if isinstance(obj, np.ndarray):
            return _array, (obj.dtype.str, obj.shape, np.ascontiguousarray(obj).tobytes())
        return NotImplemented


def _pickled(value: object) -> bytes:
    buffer = io.BytesIO()
    _pickle(value, buffer)
    return buffer.getvalue()


def content_digest(*values: object) -> str:
    """SHA-256 of values that can be pickled, by what they hold."""
    total = hashlib.sha256()
    _pickle(values, SimpleNamespace(write=total.update))
    return total.hexdigest()


def _pickle(value: object, file: Any) -> None:
    pickler = _Pickler(file, protocol=5)
    pickler.fast = True  # no references to what was seen before
    pickler.dump(value)


def _array(dtype: str, shape: tuple[int, ...], content: bytes) -> np.ndarray:
    return np.frombuffer(bytearray(content), dtype).reshape(shape)
