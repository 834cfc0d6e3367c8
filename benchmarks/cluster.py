"""Cost and gain of work on a Dask scheduler's workers.

    python -m benchmarks.cluster FRAMES SLAM --out WORK [--shards 2000] [--slots 64]

The first table is of one run with threads of this process, and with 1, 2, ... worker processes of
one thread each: wall clock and CPU seconds of the parallel stages, with those of all workers, and a
check that results are equal to the byte. The second table is of shards that only sleep and write,
on many slots: it shows the overhead of scheduler, shared files and this process. Wall times depend
on other load of the machine: compare them within a table only.
"""

import argparse
import json
import resource
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from distributed import Client, LocalCluster

import gsba
from benchmarks.common import write_table
from gsba.config import RefineSettings
from gsba.store.cluster import Cluster
from gsba.store.shards import even_blocks

OUTPUTS = "trajectory.tum", "poses.csv", "points.ply", "colmap/**/*"
WRITTEN = 100_000  # bytes that a generated shard writes


@dataclass(frozen=True)
class Sleeps:
    """Job of items that sleep and write some bytes."""

    items: np.ndarray
    seconds: float
    title: str = "sleeping"
    returns: Any = np.ndarray

    def __len__(self) -> int:
        return len(self.items)

    def __call__(self, item: int) -> np.ndarray:
        time.sleep(self.seconds)
        return np.full(WRITTEN, self.items[item] % 251, np.uint8)

    def blocks(self) -> Sequence[tuple[int, int]]:
        return even_blocks(len(self.items), 1)

    def part(self, start: int, stop: int) -> "Sleeps":
        return replace(self, items=self.items[start:stop])


def refine(frames: Path, slam: Path, out: Path, num: int) -> tuple[float, float, float, float]:
    """Run on `num` workers; 0 = one thread of this process.

    Returns:
        Wall and CPU seconds of the parallel stages, and of the others.
    """
    settings = RefineSettings.model_validate({"solver": {"num_threads": 1}})
    if num == 0:
        gsba.refine(frames, slam, out, settings, fresh=True)
    else:
        with (
            LocalCluster(
                n_workers=num, threads_per_worker=1, memory_limit=0, dashboard_address=":0"
            ) as here,
            Client(here) as client,
        ):
            gsba.refine(frames, slam, out, settings, fresh=True, client=client)
    return stages(out)


def stages(out: Path) -> tuple[float, float, float, float]:
    """Wall and CPU seconds of a finished run, see `refine`."""
    shared = ("features", "neighbours", "steps", "adjacent", "near", "loops", "everywhere", "align",
              "places", "export-colmap")  # fmt: skip
    found = np.zeros((2, 2))
    for stage in json.loads((out / "report.json").read_text())["stages"]:
        row = int(stage["name"].rstrip("0123456789") not in shared)
        found[row] += stage["seconds"], stage["cpu_seconds"]
    (wall, cpu), (wall_else, cpu_else) = found.tolist()
    return wall, cpu, wall_else, cpu_else


def asleep(num: int, slots: int, seconds: float) -> tuple[float, float]:
    """Wall and CPU seconds of scheduler, workers and this process for shards that sleep."""
    with (
        tempfile.TemporaryDirectory() as folder,
        LocalCluster(
            n_workers=slots,
            threads_per_worker=1,
            processes=False,
            memory_limit=0,
            dashboard_address=":0",
        ) as here,
        Client(here) as client,
    ):
        cluster = Cluster(client, Path(folder), Path(folder))
        wall, cpu = time.perf_counter(), resource.getrusage(resource.RUSAGE_SELF)
        found = sum(1 for _ in cluster.map_shards(Sleeps(np.arange(num), seconds)))
        wall, after = time.perf_counter() - wall, resource.getrusage(resource.RUSAGE_SELF)
        if found != num:
            sys.exit(f"{found} of {num} shards came back")
        return wall, after.ru_utime + after.ru_stime - cpu.ru_utime - cpu.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("frames", type=Path)
    parser.add_argument("slam", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--workers", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--shards", type=int, default=2000)
    parser.add_argument("--slots", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    lines = [
        "| workers | shared stages: wall s | CPU s | other stages: wall s | CPU s | same bytes |",
        "|---|---|---|---|---|---|",
    ]
    first: list[bytes] = []
    for num in options.workers:
        out = options.out / f"workers{num}"
        figures = refine(options.frames, options.slam, out, num)
        paths = sorted(path for name in OUTPUTS for path in out.glob(name) if path.is_file())
        written = [path.read_bytes() for path in paths]
        first = first or written
        same = "yes" if written == first else "NO"
        who = f"{num} processes" if num else "a thread here"
        lines.append(f"| {who} | {' | '.join(f'{x:.1f}' for x in figures)} | {same} |")
        print(lines[-1], flush=True)
    wall, cpu = asleep(options.shards, options.slots, options.seconds)
    ideal = options.shards * options.seconds / options.slots
    lines += [
        "",
        f"{options.shards} shards that sleep {options.seconds:g} s and write {WRITTEN // 1000} kB, "
        f"on {options.slots} slots: {wall:.1f} s of wall clock, {wall / ideal:.2f} times as long "
        f"as sleeping alone; {1000 * cpu / options.shards:.1f} ms of CPU a shard in scheduler, "
        "workers and the run together.",
    ]
    write_table(lines, options.markdown)


if __name__ == "__main__":
    main()
