"""Workers of a Dask scheduler, for `gsba.store.shards`: who they are, and what may happen to them.

Workers get paths only, and share the run's disk. A shard's result is a file that is written beside
its place and renamed into it, and is the same whoever makes it: a worker that dies, is lost from
sight or is slow costs time, and nothing else. The scheduler is asked for a window of shards at a
time, however many a job has.
"""

import importlib
import json
import logging
import os
import re
import shutil
import statistics
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from gsba.config import RefineSettings
from gsba.disk import disk_errors, hold_folder, remove_unheld, write_text
from gsba.log import GsbaError, StoppedError, brief, track
from gsba.store import shards
from gsba.store.shards import Job, Manifest, Spent, Workers
from gsba.types import FrameSet
from gsba.version import __version__

if TYPE_CHECKING:
    from distributed import Client, Future

R = TypeVar("R")

logger = logging.getLogger(__name__)

_QUEUES = {  # kind of address -> module and class that starts workers
    "slurm": ("dask_jobqueue", "SLURMCluster"),
    "pbs": ("dask_jobqueue", "PBSCluster"),
    "lsf": ("dask_jobqueue", "LSFCluster"),
    "sge": ("dask_jobqueue", "SGECluster"),
    "oar": ("dask_jobqueue", "OARCluster"),
    "htcondor": ("dask_jobqueue", "HTCondorCluster"),
    "kubernetes": ("dask_kubernetes.operator", "KubeCluster"),
}
_ADDRESS = re.compile(r"(tcp|tls|wss?|ucx)://[^\s/:][^\s/]*")
_AHEAD = 3  # shards for each thread that are written and asked for before they are needed
_ATTEMPTS = 5  # at a shard that workers died on
_LATE = 4.0  # times as long as others: a shard is given to another worker as well
_LEAST_LATE_S = 60.0
_LOOK_S = 5.0  # between looks at what is late
_ANSWER_S = 20.0  # for a scheduler to answer at all
_MOST_LOCAL, _MOST_QUEUED = 256, 100_000  # workers that may be asked for
_SIGHT_S = 30.0  # for a disk shared by machines to show what another one has written


def hire(
    client: "Client | None", frames: Path, settings: RefineSettings
) -> Callable[[Path], Workers]:
    """What makes the workers of a run, given the folder of its shards.

    Args:
        client: of a scheduler; None = threads here.
        frames: of the run, which workers read.
        settings: of the run.
    """

    def make(folder: Path) -> Workers:
        if client is None:
            return shards.Threads(settings.solver.threads())
        return Cluster(client, folder, frames)

    return make


@contextmanager
def hired(client: "Client | None", out: Path, frames: FrameSet) -> Iterator["Cluster | None"]:
    """Workers who write what goes to `out`, with their shards beside it meanwhile.

    Args:
        client: of a scheduler; None = nobody is hired.
        out: a folder on a disk that workers share; it need not be there.
        frames: which they read.
    """
    if client is None:
        yield None
        return
    out = out.resolve()
    with disk_errors(out):
        remove_unheld(out.parent.glob(f".{out.name}.shards-*"))  # of exports that were killed
        folder = out.with_name(f".{out.name}.shards-{uuid.uuid4().hex[:8]}")
        folder.mkdir(parents=True)
        lock = hold_folder(folder)
    try:
        yield Cluster(client, folder, frames.paths[0][0])
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


@contextmanager
def connected(address: str | None) -> Iterator["Client | None"]:
    """`connect` for as long as it lasts, workers that were started for it included; None for
    none."""
    if address is None:
        yield None
        return
    client: Any = connect(address)
    cluster = client.cluster
    try:
        yield client
    finally:
        with suppress(Exception):  # whatever is left of them
            client.close()
            if cluster is not None:
                cluster.close()


def connect(address: str) -> "Client":
    """A client of the scheduler at an address, whose workers are started if they must be.

    Args:
        address: `tcp://HOST:PORT` (or `tls://`), a scheduler's file (`FILE.json`), `local:N` for N
            processes here, or `slurm:N`, `pbs:N`, `lsf:N`, `sge:N`, `oar:N`, `htcondor:N`,
            `kubernetes:N` for N jobs as Dask's own configuration describes them.

    Raises:
        GsbaError: no such scheduler, or a package that is not installed.
    """
    try:
        from distributed import Client
    except ImportError:
        raise GsbaError("--cluster needs Dask: pip install 'gsba[cluster]'") from None
    kind, _, count = address.partition(":")
    if kind == "local" or kind in _QUEUES:
        most = _MOST_LOCAL if kind == "local" else _MOST_QUEUED
        if not count.isdecimal() or len(count) > 9 or not 0 < int(count) <= most:
            raise GsbaError(
                f"--cluster {address}: say how many workers, 1 to {most}, as in {kind}:8"
            )
        return Client(_local(int(count)) if kind == "local" else _queued(kind, int(count)))
    try:
        return Client(_scheduler_address(address), timeout=_ANSWER_S)
    except Exception as error:  # of sockets, certificates and plugins, each in its own words
        reason = brief(" ".join(str(error).split()) or type(error).__name__, 200)
        raise GsbaError(
            f"--cluster {address}: no scheduler answers there ({reason}); pass tcp://HOST:PORT, "
            "its FILE.json, local:N or slurm:N"
        ) from error


