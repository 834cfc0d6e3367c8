"""Jobs of the page: the queue, stopping and going on, and what a later server finds of them."""

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from waiting import until

from gsba.app import worker
from gsba.app.jobs import AppJob, Command, Jobs, alive, alive_lock, ending
from gsba.app.progress import Progress, read_events
from gsba.app.worker import work
from gsba.log import EVENTS, GsbaError, track

# In place of gsba: appends to `seen` when it starts, then does what its first argument says.
SCRIPT = """
import json, os, sys, time
def tell(**entry):
    open(os.environ["GSBA_EVENTS"], "a").write(json.dumps(entry) + "\\n")
open("seen", "a").write(" ".join(sys.argv[1:]) + "\\n")
try:
    if sys.argv[1] == "wait":
        tell(event="stage", name="s", title="wait")
        for _ in range(6000):
            time.sleep(0.1)
    code = int(sys.argv[2]) if sys.argv[1] == "exit" else 0
except KeyboardInterrupt:
    code = 130
tell(event="end", code=code)
sys.exit(code)
"""


@pytest.fixture
def jobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Jobs]:
    monkeypatch.setattr(worker, "GSBA", (sys.executable, "-c", SCRIPT))
    # As the worker's own process does: tests may run in the background, where SIGINT is ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield Jobs(tmp_path / "state")
    signal.signal(signal.SIGINT, before)


def added(jobs: Jobs, *arguments: str) -> AppJob:
    return jobs.add(Command(arguments, str(jobs.root.parent), None))


def at_work(jobs: Jobs) -> threading.Thread:
    thread = threading.Thread(target=work, args=(jobs,), daemon=True)
    thread.start()
    return thread


def status(jobs: Jobs, job: AppJob) -> str:
    return jobs.get(job.id).state.status


def has_begun(jobs: Jobs, job: AppJob) -> bool:
    progress = Progress()
    for event in read_events(job.events)[0]:
        progress.add(event)
    return progress.stage is not None


def begun(jobs: Jobs, job: AppJob) -> threading.Thread:
    """The worker's thread, once the job is in its first stage."""
    thread = at_work(jobs)
    until(lambda: has_begun(jobs, job), 120)
    return thread


def test_jobs_run_one_after_another_in_order(jobs: Jobs) -> None:
    codes = {"0": "done", "3": "partial", "1": "failed", "130": "stopped"}
    ids = [added(jobs, "exit", code) for code in codes]
    work(jobs)
    assert [status(jobs, job) for job in ids] == list(codes.values())
    seen = (jobs.root.parent / "seen").read_text().splitlines()
    assert seen == [f"exit {code}" for code in codes]
    spans = [(j.state.began or 0, j.state.ended or 0) for j in jobs.all()]
    assert all(end <= begin for (_, end), (begin, _) in pairwise(spans))


def test_a_job_is_stopped_and_goes_on_without_fresh(jobs: Jobs) -> None:
    job = added(jobs, "wait", "--fresh")
    thread = begun(jobs, job)
    assert jobs.stop(job.id).state.status == "stopping"
    thread.join(120)
    assert status(jobs, job) == "stopped" and jobs.get(job.id).state.code == 130
    jobs.go_on(job.id)
    assert jobs.get(job.id).arguments() == ["wait"]
    thread = at_work(jobs)
    until(lambda: status(jobs, job) == "running" and has_begun(jobs, job), 120)
    jobs.stop(job.id)
    thread.join(120)
    assert (jobs.root.parent / "seen").read_text().splitlines() == ["wait --fresh", "wait"]


def test_stopping_again_kills(jobs: Jobs) -> None:
    job = added(jobs, "wait")
    thread = begun(jobs, job)
    os.kill(jobs.get(job.id).state.pid or 0, signal.SIGSTOP)  # it does not hear SIGINT
    jobs.stop(job.id)
    assert status(jobs, job) == "stopping"
    jobs.stop(job.id)
    thread.join(120)
    assert status(jobs, job) == "stopped" and jobs.get(job.id).state.forced


def test_a_waiting_job_is_taken_out(jobs: Jobs) -> None:
    job = added(jobs, "exit", "0")
    jobs.stop(job.id)
    work(jobs)
    assert status(jobs, job) == "stopped" and not (jobs.root.parent / "seen").exists()


def test_only_what_has_ended_goes_on_or_is_forgotten(jobs: Jobs) -> None:
    job = added(jobs, "exit", "0")
    for refused in (jobs.go_on, jobs.remove):
        with pytest.raises(GsbaError, match="waiting"):
            refused(job.id)
    work(jobs)
    with pytest.raises(GsbaError, match="cannot go on: it is done"):
        jobs.go_on(job.id)
    jobs.remove(job.id)
    assert not jobs.all()
    for name in ("", "..", "../jobs", "nothing"):
        with pytest.raises(GsbaError, match="there is no job"):
            jobs.get(name)


