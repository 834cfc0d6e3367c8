"""A synthetic city solved in parts, beside the same solver undivided.

    python -m benchmarks.large solve 100000 --out WORK [--part 1000] [--workers 2] [--kill 20]
    python -m benchmarks.large whole 20000 --out WORK
    python -m benchmarks.large asleep 2000 --out WORK [--part 1000] [--tasks 140] [--slots 64]
    python -m benchmarks.large compare WORK OTHER
    python -m benchmarks.large again RUN --frames 5000 --out WORK [--part 1000] [--workers 2]

`solve` streams the city to WORK/map and solves it there; called again, it goes on where it was
stopped. `whole` holds all of it and solves it by one factorization. Both print a line for each
attempt, and write WORK/poses.npy and WORK/figures.json. `--kill` kills a worker every so many
seconds. `asleep` measures a part's CPU seconds in each pass of an attempt, and lets as many tasks
as a larger city has parts sleep so long on slots of a Dask scheduler. `compare` prints how far
costs and poses differ. `again` adjusts the matches of neighbours that a run in RUN has stored, and
finds covariances: of as many frames as asked for, by the run's frames side by side again and again.
"""

import argparse
import json
import os
import random
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from benchmarks.city import City, make_city
from factors import BearingTerm, LandmarkBlock, RobustLoss
from factors.direct_system import DirectSystem
from factors.system_layout import SystemLayout
from gsba.bundle import adjustment, tracks
from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.bearings import Bearings
from gsba.bundle.families import Families
from gsba.bundle.optimizer import OptimizeResult, minimize
from gsba.bundle.trajectory_prior import TrajectoryPrior
from gsba.config import RefineSettings, SolverSettings
from gsba.disk import concatenated
from gsba.frames import cubemap
from gsba.geometry import inverse
from gsba.memory import give_back_freed_memory, release_mapped_files
from gsba.parts import DividedAdjustments
from gsba.parts.divided_system import optimize_divided
from gsba.parts.folder import PartsWriter, values_at
from gsba.store.shards import Job, Spent, Threads, Workers
from gsba.store.store import load_stage
from gsba.types import FrameSet, Keypoints, Matches, Solution

LOSS_SIGMAS = 2.0
COLUMNS = ("pixels", "faces", "bearings_rig", "sigmas_rad", "colors")  # of keypoints


@dataclass
class Counted:
    """Workers, and what they and the caller wrote to each other."""

    workers: Workers
    scratch: Path | None
    traffic: int = 0  # bytes
    largest: int = 0  # bytes on disk below `folder` after a pass
    folder: Path = field(default_factory=Path)

    @property
    def num_threads(self) -> int:
        """See `gsba.store.shards.Workers`."""
        return self.workers.num_threads

    def map_shards(self, job: Job[Any]) -> Iterator[Any]:
        """See `gsba.store.shards.Workers`."""
        yield from self.workers.map_shards(job)
        if self.scratch is not None:
            self.traffic += size(self.scratch)
        self.largest = max(self.largest, size(self.folder))

    def spent(self) -> Spent:
        """See `gsba.store.shards.Workers`."""
        return self.workers.spent()

    def at_most(self, num: int) -> Workers:
        """See `gsba.store.shards.Workers`."""
        return self.workers.at_most(num)

    def must_see(self, paths: Any) -> None:
        """See `gsba.store.shards.Workers`."""
        self.workers.must_see(paths)


def size(folder: Path) -> int:
    """Bytes of all files below a folder."""
    total = 0
    for path in folder.rglob("*"):
        with suppress(FileNotFoundError):
            total += path.stat().st_size
    return total


