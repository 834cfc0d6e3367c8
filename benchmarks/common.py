"""Functions of all benchmarks: child processes and their kept rows, cut walks, the machine.

The kernel includes the peak memory of the forking process in its child's `ru_maxrss`. Therefore
`measure` starts commands from this file in a separate process, which must stay small: heavy imports
are in the functions that need them.
"""

import hashlib
import json
import os
import platform
import resource
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True, slots=True)
class Measurement:
    """Cost of a command, from its start to its exit."""

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


def cpu_of_children() -> float:
    """CPU seconds, user and system, of the child processes that have ended."""
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


def kept_row(folder: Path, key: dict, timeout_s: float) -> dict | None:
    """Row of a folder, if it has this key and a repetition would not change it; None otherwise."""
    kept = folder / "row.json"
    if not kept.exists():
        return None
    row = json.loads(kept.read_text())
    ended = "errors" in row or (row["timed_out"] and row["wall_s"] >= timeout_s)
    return row if row["key"] == key and ended else None


def run_row(
    command: Sequence[str], folder: Path, row: dict, finish: Callable[[], dict], timeout_s: float
) -> dict[str, Any]:
    """Run a command; keep and return the row with its cost and outcome.

    Args:
        command: the command.
        folder: folder of `row.json` and `log.txt`.
        row: entries known before; `kept_row` compares its `key`.
        finish: computes the outcome from the command's files, `errors` among others.
        timeout_s: time after which the command is killed, seconds.
    """
    cost = measure(command, folder / "log.txt", timeout_s)
    row = row | asdict(cost)
    if cost.timed_out:
        row["reason"] = f"stopped after {timeout_s / 60:g} minutes"
    elif cost.exit_code != 0:
        row["reason"] = last_line(folder / "log.txt")
    else:
        row |= outcome(finish)
    _write(folder / "row.json", json.dumps(row, indent=1))
    return row


def outcome(finish: Callable[[], dict]) -> dict[str, Any]:
    """Outcome of a row, or the reason why it has none."""
    from gsba.log import GsbaError

    try:
        return finish()
    except GsbaError as error:
        return {"reason": str(error)}


def refine_command(frames: Path, run: Path, options: Sequence[str]) -> list[str]:
    """Command of a whole run without a dataset."""
    command = [sys.executable, "-c", "from gsba.cli import main; main()", "refine", str(frames)]
    options = [*options, "--out", str(run), "--fresh", "--allow-partial"]
    return [*command, *options, "--set", "export.formats=[]"]


def link_frames(frames: Iterable[Path], folder: Path) -> Path:
    """The folder, with links to these frames and nothing else, as the peer reads a folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for path in frames:
        (folder / path.name).symlink_to(path.resolve())
    return folder


def last_line(log: Path) -> str:
    """Last line of a command's output."""
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1] if lines else "failed without a word"


def digest(paths: Iterable[Path]) -> str:
    """Fingerprint of files' contents."""
    total = hashlib.sha256()
    for path in paths:
        total.update(hashlib.sha256(path.read_bytes()).digest())
    return total.hexdigest()[:16]


def code_digest() -> str:
    """Fingerprint of the code that a run executes."""
    import factors
    import gsba

    homes = [Path(str(package.__file__)).parent for package in (gsba, factors)]
    return digest(path for home in homes for path in sorted(home.rglob("*.py")))


def take_frames(walk: Path, rows: "np.ndarray", times: "np.ndarray", folder: Path) -> None:
    """Link frames (R,) of a walk, at times (R,) in seconds, into a folder with timestamps.csv."""
    table = (walk / "images/timestamps.csv").read_text().splitlines()[1:]
    names = [Path(row.partition(",")[0]).stem for row in table]
    images = {path.stem: path for path in (walk / "images").iterdir()}
    folder.mkdir(parents=True, exist_ok=True)
    for row in rows.tolist():
        target = folder / images[names[row]].name
        target.unlink(missing_ok=True)
        target.symlink_to(images[names[row]].resolve())
    lines = [f"{names[row]},{time:.6f}" for row, time in zip(rows.tolist(), times, strict=True)]
    (folder / "timestamps.csv").write_text("\n".join(["name,timestamp", *lines, ""]))


def machine() -> str:
    """Processor and cores that may be used, for the head of a table."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    model = models[0] if models else platform.machine()
    return f"{model}, {len(os.sched_getaffinity(0))} cores"


def write_table(lines: Sequence[str], path: Path | None) -> None:
    """Write the lines of a Markdown table and the machine, if there is a path."""
    if path is not None:
        _write(path, "\n".join([*lines, "", f"{machine()}.", ""]))


def _write(path: Path, text: str) -> None:
    from gsba.disk import write_text

    write_text(path, text)


if __name__ == "__main__":
    print(json.dumps(_stopwatch(float(sys.argv[1]), sys.argv[2:])))