def test_a_job_outlives_its_worker_and_the_next_one_sees_it_out(jobs: Jobs) -> None:
    job = added(jobs, "wait")
    with jobs.locked():  # as a worker that is killed right after it started the job
        job, process = worker._start(jobs, job)
    until(lambda: has_begun(jobs, job), 120)
    after = added(jobs, "exit", "0")
    thread = at_work(jobs)
    time.sleep(0.5)
    assert alive(jobs.get(job.id)) and status(jobs, after) == "waiting"
    jobs.stop(job.id)
    process.wait(120)
    thread.join(120)
    assert (status(jobs, job), status(jobs, after)) == ("stopped", "done")


def test_another_process_with_the_pid_of_a_job_is_not_the_job(jobs: Jobs) -> None:
    job = added(jobs, "wait")
    with jobs.locked():
        job, process = worker._start(jobs, job)
    until(lambda: has_begun(jobs, job), 120)
    assert alive(job)
    process.kill()
    process.wait(120)
    assert not alive(job)
    with jobs.locked():
        job = jobs.change(job, pid=os.getpid())
    assert not alive(job)
    jobs.stop(job.id)  # this process gets no signal
    assert status(jobs, job) == "running"
    work(jobs)
    assert status(jobs, job) == "lost"


def test_the_lock_of_an_earlier_start_does_not_hold_up_the_next(jobs: Jobs) -> None:
    """A process that a killed job left behind."""
    job = added(jobs, "wait")
    with alive_lock(job) as left_behind:
        assert alive(job)
        thread = begun(jobs, job)
        jobs.stop(job.id)
        thread.join(120)
        assert status(jobs, job) == "stopped" and not alive(jobs.get(job.id))
        assert left_behind > 0


def test_a_job_that_was_killed_is_lost(jobs: Jobs) -> None:
    job = added(jobs, "wait")
    thread = begun(jobs, job)
    os.kill(jobs.get(job.id).state.pid or 0, signal.SIGKILL)
    thread.join(120)
    assert status(jobs, job) == "lost"
    assert ending(-9, jobs.get(job.id).state) == "lost"


def test_there_is_one_worker(jobs: Jobs) -> None:
    job = added(jobs, "wait")
    thread = begun(jobs, job)
    work(jobs)  # returns at once
    assert status(jobs, job) == "running"
    jobs.stop(job.id)
    thread.join(120)


def test_damaged_jobs_are_left_out(jobs: Jobs) -> None:
    job = added(jobs, "exit", "0")
    (job.path / "job.json").write_text("{")
    assert not jobs.all()


def test_events_are_read_by_whole_lines(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    assert read_events(path) == ([], 0)
    path.write_bytes(b'{"event": "a"}\nno json\n[1]\n{"event"')
    found, offset = read_events(path)
    assert found == [{"event": "a"}]
    with path.open("ab") as file:
        file.write(b': "b"}\n')
    assert read_events(path, offset)[0] == [{"event": "b"}]


def test_progress_of_a_run() -> None:
    progress = Progress()
    for entry in (
        {"event": "start"},
        {"event": "stage", "name": "odometry", "title": "track the video"},
        {"event": "keyframe", "map": 0, "position": [1, 2, 3], "points": [[0, 0, 1]]},
        {"event": "keyframe", "map": 0, "position": [1, 2, float("nan")], "points": []},
        {"event": "progress", "what": "tracking", "done": 20, "total": 60, "rate": 4.0, "note": ""},
        {"event": "log", "level": "WARNING", "text": "dark"},
        {"event": "log", "level": "WARNING", "text": "dark"},
    ):
        progress.add(entry)
    assert progress.table()["left"] == ""
    assert progress.warnings == ["dark"] and len(progress.keyframes) == 1
    assert progress.stage is not None and progress.stage["title"] == "track the video"
    progress.add({"event": "done", "name": "odometry", "title": "track the video"})
    assert progress.names() == ["odometry"] and progress.work is None
    progress.add({"event": "start"})  # the job goes on: its stages are told again
    assert not progress.stages and not progress.warnings
    json.dumps(progress.table())


def test_work_tells_how_far_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(EVENTS, str(tmp_path / "events.jsonl"))
    assert list(track(iter("abc"), "spelling", total=5, done=2, note=lambda: "far")) == list("abc")
    told, _ = read_events(tmp_path / "events.jsonl")
    assert [(entry["what"], entry["done"], entry["total"]) for entry in told] == [
        ("spelling", 2, 5),
        ("spelling", 5, 5),
    ]
    assert told[-1]["rate"] > 0 and told[-1]["note"] == "far"
    monkeypatch.setenv(EVENTS, str(tmp_path / "nowhere/events.jsonl"))  # it ends no run
    assert list(track("abc", "spelling")) == list("abc")


def test_the_command_line_writes_events(tmp_path: Path) -> None:
    import subprocess

    events = tmp_path / "events.jsonl"
    line = [sys.executable, "-c", "from gsba.cli import main; main()", "refine", "nothing.mp4", "t"]
    environment = {**os.environ, EVENTS: str(events)}
    done = subprocess.run(line, cwd=tmp_path, env=environment, capture_output=True, text=True)
    found, _ = read_events(events)
    assert done.returncode == 1 and [entry["event"] for entry in found][-2:] == ["error", "end"]
    assert found[-1]["code"] == 1 and found[-2]["text"] in done.stderr
