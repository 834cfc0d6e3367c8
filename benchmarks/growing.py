"""Finished runs that grow, beside the joint solution of all recordings: errors and CPU seconds.

    python benchmarks/growing.py --out WORK --markdown benchmarks/results/growing.md \
        --walk FLAT AGAIN

FLAT and AGAIN are two walks through one flat (`images/` and their timestamps.csv,
`groundtruth.tum`, `mask.png`). The first recording is the first two thirds of FLAT, the second one
the last two thirds of AGAIN; once more, a short second one of 15 frames. Each has a clock, world
and scale of its own, and a trajectory with drift. The first is refined, then the second one added
to its run, with and without `--fixed`; the long one is also refined alone, its run merged with that
of the first, and taken out again. Every run is a process of its own; rows are kept in WORK and
used again while code and input stay the same. The exit code is 1 if the error of a grown or merged
run is more than 1.3 times that of the joint solution, or poses that are fixed changed.
"""

import argparse
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import code_digest, digest, kept_row, run_row, write_table
from recording_cuts import Cut, cut_rows, position_errors

from gsba.store.finished import load_run
from gsba.trajectory.files import read_trajectory

MAX_RATIO = 1.3  # of a grown run's error to that of the joint solution
TIMEOUT_S = 3600.0
NUM_SHORT = 15  # frames of the short second recording
HEAD = [
    "| flat | frames | run | in the exported map | ATE mm | of the joint one's | CPU s "
    "| of the joint one's | verdict |",
    "|---|---|---|---:|---:|---:|---:|---:|---|",
]
_GSBA = [sys.executable, "-c", "from gsba.cli import main; main()"]
_SET = ["--set", "export.formats=[]"]


class Part(NamedTuple):
    """A recording."""

    walk: Path
    cut: Cut
    name: str

    def option(self) -> list[str]:
        """The recording as an option of the command line."""
        text = f"{self.cut.folder},name={self.name},masks={self.walk / 'mask.png'}"
        return ["--recording", f"{text},trajectory={self.cut.trajectory}"]


class Bench(NamedTuple):
    """Folder, code and recordings of a table."""

    out: Path
    code: str
    parts: tuple[Part, Part]

    def row(self, what: str, command: Sequence[str], check: Callable[[Path], Any]) -> dict:
        """Row of one command, which writes the run `run` in its folder."""
        folder = self.out / what.replace(" ", "").replace("-", "")
        files = [path for one in self.parts for path in sorted(one.cut.folder.iterdir())]
        files += [one.cut.trajectory for one in self.parts]
        key = {"code": self.code, "input": digest(files)}
        if row := kept_row(folder, key, TIMEOUT_S):
            return row
        print(f"running {folder}", file=sys.stderr, flush=True)
        run = folder / "run"
        shutil.rmtree(run, ignore_errors=True)
        words = [*_GSBA, *command, "--out", str(run), "--allow-partial"]
        return run_row(
            words, folder, {"key": key, "what": what}, lambda: {"errors": check(run)}, TIMEOUT_S
        )

    def run_of(self, what: str) -> Path:
        """Run of a row."""
        return self.out / what.replace(" ", "").replace("-", "") / "run"

    def check(self, run: Path) -> dict[str, Any]:
        """Frames and error in millimetres of the exported map of a run."""
        reconstruction, frames = load_run(run)
        truths = {one.name: read_trajectory(one.walk / "groundtruth.tum") for one in self.parts}
        true = []
        for name in frames.names:
            owner, _, own = name.rpartition("/")
            walk = truths.get(owner, truths[self.parts[int("second" in run.parent.name)].name])
            true.append(walk.world_T_rigs[int(own)])
        errors = position_errors(reconstruction.world_T_rigs, np.array(true))
        ate = 1e3 * float(np.sqrt(np.mean(errors**2)))
        return {"frames": len(true), "ate_mm": ate}


