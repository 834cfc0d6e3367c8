"""Workers of a Dask scheduler, for `gsba.store.shards`, and recovery from their failures: results
are files that do not depend on the worker, so that one that dies or is slow costs only time."""

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
_MIN_LATE_S = 60.0  # shortest time after which a shard is late
_MAX_ATTEMPTS = 5  # workers that may die on a shard
_SCHEDULER_TIMEOUT_S = 20.0  # for a scheduler's first answer
_POLL_S = 5.0  # between checks for late shards


def hire(
    client: "Client | None", frames: Path, settings: RefineSettings
) -> Callable[[Path], Workers]:
    """Function that makes a run's workers from the folder of its shards; no client: threads
    here."""

    def make(folder: Path) -> Workers:
        if client is None:
            return shards.Threads(settings.solver.threads())
        return Cluster(client, folder, frames, settings.solver.threads())

    return make


@contextmanager
def hired(client: "Client | None", out: Path, frames: FrameSet) -> Iterator["Cluster | None"]:
    """Workers that write to `out`, which may be missing; within this context their shards' folder
    lies beside it. Without a client there are none."""
    if client is None:
        yield None
        return
    out = out.resolve()
    with disk_errors(out):
        remove_unheld(out.parent.glob(f".{out.name}.shards-*"))  # left by exports that were killed
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
    """Client of the scheduler at an address; closed with the workers it started; None for None."""
    if address is None:
        yield None
        return
    client: Any = connect(address)
    cluster = client.cluster
    try:
        yield client
    finally:
        with suppress(Exception):  # workers or scheduler may have ended before
            client.close()
            if cluster is not None:
                cluster.close(timeout=60.0)  # a worker that restarts may not answer


def connect(address: str) -> "Client":
    """Client of the scheduler at an address; starts workers for addresses with a number.

    Args:
        address: `tcp://HOST:PORT` (or `tls://`), a scheduler's file (`FILE.json`), `local:N` for N
            processes here, or `slurm:N`, `pbs:N`, `lsf:N`, `sge:N`, `oar:N`, `htcondor:N`,
            `kubernetes:N` for N jobs as Dask's own configuration describes them.

    Raises:
        GsbaError: no scheduler answers, or a package is not installed.
    """
    try:
        from distributed import Client
    except ImportError:
        raise GsbaError("--cluster needs Dask: pip install 'gsba[cluster]'") from None
    kind, _, count = address.partition(":")
    if kind == "local" or kind in _QUEUES:
        most = 256 if kind == "local" else 100_000  # workers
        if not count.isdecimal() or len(count) > 9 or not 0 < int(count) <= most:
            raise GsbaError(
                f"--cluster {address}: give the number of workers, 1 to {most}, as in {kind}:8"
            )
        return Client(_local(int(count)) if kind == "local" else _queued(kind, int(count)))
    try:
        found: Any = address
        if address.endswith(".json"):
            found = json.loads(Path(address).read_text(encoding="utf-8"))
            found = found.get("address") if isinstance(found, dict) else None
        if not isinstance(found, str) or not _ADDRESS.fullmatch(found):
            raise ValueError("no address of the form tcp://HOST:PORT")
        return Client(found, timeout=_SCHEDULER_TIMEOUT_S)
    except Exception as error:  # sockets, certificates and plugins raise errors of their own types
        reason = brief(" ".join(str(error).split()) or type(error).__name__, 200)
        raise GsbaError(
            f"--cluster {address}: no scheduler answers there ({reason}); pass tcp://HOST:PORT, "
            "its FILE.json, local:N or slurm:N"
        ) from error


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
    except Exception as error:  # a site's configuration may be incomplete in many ways
        raise GsbaError(f"--cluster {kind}:{num}: {error}") from error
    return cluster


@dataclass(slots=True)
class _Shard:
    """Part of a job that was submitted."""

    path: Path
    digest: str  # SHA-256 of its content
    items: str  # title and range of its items, for messages
    futures: list["Future"]  # one; two if the first is late; none once the shard is finished