def peak_mb() -> float:
    """Peak resident memory of this process."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def written(city: City, folder: Path, most: int) -> dict[str, Any]:
    """Stream a city to the folder of its parts, unless it is there; returns figures."""
    cpu = time.process_time()
    writer, observations, points = PartsWriter(folder), 0, 0
    for landmarks, term, fixes in city.chunks():
        writer.add(landmarks, [term], fixes)
        observations += len(term.frames)
        points += len(landmarks)
    num = len(city.start)
    values = values_at(range(num), city.start)
    index = writer.finish(values, num, writer.cut(values, num, most))
    frames, kept = np.diff(index.starts), index.num_kept
    return {
        "points": points,
        "observations": observations,
        "write_cpu_s": time.process_time() - cpu,
        "parts": len(kept),
        "frames_of_largest_part": int((frames - kept).max()),
        "cut_frames_of_largest_part": int(kept.max()),
        "cut_frames": num - int((frames - kept).sum()),
        "map_mb": size(folder) / 1e6,
    }


@contextmanager
def hired(num: int, folder: Path, kill_s: float) -> Iterator[tuple[Workers, Callable[[], float]]]:
    """Workers, and the peak memory of the largest; 0 = this process."""
    if not num:
        yield Threads(1), lambda: 0.0
        return
    from distributed import Client, LocalCluster

    from gsba.store.cluster import Cluster

    with (
        LocalCluster(num, threads_per_worker=1, memory_limit=0, dashboard_address=":0") as cluster,
        Client(cluster) as connected,
    ):
        client: Any = connected  # its methods are typed as coroutines
        ended = threading.Event()
        killer = threading.Thread(target=_killing, args=(client, kill_s, ended), daemon=True)
        if kill_s:
            killer.start()
        yield (
            Cluster(client, folder, folder),
            lambda: max(client.run(peak_mb).values(), default=0.0),
        )
        ended.set()


def _killing(client: Any, every_s: float, ended: threading.Event) -> None:
    """Kill one of the workers again and again."""
    chance = random.Random(0)
    while not ended.wait(every_s):
        with suppress(Exception):  # a worker may be starting
            pid = chance.choice(sorted(client.run(os.getpid).values()))
            os.kill(pid, signal.SIGKILL)
            print(f"killed worker process {pid}", flush=True)


def solve(options: argparse.Namespace) -> tuple[OptimizeResult, dict[str, Any]]:
    """Solve a city in parts."""
    folder, scratch = options.out / "map", options.out / "shards"
    scratch.mkdir(parents=True, exist_ok=True)
    figures: dict[str, Any] = {}
    if not (folder / "index.npz").exists():
        figures |= written(make_city(options.frames), folder, options.part)
        print(json.dumps(figures), flush=True)
        (options.out / "written.json").write_text(json.dumps(figures))
    figures = json.loads((options.out / "written.json").read_text())
    figures["peak_mb_after_writing"] = peak_mb()
    with hired(options.workers, scratch, options.kill) as (workers, peak):
        counted = Counted(workers, scratch if options.workers else None, folder=options.out)
        start = time.process_time(), time.perf_counter()
        result = optimize_divided(
            folder, counted, settings(options), counted.scratch, Progress(options)
        )
        spent = workers.spent()
        figures |= {
            "caller_cpu_s": time.process_time() - start[0],
            "wall_s": time.perf_counter() - start[1],
            "workers_cpu_s": spent.cpu_seconds,
            "worker_peak_mb": peak(),
            "traffic_mb": counted.traffic / 1e6,
            "disk_mb": counted.largest / 1e6,
        }
    return result, figures


def whole(options: argparse.Namespace) -> tuple[OptimizeResult, dict[str, Any]]:
    """Solve a city by one factorization of all frames."""
    graph, chunks = gtsam.NonlinearFactorGraph(), []
    city = make_city(options.frames)
    for landmarks, term, fixes in city.chunks():
        graph.push_back(fixes)
        chunks.append((landmarks, term))
    block = block_of(chunks, options.frames)
    values = values_at(np.arange(options.frames), city.start)
    start = time.process_time(), time.perf_counter()
    system = DirectSystem(SystemLayout(graph, [block], values))
    result = minimize(system, values, settings(options), Progress(options))
    return result, {
        "caller_cpu_s": time.process_time() - start[0],
        "wall_s": time.perf_counter() - start[1],
    }


def block_of(chunks: list[tuple[np.ndarray, BearingTerm]], num_frames: int) -> LandmarkBlock:
    """All observations of a map as one block."""
    firsts = np.cumsum([0, *(len(landmarks) for landmarks, _ in chunks)])
    terms = [term for _, term in chunks]
    term = BearingTerm(
        np.concatenate([term.frames for term in terms]),
        np.concatenate([t.points + first for t, first in zip(terms, firsts, strict=False)]),
        np.concatenate([term.bearings_rig for term in terms]),
        np.concatenate([np.asarray(term.sigmas_rad) for term in terms]),
    )
    points = np.concatenate([landmarks for landmarks, _ in chunks])
    keys = [X(frame) for frame in range(num_frames)]
    return LandmarkBlock(keys, points, [term], RobustLoss("cauchy", LOSS_SIGMAS), num_threads=1)


def settings(options: argparse.Namespace) -> SolverSettings:
    """Those of all runs."""
    return SolverSettings(
        relative_tolerance=options.tolerance, absolute_tolerance=None, loss_sigmas=LOSS_SIGMAS
    )


class Progress:
    """Prints each attempt."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._since = time.process_time()
        self._stop = options.stop_after

    def __call__(self, step: Any, values: gtsam.Values) -> None:
        now = time.process_time()
        print(
            f"attempt {step.number}: cost {step.cost:.12g}, lambda {step.damping:.0e}, "
            f"accepted {step.accepted}, {step.seconds:.1f} s, CPU here {now - self._since:.1f} s, "
            f"peak {peak_mb():.0f} MB",
            flush=True,
        )
        self._since = now
        if self._stop and step.number == self._stop:
            os.kill(os.getpid(), signal.SIGKILL)


