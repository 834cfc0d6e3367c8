"""The process that runs queued jobs one after another (`python -m gsba.app.worker STATE`), in a
session of its own that outlives page, server and terminal; it ends when no job waits."""

import fcntl
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from gsba.app.jobs import ACTIVE, AppJob, Jobs, alive, alive_lock, ending, last_code
from gsba.app.progress import read_events
from gsba.log import EVENTS

GSBA = (sys.executable, "-P", "-c", "from gsba.cli import main; main()")
_POLL_S = 0.3  # between two looks at a process that another worker started


def ensure_worker(jobs: Jobs) -> None:
    """Start a worker if jobs wait or run; one that finds another at work ends at once."""
    if any(job.state.status in ("waiting", *ACTIVE) for job in jobs.all()):
        with (jobs.root / "worker.txt").open("ab") as output:
            subprocess.Popen(
                [sys.executable, "-P", "-m", "gsba.app.worker", str(jobs.root)],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
            )


def work(jobs: Jobs) -> None:
    """Run waiting jobs until none is left."""
    with jobs.as_worker() as lock:
        if lock is None:
            return
        for job in jobs.all():
            if job.state.status in ACTIVE:
                _see_out(jobs, job)
        while True:
            with jobs.locked():
                waiting = [job for job in jobs.all() if job.state.status == "waiting"]
                if not waiting:
                    fcntl.flock(lock, fcntl.LOCK_UN)  # before a job can be added
                    return
                job, process = _start(jobs, waiting[0])
            code = process.wait()
            with jobs.locked():
                job = jobs.get(job.id)
                jobs.change(job, status=ending(code, job.state), code=code, ended=time.time())


def _start(jobs: Jobs, job: AppJob) -> tuple[AppJob, subprocess.Popen[bytes]]:
    """Start a job in a process group of its own."""
    began = time.time()
    with job.events.open("a") as events:
        events.write(f'{{"event": "start", "time": {began:.3f}}}\n')
    with job.log.open("ab") as log, alive_lock(job) as lock:
        process = subprocess.Popen(
            [*GSBA, *job.arguments()],
            cwd=job.command.folder,
            env={**os.environ, EVENTS: str(job.events)},
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
            pass_fds=(lock,),
        )
    known = {"pid": process.pid, "starts": job.state.starts + 1}
    times = {"began": began, "ended": None, "code": None}
    return jobs.change(job, status="running", **known, **times), process


def _see_out(jobs: Jobs, job: AppJob) -> None:
    """Wait for the end of a job that a worker started which is no more."""
    while alive(job):
        time.sleep(_POLL_S)
    with jobs.locked():
        job, code = jobs.get(job.id), last_code(read_events(job.events)[0])
        stopped = "stopped" if job.state.status == "stopping" else "lost"
        status = stopped if code is None else ending(code, job.state)
        jobs.change(job, status=status, code=code, ended=time.time())


def main() -> None:
    """Entry point of the worker's process."""
    # Where SIGINT is ignored, as behind `gsba app &` in a script, jobs could not be stopped.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with suppress(KeyboardInterrupt):
        work(Jobs(Path(sys.argv[1])))


if __name__ == "__main__":
    main()
