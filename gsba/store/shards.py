"""Parallel work on frames: one interface for threads of this process and remote workers. A shard is
a file with a block of a job's items and their inputs, named after its content, so that a finished
one is never computed again."""

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
from gsba.store.records import RecordError, load_keyed, save_record
from gsba.version import __version__

R = TypeVar("R")
R_co = TypeVar("R_co", covariant=True)

BLOCK = 32  # consecutive frames in a shard
ITEMS = 256  # most items, e.g. pairs of frames, in a shard


class Job(Protocol[R_co]):
    """Items that any thread can compute independently, in any order.

    Parts for remote workers can be pickled, and hold arrays, settings and paths, no pixels.
    """

    @property
    def title(self) -> str:
        """Text beside the progress bar."""
        ...

    @property
    def returns(self) -> Any:
        """Type of an item's result, as `gsba.store.records` stores it."""
        ...

    def __len__(self) -> int: ...

    def __call__(self, item: int, /) -> R_co:
        """Result of one item, computed in the calling thread."""
        ...

    def blocks(self) -> Sequence[tuple[int, int]]:
        """Ranges of items, from start to before stop, each for one worker."""
        ...

    def part(self, start: int, stop: int, /) -> "Job[R_co]":
        """Job of these items alone, numbered from 0, with their inputs."""
        ...


@dataclass(frozen=True, slots=True)
class Spent:
    """Work that remote workers have done so far."""

    cpu_seconds: float = 0.0
    shards: Mapping[str, int] = field(default_factory=dict)  # worker -> number of its shards


class Workers(Protocol):
    """Threads or remote workers that compute jobs."""

    @property
    def num_threads(self) -> int:
        """Threads of this process, for what is not shared out."""
        ...

    def map_shards(self, job: Job[R]) -> Iterator[R]:
        """Result of each item, in order; its bytes do not depend on the worker."""
        ...

    def spent(self) -> Spent:
        """Work of remote workers so far."""
        ...

    def at_most(self, num: int) -> "Workers":
        """Workers that compute at most `num` items at a time in this process."""
        ...

    def must_see(self, paths: Sequence[Path]) -> None:
        """Refuse workers that do not see these paths."""
        ...


@dataclass(frozen=True, slots=True)
class Threads:
    """Threads of this process."""

    num_threads: int  # as many items at a time

    def map_shards(self, job: Job[R]) -> Iterator[R]:
        """See `Workers`."""
        with ThreadPoolExecutor(self.num_threads) as pool:
            running = deque(pool.submit(job, item) for item in range(len(job)))
            try:
                for _ in track(range(len(job)), job.title):
                    yield running.popleft().result()  # not kept after use
            finally:
                pool.shutdown(wait=True, cancel_futures=True)

    def spent(self) -> Spent:
        """No work: there are no remote workers."""
        return Spent()

    def at_most(self, num: int) -> "Threads":
        """See `Workers`."""
        return Threads(min(self.num_threads, num))

    def must_see(self, paths: Sequence[Path]) -> None:
        """Accept all paths: this process sees them."""


