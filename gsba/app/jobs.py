"""Jobs on disk: commands of gsba that wait, run or have ended.

A job is a folder: `job.json`, written once, is its command; `state.json` is replaced as a whole
under a lock; `log.txt` is its output, `events.jsonl` its events; `alive.lock` is held while it
runs.
"""

import fcntl
import json
import os
import secrets
import shutil
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from gsba.disk import write_json
from gsba.log import GsbaError
from gsba.store.records import RecordError, typed

Status = Literal["waiting", "running", "stopping", "stopped", "done", "partial", "failed", "lost"]

ACTIVE: tuple[Status, ...] = ("running", "stopping")
PARTIAL_CODE, STOPPED_CODE = 3, 130  # exit codes, see docs/run-folder.md
FRESH = "--fresh"  # would delete what a job has done so far when the job goes on


@dataclass(frozen=True, slots=True)
class Command:
    """A command line of gsba that a job runs."""

    arguments: tuple[str, ...]  # of gsba, the command's name first
    folder: str  # absolute working folder
    run: str | None  # run folder it writes or reads, or folder of figures that it writes, relative
    # to the working folder; None = none


@dataclass(frozen=True, slots=True)
class JobState:
    """Status of a job, and its process."""

    status: Status
    pid: int | None = None  # of its process, which leads a process group
    code: int | None = None  # exit code; None = not ended, or not known
    began: float | None = None  # seconds since 1970, of the latest start
    ended: float | None = None
    starts: int = 0  # number of times it was started
    forced: bool = False  # True = it was killed, as it did not stop when it was asked to


@dataclass(frozen=True, slots=True)
class AppJob:
    """A job and its state when it was read."""

    id: str  # sorts by time of creation
    path: Path  # its folder
    command: Command
    state: JobState

    @property
    def log(self) -> Path:
        """Output of the command."""
        return self.path / "log.txt"

    @property
    def events(self) -> Path:
        """Events of the command, one JSON object a line."""
        return self.path / "events.jsonl"

    @property
    def alive_lock(self) -> Path:
        """File that is locked while a process of the job runs."""
        return self.path / "alive.lock"

    def arguments(self) -> list[str]:
        """Arguments of the next start: a job that goes on keeps what it has done."""
        first = self.state.starts == 0
        return [text for text in self.command.arguments if first or text != FRESH]


class Jobs:
    """All jobs of a state folder, in order of their creation; root: folder of the state, made if
    missing, readable by its owner alone."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._folder = root / "jobs"
        self._folder.mkdir(parents=True, exist_ok=True)
        root.chmod(0o700)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the lock of all states; other processes wait."""
        with self._lock_file("states.lock") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield

    @contextmanager
    def as_worker(self) -> Iterator[int | None]:
        """Become the worker of these jobs; yields the lock, None if another process is it."""
        with self._lock_file("worker.lock") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                yield None
            else:
                yield file

    def add(self, command: Command) -> AppJob:
        """Queue a command."""
        name = f"{time.strftime('%Y%m%d-%H%M%S')}-{time.time_ns() % 10**9:09d}"
        path = self._folder / f"{name}-{secrets.token_hex(2)}"
        with self.locked():
            path.mkdir()
            write_json(path / "state.json", asdict(JobState("waiting")))
            write_json(path / "job.json", asdict(command))
        return self.get(path.name)

    def all(self) -> list[AppJob]:
        """All jobs that can be read, the oldest first."""
        found = []
        for path in sorted(self._folder.iterdir()):
            with suppress(GsbaError):
                found.append(self.get(path.name))
        return found

    def get(self, name: str) -> AppJob:
        """A job by its id. Raises GsbaError: there is none, or its files were edited."""
        path = self._folder / name
        if not name or "/" in name or name.startswith(".") or not path.is_dir():
            raise GsbaError(f"there is no job {name}")
        try:
            command = typed(json.loads((path / "job.json").read_text()), Command)
            state = typed(json.loads((path / "state.json").read_text()), JobState)
        except (OSError, ValueError, RecordError) as error:
            raise GsbaError(f"job {name} cannot be read: remove {path}") from error
        return AppJob(name, path, command, state)

    def change(self, job: AppJob, **values: Any) -> AppJob:
        """Store a new state of a job; the caller holds the lock."""
        state = replace(job.state, **values)
        write_json(job.path / "state.json", asdict(state))
        return replace(job, state=state)

    def stop(self, name: str) -> AppJob:
        """Take a job out of the queue, or interrupt it as Ctrl-C does; asked again, kill it."""
        with self.locked():
            job = self.get(name)
            if job.state.status == "waiting":
                return self.change(job, status="stopped")
            if job.state.status not in ACTIVE or not alive(job):
                return job
            again = job.state.status == "stopping"
            with suppress(ProcessLookupError):
                os.killpg(job.state.pid or 0, signal.SIGKILL if again else signal.SIGINT)
            return self.change(job, status="stopping", forced=again)

    def go_on(self, name: str) -> AppJob:
        """Queue a job again that was stopped or has failed: gsba resumes what is done. Raises
        GsbaError: the job waits, runs or is done."""
        with self.locked():
            job = self.get(name)
            if job.state.status in ("waiting", "done", "partial", *ACTIVE):
                raise GsbaError(f"job {name} cannot go on: it is {job.state.status}")
            return self.change(job, status="waiting", forced=False)

    def remove(self, name: str) -> None:
        """Forget a job that neither waits nor runs; what it wrote elsewhere stays. Raises
        GsbaError: the job waits or runs."""
        with self.locked():
            job = self.get(name)
            if job.state.status in ("waiting", *ACTIVE):
                raise GsbaError(f"job {name} is {job.state.status}: stop it first")
            shutil.rmtree(job.path, ignore_errors=True)

    @contextmanager
    def _lock_file(self, name: str) -> Iterator[int]:
        file = os.open(self.root / name, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            yield file
        finally:
            os.close(file)


def alive(job: AppJob) -> bool:
    """True if a process of a job runs: the system drops the lock when the last one has ended."""
    try:
        with job.alive_lock.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except FileNotFoundError:  # it was never started
        return False
    return False


@contextmanager
def alive_lock(job: AppJob) -> Iterator[int]:
    """A new lock of a job, for its process to inherit; an earlier one is no longer looked at."""
    job.alive_lock.unlink(missing_ok=True)
    file = os.open(job.alive_lock, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield file
    finally:
        os.close(file)  # what inherited it holds the lock


def ending(code: int, state: JobState) -> Status:
    """Status of a job whose process ended with an exit code, negative of a signal."""
    if code == 0:
        return "done"
    if code == PARTIAL_CODE:
        return "partial"
    asked = state.status == "stopping"
    return "stopped" if code == STOPPED_CODE or asked else "failed" if code > 0 else "lost"


def last_code(events: Sequence[dict[str, Any]]) -> int | None:
    """Exit code that the latest start of a job told of; None = it has not ended by itself."""
    for entry in reversed(events):
        if entry.get("event") == "start":
            return None
        if entry.get("event") == "end":
            return entry.get("code")
    return None