class Cluster:
    """Workers of a Dask scheduler that see the run's folder and its frames.

    Args:
        num_threads: of this process, for what is not shared out.

    Raises:
        GsbaError: a worker does not see these, or has another version of gsba.
    """

    def __init__(self, client: "Client", folder: Path, frames: Path, num_threads: int = 1) -> None:
        self.num_threads = num_threads
        self._client: Any = client  # its methods are typed as coroutines
        self._folder = folder.absolute()
        self._cpu_seconds = 0.0
        self._done: dict[str, int] = {}
        from distributed import WorkerPlugin, get_worker, secede

        with suppress(ValueError):  # an ordinary process
            get_worker()
            secede()  # leave the pool of the worker that calls this: shards may need its slot

        class Settings(WorkerPlugin):
            """Turns off memory limits, which compiled code exceeds, and threads within threads, on
            workers that join later, too."""

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
        self._check(frames)

    def map_shards(self, job: Job[R]) -> Iterator[R]:
        """See `gsba.store.shards.Workers`."""
        return track(self._results(job), job.title, len(job))

    def spent(self) -> Spent:
        """See `gsba.store.shards.Workers`."""
        return Spent(self._cpu_seconds, dict(self._done))

    def at_most(self, num: int) -> "Cluster":
        """These workers: the limit is for this process, which does none of the work."""
        return self

    def must_see(self, paths: Sequence[Path]) -> None:
        """See `gsba.store.shards.Workers`; also compares versions of gsba."""

        def ask(paths: list[str]) -> tuple[str, list[str]]:  # strings: types may differ there
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
        """Results of all items in order; a window of shards is submitted ahead of them."""
        blocks = list(job.blocks())
        window = max(2, 3 * sum(self._client.nthreads().values()))
        submitted: dict[int, _Shard] = {}
        lasted: list[float] = []
        try:
            for n in range(len(blocks)):
                for ahead in range(n, min(n + window, len(blocks))):
                    if ahead not in submitted:
                        submitted[ahead] = self._submitted(job, *blocks[ahead])
                yield from self._wait(submitted[n], job.returns, lasted)
                del submitted[n]
        finally:
            left = [future for shard in submitted.values() for future in shard.futures]
            with suppress(Exception):  # the scheduler may be lost
                self._client.cancel(left, force=True)

    def _submitted(self, job: Job[Any], start: int, stop: int) -> _Shard:
        """Shard of items `start` to `stop`, submitted unless its result is stored."""
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
        """Results of a shard's items; replaces workers that die or are late."""
        from distributed import wait

        began, died = time.monotonic(), 0
        while shard.futures:
            with suppress(TimeoutError):
                wait(shard.futures, timeout=_POLL_S, return_when="FIRST_COMPLETED")
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
                if died == _MAX_ATTEMPTS:
                    raise StoppedError(
                        f"{died} workers died on {shard.items}: look for the cause in their logs; "
                        "too little memory is the usual one"
                    )
                logger.warning("a worker died on %s: another one repeats it", shard.items)
                shard.futures.append(self._submit(shard, None))
            self._help_if_late(shard, time.monotonic() - began, lasted)
        return self._load(shard, returns)

    def _outcome(self, future: "Future", shard: _Shard) -> Manifest | None:
        """Manifest of a shard from its worker; None = the worker died."""
        from distributed import KilledWorker

        if future.status == "finished":
            return future.result()
        error: Any = future.exception() if future.status == "error" else None
        if isinstance(error, KilledWorker):
            return None
        if error is not None:
            raise error
        raise StoppedError(
            f"lost the scheduler during {shard.items}: run again; finished work is kept"
        )

    def _help_if_late(self, shard: _Shard, seconds: float, lasted: list[float]) -> None:
        """Submit a shard that takes far longer than others to a second worker as well."""
        usual = statistics.median(lasted) if lasted else 0.0
        if len(shard.futures) != 1 or seconds < max(_MIN_LATE_S, 4.0 * usual):
            return
        if not self._client.nthreads():
            logger.warning("the scheduler has no workers left: waiting for new ones")
            return
        has = {worker for worker, keys in self._client.processing().items()
               if shard.futures[0].key in keys}  # fmt: skip
        others = [worker for worker in self._client.nthreads() if worker not in has]
        if has and others:
            logger.warning("%s is late: another worker computes it as well", shard.items)
            shard.futures.append(self._submit(shard, others))

    def _load(self, shard: _Shard, returns: Any) -> tuple[Any, ...]:
        end = time.monotonic() + 30.0  # a shared disk shows late what another machine has written
        while True:
            found = shards.load_shard(shard.path, returns)
            if found is not None:
                return found
            if time.monotonic() > end:
                raise GsbaError(
                    f"a worker wrote {shards.result_path(shard.path)}, but this machine does not "
                    "see it: put the run on a disk that workers share with this machine"
                )
            time.sleep(0.2)

    def _check(self, frames: Path) -> None:
        """Refuse workers that do not see the run's folder or frames, before they start."""
        if not self._client.nthreads():
            logger.info("waiting for workers")
            self._client.wait_for_workers(1)
        token = self._folder / "seen"
        write_text(token, __version__)
        self.must_see([token, frames])
        token.unlink(missing_ok=True)