def _scheduler_address(address: str) -> str:
    """Where a scheduler listens: as given, or as its file says.

    Raises:
        OSError, ValueError: there is no such file, or neither holds an address.
    """
    found: Any = address
    if address.endswith(".json"):
        found = json.loads(Path(address).read_text(encoding="utf-8"))
        found = found.get("address") if isinstance(found, dict) else None
    if not isinstance(found, str) or not _ADDRESS.fullmatch(found):
        raise ValueError("no address of the form tcp://HOST:PORT")
    return found


def _local(num: int) -> Any:
    from dask import config
    from distributed import LocalCluster

    threads = max(1, (os.cpu_count() or 1) // num)
    # Compiled code may keep a process from answering for a while.
    with config.set({"distributed.scheduler.worker-ttl": "30 minutes"}):
        return LocalCluster(
            n_workers=num,
            threads_per_worker=threads,
            memory_limit=0,
            dashboard_address=":0",
            silence_logs=logging.ERROR,
        )


def _queued(kind: str, num: int) -> Any:
    module, name = _QUEUES[kind]
    package = module.partition(".")[0].replace("_", "-")
    try:
        make = getattr(importlib.import_module(module), name)
    except ImportError:
        raise GsbaError(f"--cluster {kind}:{num} needs {package}: pip install {package}") from None
    try:
        cluster = make()
        cluster.scale(num)
    except Exception as error:  # whatever a site's configuration lacks
        raise GsbaError(f"--cluster {kind}:{num}: {error}") from error
    return cluster


@dataclass(slots=True)
class _Shard:
    """A part of a job on its way."""

    path: Path
    digest: str  # SHA-256 of its content
    items: str  # what it holds, for people
    futures: list["Future"]  # one, or twins of one that is late; none once it is finished


class Cluster:
    """Workers of a Dask scheduler that see the run's folder and its frames.

    Args:
        client: of the scheduler.
        folder: of shards, in the run's folder.
        frames: of the run.

    Raises:
        GsbaError: workers that do not see these, or have another version of gsba.
    """

    def __init__(self, client: "Client", folder: Path, frames: Path) -> None:
        self._client: Any = client  # its methods are typed as coroutines
        self._folder = folder.absolute()
        self._cpu_seconds = 0.0
        self._done: dict[str, int] = {}
        _leave_task()
        _prepare(client)
        self._check(frames)

    def map_shards(self, job: Job[R]) -> Iterator[R]:
        """See `gsba.store.shards.Workers`."""
        return track(self._results(job), job.title, len(job))

    def spent(self) -> Spent:
        """See `gsba.store.shards.Workers`."""
        return Spent(self._cpu_seconds, dict(self._done))

    def at_most(self, num: int) -> "Cluster":
        """Nothing is done in this process."""
        return self

    def must_see(self, paths: Sequence[Path]) -> None:
        """See `gsba.store.shards.Workers`; versions are compared as well."""

        def ask(paths: list[str]) -> tuple[str, list[str]]:  # as text: gsba may be another there
            import os

            try:
                from gsba.version import __version__ as version
            except ImportError:
                version = ""
            return version, [path for path in paths if not os.path.exists(path)]

        answers = self._client.run(ask, [str(path.absolute()) for path in paths])
        for worker, (version, unseen) in answers.items():
            if version != __version__:
                has = f"gsba {version}" if version else "no gsba"
                raise GsbaError(
                    f"worker {worker} has {has}, this machine {__version__}: install the same"
                )
            if unseen:
                raise GsbaError(
                    f"worker {worker} does not see {Path(unseen[0])}: put it on a disk that all "
                    "workers share, under the same path"
                )

    def _results(self, job: Job[R]) -> Iterator[R]:
        """Results of all items in order, a window of shards at work ahead of them."""
        blocks = list(job.blocks())
        window = max(2, _AHEAD * sum(self._client.nthreads().values()))
        asked: dict[int, _Shard] = {}
        lasted: list[float] = []
        try:
            for n in range(len(blocks)):
                for ahead in range(n, min(n + window, len(blocks))):
                    if ahead not in asked:
                        asked[ahead] = self._ask(job, *blocks[ahead])
                yield from self._wait(asked[n], job.returns, lasted)
                del asked[n]
        finally:
            left = [future for shard in asked.values() for future in shard.futures]
            with suppress(Exception):  # the scheduler may be what is lost
                self._client.cancel(left, force=True)

    def _ask(self, job: Job[Any], start: int, stop: int) -> _Shard:
        """A shard, asked for unless it is finished."""
        part = job.part(start, stop)
        path, digest = shards.write_shard(part, self._folder)
        shard = _Shard(path, digest, f"{job.title}, {start} to {stop - 1}", [])
        if shards.load_shard(path, part.returns) is None:
            shard.futures.append(self._submit(shard, None))
        return shard

    def _submit(self, shard: _Shard, workers: list[str] | None) -> "Future":
        path, name = shard.path, f"gsba-{shard.path.stem}-{time.monotonic_ns()}"
        return self._client.submit(
            shards.run_shard, str(path), shard.digest, key=name, workers=workers, pure=False
        )

    def _wait(self, shard: _Shard, returns: Any, lasted: list[float]) -> tuple[Any, ...]:
        """Results of a shard's items, whatever becomes of its workers.

        Args:
            lasted: seconds that shards took so far; this one's is added.
        """
        from distributed import wait

        began, died = time.monotonic(), 0
        while shard.futures:
            with suppress(TimeoutError):
                wait(shard.futures, timeout=_LOOK_S, return_when="FIRST_COMPLETED")
            for future in [future for future in shard.futures if future.done()]:
                shard.futures.remove(future)
                manifest = self._outcome(future, shard)
                if manifest is not None:
                    self._client.cancel(shard.futures, force=True)
                    shard.futures.clear()
                    self._cpu_seconds += manifest.cpu_seconds
                    self._done[manifest.worker] = self._done.get(manifest.worker, 0) + 1
                    lasted.append(manifest.seconds)
                    break
                died += 1
                if died == _ATTEMPTS:
                    raise StoppedError(
                        f"every worker dies on {shard.items}: look for what ends it in its log; "
                        "too little memory is the usual cause"
                    )
                logger.warning("a worker died on %s: again", shard.items)
                shard.futures.append(self._submit(shard, None))
            self._help_if_late(shard, time.monotonic() - began, lasted)
        return self._load(shard, returns)

    def _outcome(self, future: "Future", shard: _Shard) -> Manifest | None:
        """What a worker says of a shard; None = it died.

        Raises:
            Exception: what went wrong on the worker, or with the scheduler.
        """
        from distributed import KilledWorker

        if future.status == "finished":
            return future.result()
        error: Any = future.exception() if future.status == "error" else None
        if isinstance(error, KilledWorker):
            return None
        if error is not None:
            raise error
        raise StoppedError(
            f"lost the scheduler during {shard.items}: run again; what is finished is kept"
        )

    def _help_if_late(self, shard: _Shard, seconds: float, lasted: list[float]) -> None:
        """Give a shard that takes far longer than others to another worker as well."""
        usual = statistics.median(lasted) if lasted else 0.0
        if len(shard.futures) != 1 or seconds < max(_LEAST_LATE_S, _LATE * usual):
            return
        if not self._client.nthreads():
            logger.warning("no workers are left: waiting for new ones")
            return
        has = {worker for worker, keys in self._client.processing().items()
               if shard.futures[0].key in keys}  # fmt: skip
        others = [worker for worker in self._client.nthreads() if worker not in has]
        if has and others:
            logger.warning("%s is late: given to another worker as well", shard.items)
            shard.futures.append(self._submit(shard, others))

    def _load(self, shard: _Shard, returns: Any) -> tuple[Any, ...]:
        """What a worker has stored, as soon as this machine sees it."""
        end = time.monotonic() + _SIGHT_S
        while True:
            found = shards.load_shard(shard.path, returns)
            if found is not None:
                return found
            if time.monotonic() > end:
                raise GsbaError(
                    f"{shards.result_path(shard.path)} is not here though a worker wrote it: put "
                    "the run on a disk that workers share with this machine"
                )
            time.sleep(0.2)

    def _check(self, frames: Path) -> None:
        """Refuse workers that could not work, before any does."""
        if not self._client.nthreads():
            logger.info("waiting for workers")
            self._client.wait_for_workers(1)
        token = self._folder / "seen"
        write_text(token, __version__)
        self.must_see([token, frames])
        token.unlink(missing_ok=True)


def _leave_task() -> None:
    """Give up the slot of the worker that this is called in, if any: shards may need it."""
    from distributed import get_worker, secede

    try:
        get_worker()
    except ValueError:  # an ordinary process
        return
    secede()


def _prepare(client: "Client") -> None:
    """Make workers, and those that join later, do as a run needs."""
    from distributed import WorkerPlugin

    class Settings(WorkerPlugin):
        """No pauses for memory that belongs to compiled code; no threads within threads."""

        name = "gsba"

        def setup(self, worker: Any) -> None:
            import cv2
            from threadpoolctl import threadpool_limits

            memory = worker.memory_manager
            memory.memory_target_fraction = memory.memory_spill_fraction = False
            memory.memory_pause_fraction = False
            threadpool_limits(limits=1, user_api="blas")
            cv2.setNumThreads(1)

    client.register_plugin(Settings())