def blocks_of_frames(frames: np.ndarray) -> list[tuple[int, int]]:
    """Ranges of at most `ITEMS` items whose frames (N,), ascending, are of the same `BLOCK`."""
    cuts = np.flatnonzero(np.diff(frames // BLOCK)) + 1
    bounds = pairwise([0, *cuts.tolist(), len(frames)])
    return [(start, min(start + ITEMS, b)) for a, b in bounds for start in range(a, b, ITEMS)]


def even_blocks(num: int, size: int = BLOCK) -> list[tuple[int, int]]:
    """Ranges of `size` items; the last may be shorter."""
    return [(start, min(start + size, num)) for start in range(0, num, size)]


@dataclass(frozen=True, slots=True)
class StoredRecords(Generic[R]):
    """Stored records of frames in the run's folder, by number."""

    paths: Mapping[int, Path]  # file of each record
    keys: Mapping[int, str]  # key that each was saved with
    returns: type[R]  # type of the records

    def __call__(self, number: int) -> R:
        """Record of one frame. Raises GsbaError: the file is missing, or has another key."""
        path = self.paths[number]
        try:
            found = load_keyed(path, self.keys[number], self.returns)
        except RecordError as error:
            raise GsbaError(f"{error}: run again to compute it again") from error
        if found is not None:
            return found
        raise GsbaError(f"{path} has changed while a run used it: run again")


@dataclass(frozen=True, slots=True)
class Manifest:
    """Answer of a worker that has computed a shard."""

    worker: str  # host and process
    seconds: float  # wall clock
    cpu_seconds: float


def write_shard(job: Job[R], folder: Path) -> tuple[Path, str]:
    """Write a part of a job for a worker to a folder of shards, on a disk that workers share; gives
    its file and the SHA-256 of its content, which must reach `run_shard` by another way."""
    buffer = io.BytesIO()
    _pickle(job, buffer)
    content = f"{__version__}\n".encode() + buffer.getvalue()
    digest = hashlib.sha256(content).hexdigest()
    path = folder.absolute() / f"{digest[:32]}.job"
    write_bytes(path, content)
    return path, digest


def result_path(shard: Path) -> Path:
    """File of a shard's result."""
    return shard.with_suffix(".npz")


def run_shard(path: str, digest: str) -> Manifest:
    """Compute a shard on a remote worker and store its results beside it.

    Unpickling a job can run any code. The digest makes sure that the caller has written the job:
    others may have written into the folder of a run that was copied.

    Args:
        digest: SHA-256 of its content from `write_shard`.

    Raises:
        GsbaError: this worker does not see the file, the file is of another version of gsba, or
            the caller has not written it.
    """
    shard, worker = Path(path), f"{socket.gethostname()}:{os.getpid()}"
    if not shard.exists():
        raise GsbaError(f"worker {worker} does not see {path}: put the run on a shared disk")
    wall, cpu = time.perf_counter(), time.thread_time()
    content = shard.read_bytes()
    if not hmac.compare_digest(hashlib.sha256(content).hexdigest(), digest):
        raise GsbaError(f"{path} was changed after this run wrote it: end the other writer")
    version, _, pickled = content.partition(b"\n")
    if version != __version__.encode():
        raise GsbaError(f"worker {worker} has gsba {__version__}, the run has {version.decode()}")
    job = pickle.loads(pickled)
    with freed_memory_kept():  # Dask makes workers return freed memory at once
        results = tuple(job(item) for item in range(len(job)))
    save_record(result_path(shard), results, {"key": shard.stem})
    return Manifest(worker, time.perf_counter() - wall, time.thread_time() - cpu)


def load_shard(shard: Path, returns: Any) -> tuple[Any, ...] | None:
    """Results of a shard's items; None if there is no usable result."""
    try:
        return load_keyed(result_path(shard), shard.stem, tuple[returns, ...])
    except RecordError:
        return None


class _Pickler(pickle.Pickler):
    """Pickler that gives equal values equal bytes, whether or not they share objects."""

    def reducer_override(self, obj: object) -> Any:
        if isinstance(obj, np.ndarray):
            return _array, (obj.dtype.str, obj.shape, np.ascontiguousarray(obj).tobytes())
        return NotImplemented


def content_digest(*values: object) -> str:
    """SHA-256 of the content of values that can be pickled."""
    total = hashlib.sha256()
    _pickle(values, SimpleNamespace(write=total.update))
    return total.hexdigest()


def _pickle(value: object, file: Any) -> None:
    pickler = _Pickler(file, protocol=5)
    pickler.fast = True  # no references to earlier objects
    pickler.dump(value)


def _array(dtype: str, shape: tuple[int, ...], content: bytes) -> np.ndarray:
    return np.frombuffer(bytearray(content), dtype).reshape(shape)
