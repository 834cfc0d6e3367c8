"""What the benchmarks share: a stopwatch for child processes, and the machine they ran on.

The kernel counts the peak of the process that forks into its child's `ru_maxrss`. So `measure`
starts commands from this file, run as a process of its own that is too small to blur them.
"""

import json
import os
import platform
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Measurement:
    """What a command cost, from its start to its exit."""

    wall_s: float
    cpu_s: float  # user and system, all threads
    peak_mb: float  # resident
    exit_code: int  # negative: killed by that signal
    timed_out: bool


def measure(command: Sequence[str], log: Path, timeout_s: float) -> Measurement:
    """Run a command to its end, or kill it after `timeout_s`; its output goes to `log`."""
    log.parent.mkdir(parents=True, exist_ok=True)
    stopwatch = [sys.executable, "-S", __file__, str(timeout_s), *command]
    with log.open("w") as output:
        done = subprocess.run(stopwatch, stdout=subprocess.PIPE, stderr=output, check=True)
    return Measurement(**json.loads(done.stdout))


def _stopwatch(timeout_s: float, command: Sequence[str]) -> dict[str, float | bool]:
    start = time.perf_counter()
    process = subprocess.Popen(command, stdout=sys.stderr)
    timer = threading.Timer(timeout_s, process.kill)
    timer.daemon = True
    timer.start()
    _, status, usage = os.wait4(process.pid, 0)
    wall_s = time.perf_counter() - start
    timer.cancel()
    return {
        "wall_s": wall_s,
        "cpu_s": usage.ru_utime + usage.ru_stime,
        "peak_mb": usage.ru_maxrss / 1024,
        "exit_code": os.waitstatus_to_exitcode(status),
        "timed_out": wall_s >= timeout_s,
    }


def peak_mb() -> float:
    """Peak resident memory of this process since its program started, without its parent's."""
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024


def machine() -> str:
    """Processor and cores that may be used, for the head of a table."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    model = models[0] if models else platform.machine()
    return f"{model}, {len(os.sched_getaffinity(0))} cores"


def write_table(lines: Sequence[str], path: Path | None) -> None:
    """Write the lines of a Markdown table and the machine they are of, if there is a path."""
    from gsba.records import atomic_write

    text = "\n".join([*lines, "", f"{machine()}.", ""])
    if path is not None:
        atomic_write(path, lambda file: file.write_text(text))


if __name__ == "__main__":
    print(json.dumps(_stopwatch(float(sys.argv[1]), sys.argv[2:])))