@dataclass
class Timed:
    """One thread of this process, and the CPU seconds of a part in each pass."""

    seconds: dict[str, list[float]] = field(default_factory=dict)  # by title of the pass
    num_threads: int = 1

    def map_shards(self, job: Job[Any]) -> Iterator[Any]:
        """See `gsba.store.shards.Workers`."""
        for item in range(len(job)):
            start = time.thread_time()
            result = job(item)
            self.seconds.setdefault(job.title, []).append(time.thread_time() - start)
            yield result

    def spent(self) -> Spent:
        """See `gsba.store.shards.Workers`."""
        return Spent()

    def at_most(self, num: int) -> "Timed":
        """See `gsba.store.shards.Workers`."""
        return self

    def must_see(self, paths: Any) -> None:
        """See `gsba.store.shards.Workers`."""


def asleep(options: argparse.Namespace) -> None:
    """Print how well slots are used by passes of tasks that sleep as long as a part takes."""
    from benchmarks.cluster import asleep as sleeping

    timed = Timed()
    written(make_city(options.frames), options.out / "map", options.part)
    optimize_divided(options.out / "map", timed, settings(options))
    used, spent = 0.0, 0.0
    for title in ("eliminating", "substituting", "moving"):
        seconds = float(np.mean(timed.seconds[title]))
        wall, _ = sleeping(options.tasks, options.slots, seconds)
        used, spent = used + options.tasks * seconds, spent + options.slots * wall
        print(
            f"{title}: {seconds:.3f} CPU s a part; {options.tasks} tasks on {options.slots} slots "
            f"{wall:.2f} s, {options.tasks * seconds / (options.slots * wall):.0%} of them busy",
            flush=True,
        )
    print(f"an attempt: {used / spent:.0%} busy", flush=True)


def compare(first: Path, other: Path) -> None:
    """Print how far two solutions differ."""
    costs = [json.loads((path / "figures.json").read_text())["cost"] for path in (first, other)]
    a, b = np.load(first / "poses.npy"), np.load(other / "poses.npy")
    print(
        f"cost {abs(costs[0] / costs[1] - 1):.1e} of it, rotations {np.abs(a - b)[:, :9].max():.1e}"
        f", positions {np.abs(a - b)[:, 9:].max():.1e} m, same bytes {np.array_equal(a, b)}"
    )


