"""The stages of a run that one core computes, and what 16 cores would make of it (Amdahl, 1967).

    python -m benchmarks.cores RUN [--cores 2 4 16] [--markdown FILE]

RUN was computed by two threads or more, in one call. The serial part of a stage is the CPU time
of the thread that computes it, which only waits where others share the work; so it does not depend
on what else the machine does. The rest is taken to be shared evenly: that is a bound, as threads of
Python code take turns, and hyper-threads share a core (results/cores.md has what 16 cores gained).
"""

import argparse
import json
from pathlib import Path

from benchmarks.common import write_table

SHOWN = 12  # stages with the most serial CPU time


def table(stages: list[dict], cores: list[int]) -> list[str]:
    """Rows of the stages with the most serial CPU time, and of all."""
    whole = {
        "name": f"all {len(stages)} stages",
        "cpu_seconds": sum(stage["cpu_seconds"] for stage in stages),
        "serial_cpu_seconds": sum(stage["serial_cpu_seconds"] for stage in stages),
    }
    largest = sorted(stages, key=lambda stage: -stage["serial_cpu_seconds"])[:SHOWN]
    titles = " | ".join(f"faster on {num}" for num in cores)
    lines = [f"| stage | CPU s | of one thread | {titles} |", "|---|---|---|" + "---|" * len(cores)]
    for stage in [*largest, whole]:
        total, serial = stage["cpu_seconds"], min(stage["serial_cpu_seconds"], stage["cpu_seconds"])
        gains = [total / max(serial + (total - serial) / num, 1e-9) for num in cores]
        shown = " | ".join(f"{gain:.1f}" for gain in gains)
        lines.append(f"| {stage['name']} | {total:.1f} | {serial:.1f} | {shown} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--cores", type=int, nargs="+", default=[2, 4, 16])
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    stages = json.loads((options.run / "report.json").read_text())["stages"]
    lines = table(stages, options.cores)
    print("\n".join(lines))
    write_table(lines, options.markdown)


if __name__ == "__main__":
    main()
