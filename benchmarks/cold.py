"""The first run after an installation: how long it takes to compile kernels, and to start.

    python benchmarks/cold.py --markdown benchmarks/results/cold.md
    python benchmarks/cold.py --beside OTHER/bin/python   # another gsba, in turn
    python benchmarks/cold.py --record        # after a change of kernels: renews the signatures

`gsba demo`, and `gsba refine` of its walk, with an empty cache of kernels and with a full one, in
turn in one call. CPU seconds include those of processes that compile beside the one that works.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from itertools import product
from pathlib import Path

from common import cpu_of_children

Measured = dict[tuple[str, str, str], list[tuple[float, float]]]

_LISTENER = """
import atexit, pickle, sys
from numba.core import event
class Outermost(event.Listener):
    depth, found = 0, []
    def on_start(self, event):
        if self.depth == 0:
            kernel, args = event.data["dispatcher"].py_func, tuple(event.data["args"])
            self.found.append((f"{kernel.__module__}.{kernel.__qualname__}", args))
        self.depth += 1
    def on_end(self, event):
        self.depth -= 1
event.register("numba:compile", Outermost())
out = sys.argv.pop(1)
atexit.register(lambda: pickle.dump(Outermost.found, open(out, "wb")))
from gsba.compilation import ahead
ahead._MAX_PROCESSES = 0
from gsba.cli import main
main()
"""


def main() -> None:
    """Measure, or record signatures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--record", action="store_true", help="write gsba/compilation/signatures")
    parser.add_argument("--runs", type=int, default=3, help="of each command in each state")
    parser.add_argument("--markdown", type=Path)
    parser.add_argument("--beside", type=Path, help="interpreter that imports another gsba")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if arguments.record:
            _record(Path(folder))
        else:
            pythons = {"this": Path(sys.executable)}
            if arguments.beside:
                pythons["the other"] = arguments.beside.absolute()
            table = _table(_measure(Path(folder), pythons, arguments.runs))
            print(table)
            if arguments.markdown:
                arguments.markdown.write_text(table)


def _measure(folder: Path, pythons: dict[str, Path], runs: int) -> Measured:
    """Wall and CPU seconds of all runs, by code, command and state of the cache."""
    walk = folder / "walk"
    commands = {
        "gsba demo": ["demo", "--out", str(walk)],
        "gsba refine": [
            "refine", str(walk / "walk/images"), str(walk / "walk/slam.tum"),
            "--out", str(folder / "run"), "--fresh",
        ],
    }  # fmt: skip
    found: Measured = {}
    for n in range(runs):
        for (name, command), (code, python) in product(commands.items(), pythons.items()):
            cache = folder / f"{code}-{name}-{n}"
            for state in ("empty", "full"):
                before, start = cpu_of_children(), time.perf_counter()
                _run(["-c", "from gsba.cli import main; main()", *command], cache, python)
                wall = time.perf_counter() - start
                found.setdefault((name, code, state), []).append((wall, cpu_of_children() - before))
    return found


def _table(found: Measured) -> str:
    lines = [
        "| command | code | cache | wall s, median (least to most) | CPU s | runs |",
        "|---|---|---|---:|---:|---:|",
    ]
    for (name, code, state), runs in sorted(found.items()):
        walls, cpus = zip(*runs, strict=True)
        wall = f"{statistics.median(walls):.1f} ({min(walls):.1f} to {max(walls):.1f})"
        cells = [f"`{name}`", code, state, wall, f"{statistics.median(cpus):.1f}", str(len(runs))]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _record(folder: Path) -> None:
    """Write the signatures that each kind of work compiles, with nothing compiled before."""
    import pickle

    from gsba.compilation import signatures

    def compiled(name: str, *command: str) -> list:
        _run(["-c", _LISTENER, str(folder / name), *command], folder / f"{name}-cache")
        return pickle.loads((folder / name).read_bytes())

    walk, film = folder / "walk", folder / "film"
    demo = compiled("demo", "demo", "--out", str(walk))
    images, slam = walk / "walk/images", walk / "walk/slam.tum"
    refine = compiled("refine", "refine", str(images), str(slam), "--out", str(folder / "run"))
    few = compiled("few", "demo", "--frames", "12", "--width", "512", "--out", str(folder / "few"))
    video = compiled("video", "demo", "--video", "--out", str(film))
    rendering = [kernel for kernel in demo if kernel[0].startswith("gsba.demo.")]
    refine += [kernel for kernel in few if kernel not in [*refine, *rendering]]
    odometry = [kernel for kernel in video if kernel not in rendering]
    signatures.write({"demo": rendering, "refine": refine, "odometry": odometry})


def _run(arguments: list[str], cache: Path, python: Path = Path(sys.executable)) -> None:
    command = [str(python), "-P", *arguments]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        sys.exit(done.stderr)


if __name__ == "__main__":
    main()