@dataclass(frozen=True)
class Stored:
    """Frames of a run before an adjustment, as its stages have stored them, so many copies."""

    keypoints: Keypoints
    matches: tuple[Matches, ...]
    start: Solution

    @classmethod
    def load(cls, run: Path, num_frames: int, folder: Path) -> "Stored":
        """The first frames of copies side by side, arrays on the disk of `folder`."""
        keypoints = load_stage(run, "keypoints", Keypoints)
        matches = [load_stage(run, name, Matches) for name in ("adjacent", "near")]
        start = load_stage(run, "chain", Solution)
        num = len(start.world_T_rigs)
        copies = -(-num_frames // num)
        starts = np.concatenate([[0], np.cumsum(np.tile(np.diff(keypoints.starts), copies))])
        last = int(starts[num_frames])
        columns = concatenated(_copies(keypoints, copies, last), folder)
        there = Keypoints(starts[: num_frames + 1].astype(np.int64), *columns)
        poses = [start.world_T_rigs]
        step = inverse(poses[0][-2]) @ poses[0][-1]
        for _ in range(copies - 1):
            poses.append(poses[-1][-1] @ step @ inverse(poses[0][0]) @ poses[0])
        world_T_rigs = np.concatenate(poses)[:num_frames]
        both = tuple(_copied(one, copies, num, num_frames) for one in matches)
        return cls(there, both, replace(Solution.without_points(world_T_rigs), noise=start.noise))


def _copies(keypoints: Keypoints, copies: int, last: int) -> Iterator[tuple[np.ndarray, ...]]:
    """Columns of keypoints, again and again up to a row."""
    columns = [getattr(keypoints, name) for name in COLUMNS]
    for copy in range(copies):
        left = last - copy * len(keypoints.faces)
        yield tuple(column[:left] for column in columns)


def _copied(matches: Matches, copies: int, num: int, num_frames: int) -> Matches:
    """Matches of copies of `num` frames, both of the first `num_frames`."""
    pairs = np.concatenate([matches.pairs + np.int32(n * num) for n in range(copies)])
    rows = [matches.of(p) for p in range(len(matches.pairs))] * copies
    chosen = np.flatnonzero(pairs.max(axis=1) < num_frames)
    return Matches.of_rows(pairs[chosen], [rows[p] for p in chosen])


def again(options: argparse.Namespace) -> None:
    """Print what an adjustment and covariances of a run's matches take, in parts."""
    out = options.out
    stored = Stored.load(options.run, options.frames, out)
    chosen, frames = RefineSettings(), load_stage(options.run, "frames", FrameSet)
    prior = TrajectoryPrior(stored.start.world_T_rigs, chosen.priors)
    rig = cubemap.rig_for(frames.format, chosen.cubemap)
    with hired(options.workers, out / "shards", 0.0) as (workers, peak):
        division = DividedAdjustments(out / "parts", out / "shards", workers, options.part)
        families = Families((Bearings(), prior))
        context = AdjustmentContext(families, rig, chosen, 1, division=division, scratch=out)
        sizes = np.diff(stored.keypoints.starts)
        print(f"{len(sizes)} frames, {sizes.sum()} keypoints", flush=True)
        with _taking("adjustment", workers, peak):
            found = tracks.build(stored.matches, sizes, out)
            given = stored.start, context, chosen.rounds.dense, False
            solved = adjustment.adjust(found, stored.keypoints, *given)
            print(f"{len(solved.landmarks.tracks)} observations", flush=True)
        with _taking("covariances", workers, peak):
            adjustment.pose_covariances(solved, stored.keypoints, context)


@contextmanager
def _taking(what: str, workers: Workers, peak: Callable[[], float]) -> Iterator[None]:
    """Print what is taken within this context, by this process and by workers."""
    give_back_freed_memory(0)
    release_mapped_files()
    Path("/proc/self/clear_refs").write_text("5")  # the peak is counted from here
    here, there, before = time.process_time(), workers.spent().cpu_seconds, peak_mb()
    yield
    print(
        f"{what}: CPU s here {time.process_time() - here:.1f}, of workers "
        f"{workers.spent().cpu_seconds - there:.1f}; MB here before {before:.0f}, peak "
        f"{peak_mb():.0f}, of a worker {peak():.0f}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    for name, tolerance in (("solve", 1e-7), ("whole", 1e-7), ("asleep", 1e-5)):
        command = commands.add_parser(name)
        command.add_argument("frames", type=int)
        command.add_argument("--out", type=Path, required=True)
        command.add_argument("--tolerance", type=float, default=tolerance)
        command.add_argument("--part", type=int, default=1000)
        if name == "asleep":
            command.add_argument("--tasks", type=int, default=140)
            command.add_argument("--slots", type=int, default=64)
        else:
            command.add_argument("--workers", type=int, default=0)
            command.add_argument("--kill", type=float, default=0.0)
            command.add_argument("--stop-after", type=int, default=0)
    command = commands.add_parser("again")
    command.add_argument("run", type=Path)
    command.add_argument("--frames", type=int, required=True)
    command.add_argument("--out", type=Path, required=True)
    command.add_argument("--part", type=int, default=1000)
    command.add_argument("--workers", type=int, default=0)
    command = commands.add_parser("compare")
    command.add_argument("first", type=Path)
    command.add_argument("other", type=Path)
    options = parser.parse_args()
    if options.command == "compare":
        compare(options.first, options.other)
        return
    if options.command == "asleep":
        asleep(options)
        return
    options.out.mkdir(parents=True, exist_ok=True)
    if options.command == "again":
        again(options)
        return
    result, figures = (solve if options.command == "solve" else whole)(options)
    truth = make_city(options.frames).truth
    poses = np.array([result.values.atPose3(X(f)).matrix()[:3] for f in range(options.frames)])
    rows = np.hstack([poses[:, :, :3].reshape(-1, 9), poses[:, :, 3]])
    np.save(options.out / "poses.npy", rows)
    off = np.sqrt(((rows - truth)[:, 9:] ** 2).sum(axis=1).mean())
    figures |= {
        "frames": options.frames,
        "cost": result.cost,
        "attempts": len(result.history) - 1,
        "reason": result.reason,
        "rms_m": float(off),
        "caller_peak_mb": peak_mb(),
    }
    (options.out / "figures.json").write_text(json.dumps(figures, indent=1))
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