def rows_of(bench: Bench, short: bool) -> list[dict]:
    """Rows of all runs of two recordings; those of `add` alone if the second one is short."""
    first, second = bench.parts
    mask = ["--masks", str(first.walk / "mask.png")]
    alone = ["refine", str(first.cut.folder), str(first.cut.trajectory), *mask, "--fresh", *_SET]
    joint = ["refine", *first.option(), *second.option(), "--fresh", *_SET]
    rows = [
        bench.row("first alone", alone, bench.check),
        bench.row("joint", joint, bench.check),
    ]
    grow = ["add", str(bench.run_of("first alone")), *second.option()]
    rows += [
        bench.row("add", grow, bench.check),
        bench.row("add --fixed", [*grow, "--fixed"], bench.check),
    ]
    if short:
        return rows
    files = [str(second.cut.folder), str(second.cut.trajectory)]
    alone = ["refine", *files, "--masks", str(second.walk / "mask.png"), "--fresh", *_SET]
    both = ["merge", str(bench.run_of("first alone")), str(bench.run_of("second alone"))]
    away = ["remove", str(bench.run_of("add")), second.name]
    return [
        *rows,
        bench.row("second alone", alone, bench.check),
        bench.row("merge", both, bench.check),
        bench.row("merge --rigid", [*both, "--rigid"], bench.check),
        bench.row("remove the second", away, bench.check),
    ]


def verdict(bench: Bench, row: dict, joint: dict) -> str:
    """Verdict on a grown run; "" for others."""
    if not row.get("errors"):
        return f"**refused**: {row.get('reason', 'no map')}"
    if row["what"] not in ("add", "add --fixed", "merge"):
        return ""
    if row["what"].endswith("--fixed"):
        before = load_run(bench.run_of("first alone"))[0].world_T_rigs
        after = load_run(bench.run_of(row["what"]))[0].world_T_rigs[: len(before)]
        if before.tobytes() != after.tobytes():
            return "**poses moved**"
    if row["errors"]["frames"] < joint["errors"]["frames"]:
        return "**frames lost**"
    right = row["errors"]["ate_mm"] <= MAX_RATIO * joint["errors"]["ate_mm"]
    kept = ", poses to the byte" if row["what"].endswith("--fixed") else ""
    return f"right{kept}" if right else "**worse**"


def table_of(out: Path, code: str, walk: Path, again: Path, short: bool) -> list[tuple[str, str]]:
    """Lines and verdicts of two walks through one flat."""
    num = len(read_trajectory(walk / "groundtruth.tum").timestamps)
    first = np.arange(num) if short else np.arange(2 * num // 3)
    second = np.arange(num // 2, num // 2 + NUM_SHORT) if short else np.arange(num // 3, num)
    label = out / f"{walk.name}-{'short' if short else 'long'}"
    parts = (
        Part(walk, cut_rows(walk, first, label / "cuts/first", 0), "first"),
        Part(again, cut_rows(again, second, label / "cuts/second", 1), "second"),
    )
    bench = Bench(label, code, parts)
    rows = rows_of(bench, short)
    joint, lines = rows[1], []
    for row in rows:
        found = verdict(bench, row, joint)
        errors = row.get("errors") or {"frames": 0, "ate_mm": np.nan}
        shares = [
            f"{errors['ate_mm'] / joint['errors']['ate_mm']:.2f}",
            f"{row['cpu_s'] / joint['cpu_s']:.2f}",
        ]
        cells = [walk.name, f"{len(first)} + {len(second)}", row["what"], str(errors["frames"])]
        cells += [f"{errors['ate_mm']:.2f}", shares[0], f"{row['cpu_s']:.0f}", shares[1], found]
        lines.append((f"| {' | '.join(cells)} |", found))
        print(lines[-1][0], flush=True)
    return lines


def main() -> None:
    """Parse, run, print; exit with 1 if a bar is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--walk", action="append", nargs=2, type=Path, required=True, metavar=("FLAT", "AGAIN")
    )
    parser.add_argument("--out", type=Path, default=Path("build/growing"), help="kept rows")
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    print("\n".join(HEAD), flush=True)
    lines, out = list[tuple[str, str]](), options.out.resolve()
    for walk, again in options.walk:
        for short in (False, True):
            lines += table_of(out, code_digest(), walk.resolve(), again.resolve(), short)
    foot = (
        "Frames: of the first recording and of the second one, which is added. ATE: of all frames "
        "of the exported map after one alignment to the truth. Right: no frame of the joint "
        f"solution is missing, and the error is at most {MAX_RATIO} times its. CPU seconds of the "
        "command alone: those of `add` come after those of the first recording alone."
    )
    print("\n" + foot)
    write_table(
        ["# Runs that grow", "", *HEAD, *(text for text, _ in lines), "", foot], options.markdown
    )
    sys.exit(any("**" in found for _, found in lines))


if __name__ == "__main__":
    main()
