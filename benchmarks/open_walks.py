"""Open walks with and without a trajectory: no trajectory may make the result worse.

    python benchmarks/open_walks.py --out WORK --markdown benchmarks/results/open_walks.md

Walks are the first parts of closed sequences of `--data` (skipped if absent), the demo's open walk,
and your own: `--walk FOLDER` with `images/` and their timestamps.csv, `groundtruth.tum` and, if
there is one, `slam.tum`. Each is refined without a trajectory and with three: `slam.tum`, then
degradations of the truth. Several seeds of the run without a trajectory show its scatter. Every run
is a separate process; rows are kept in WORK and used again while code, options and input stay the
same. `--set` is passed to `gsba refine`, to compare variants. The exit code is 1 if a target is
missed.
"""

import argparse
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from common import (
    Case,
    code_digest,
    cut_short,
    digest,
    kept_row,
    refine_command,
    run_row,
    write_table,
)

from gsba.demo import degrade, make_walk
from gsba.demo.walk import Heading
from gsba.evaluate.trajectory import evaluate
from gsba.log import GsbaError
from gsba.trajectory.files import read_trajectory, write_tum

DATA = Path(__file__).resolve().parents[2] / "shared/data"
CUT = {"aisle_loop": 40, "gallery_forward": 32}  # frames left
DEMOS: dict[str, Heading] = {"demo open, locked": "locked", "demo open, forward": "forward"}
NUM_TRAJECTORIES = 3
DEGRADE_SEEDS = 101, 102, 103
MAX_RATIO = 1.1  # ATE with a trajectory over that without
MAX_ATE = 2e-3  # units
AUC_DEG = "0.1"
TIMEOUT_S = 2400.0


def find(name: str, data: Path, out: Path) -> Case:
    """Frames and truth of a sequence; GsbaError if it is not on this machine."""
    if name in DEMOS:
        folder = out / "walk"
        if not (folder / "groundtruth.tum").exists():
            make_walk(folder, "open", DEMOS[name])
    else:
        folder = data / name  # an absolute path is that path
        if not folder.is_dir():
            raise GsbaError(f"{folder} is absent")
    slam = folder / "slam.tum"
    case = Case(folder / "images", slam if slam.exists() else None, folder / "groundtruth.tum")
    return cut_short(case, CUT[name], out / "cut") if name in CUT else case


def coarse_trajectories(case: Case, out: Path) -> list[Path]:
    """Recorded trajectory if there is one, and degradations of the truth, three in all."""
    paths = [case.trajectory] if case.trajectory else []
    truth = read_trajectory(case.truth)
    for seed in DEGRADE_SEEDS[: NUM_TRAJECTORIES - len(paths)]:
        paths.append(out / f"{seed}.tum")
        write_tum(paths[-1], degrade(truth, seed))
    return paths


class Bench(NamedTuple):
    """Folder and conditions of the rows of one call."""

    out: Path
    code: str
    sets: list[str]  # KEY=VALUE of every run
    num_seeds: int

    def rows(self, folder: Path, case: Case) -> tuple[list[dict], list[dict]]:
        """Rows without a trajectory, one for each seed, and rows with a trajectory."""
        starts = coarse_trajectories(case, folder)
        without = [self._row(folder, case, None, seed) for seed in range(self.num_seeds)]
        return without, [self._row(folder, case, start, 0) for start in starts]

    def _row(self, folder: Path, case: Case, start: Path | None, seed: int) -> dict:
        sets = [*self.sets, *([f"seed={seed}"] if seed else [])]
        home = folder / (_slug(" ".join(sets)) or "default") / (start.stem if start else "none")
        files = [*sorted(case.images.iterdir()), case.truth, *([start] if start else [])]
        key = {"code": self.code, "input": digest(files), "sets": sets}
        if row := kept_row(home, key, TIMEOUT_S):
            return row
        print(f"running {home}", file=sys.stderr, flush=True)
        options = [str(start) if start else "--no-trajectory"]
        options += [word for one in sets for word in ("--set", one)]

        def finish() -> dict:
            truth = read_trajectory(case.truth)
            errors = evaluate(read_trajectory(home / "run/trajectory.tum"), truth)
            steps = np.diff(truth.world_T_rigs[:, :3, 3], axis=0)
            path = float(np.linalg.norm(steps, axis=1).sum())
            return {"errors": errors.to_json(), "path": path}

        command = refine_command(case.images, home / "run", options)
        row = {"key": key, "start": start.stem if start else None, "seed": seed}
        return run_row(command, home, row, finish, TIMEOUT_S)


class Judged(NamedTuple):
    """Line of a sequence in the table, with its errors."""

    line: str
    without: list[float]  # ATE, units, one for each seed
    with_one: list[float]  # one for each trajectory
    held: bool


HEAD = [
    "| sequence | frames | path | ATE without | other seeds | trajectories | ATE with "
    f"| worst ratio | of medians | chance | AUC@{AUC_DEG}° without | with | targets |",
    "|---|---:|---:|---:|---|---|---|---:|---:|---:|---:|---|---|",
]


def judge(name: str, without: list[dict], with_one: list[dict]) -> Judged:
    """Compare the runs of one sequence.

    Raises:
        GsbaError: a run failed.
    """
    for row in (*without, *with_one):
        if "errors" not in row:
            raise GsbaError(f"from {row['start'] or 'none'}, seed {row['seed']}: {row['reason']}")
    none, some = [_ate(row) for row in without], [_ate(row) for row in with_one]
    ratio = max(some) / none[0]
    missed = [f"**ratio above {MAX_RATIO}**"] if ratio > MAX_RATIO else []
    missed += [f"**with one above {1e3 * MAX_ATE:g}**"] if max(some) > MAX_ATE else []
    missed += [f"**without above {1e3 * MAX_ATE:g}**"] if max(none) > MAX_ATE else []
    cells = [
        name,
        str(without[0]["errors"]["num_truth"]),
        f"{without[0]['path']:.1f}",
        _ate_cell(without[0]),
        ", ".join(map(_ate_cell, without[1:])),
        ", ".join(row["start"] for row in with_one),
        ", ".join(map(_ate_cell, with_one)),
        f"{ratio:.2f}",
        f"{np.median(some) / np.median(none):.2f}",
        f"{max(none) / min(none):.2f}" if len(none) > 1 else "",
        _auc_cell(without[0]),
        ", ".join(map(_auc_cell, with_one)),
        ", ".join(missed) or "ok",
    ]
    return Judged(f"| {' | '.join(cells)} |", none, some, not missed)


def _ate(row: dict) -> float:
    return row["errors"]["ate"]["rmse"]


def _ate_cell(row: dict) -> str:
    """ATE in 1e-3 units, and the number of posed frames if it is not that of all."""
    errors = row["errors"]
    posed = f"{errors['num_matched']}/{errors['num_truth']}"
    ate = f"{1e3 * _ate(row):.2f}"
    return ate if errors["num_matched"] == errors["num_truth"] else f"{ate} ({posed} posed)"


def _auc_cell(row: dict) -> str:
    return f"{100 * row['errors']['auc'][AUC_DEG]:.1f}"


def summary(judged: list[Judged]) -> str:
    """Line on the mean effect of a trajectory over all sequences."""
    logs = [(np.log(one.with_one), np.log(one.without)) for one in judged if one.without]
    if not logs:
        return "Nothing was measured."
    factors = [with_one.mean() - without.mean() for with_one, without in logs]
    return (
        f"Over all {len(factors)}, ATE with a trajectory is {np.exp(np.mean(factors)):.2f} times "
        "that without (geometric means over trajectories, seeds, sequences)."
    )


def table(bench: Bench, names: list[str], data: Path) -> Iterator[Judged]:
    """Yield the lines of the table."""
    for name in names:
        label = f"{name}, first {CUT[name]}" if name in CUT else Path(name).name
        folder = bench.out / _slug(label)
        folder.mkdir(parents=True, exist_ok=True)
        try:
            case = find(name, data, folder)
        except GsbaError as error:
            yield Judged(_reason(label, f"skipped: {error}"), [], [], True)
            continue
        try:
            yield judge(label, *bench.rows(folder, case))
        except GsbaError as error:
            yield Judged(_reason(label, f"**failed**: {error}"), [], [], False)


def _reason(label: str, why: str) -> str:
    return f"| {label} {'|' * 12} {why} |"


def _slug(text: str) -> str:
    return re.sub(r"\W+", "_", text).strip("_")


def main() -> None:
    """Parse, run, print; exit with 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    every = [*CUT, *DEMOS]
    parser.add_argument("--data", type=Path, default=DATA, help="recorded sequences")
    parser.add_argument("--only", action="append", choices=every, help="repeatable")
    parser.add_argument("--walk", action="append", default=[], type=os.path.abspath)
    parser.add_argument("--set", action="append", default=[], dest="sets", metavar="KEY=VALUE")
    parser.add_argument(
        "--seeds", type=int, default=3, help="seeds of the run without a trajectory"
    )
    parser.add_argument("--out", type=Path, default=Path("build/open_walks"), help="kept rows")
    parser.add_argument("--note", default="", help="a paragraph for the table's foot")
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    bench = Bench(options.out.resolve(), code_digest(), options.sets, options.seeds)
    if absent := [walk for walk in options.walk if not Path(walk).is_dir()]:
        parser.error(f"no folder: {', '.join(absent)}")
    if options.seeds < 1:
        parser.error("--seeds: at least 1")
    names = [*(options.only or every), *options.walk]
    if len({Path(name).name for name in names}) < len(names):
        parser.error("two sequences of one name")
    print("\n".join(HEAD), flush=True)
    judged = []
    for one in table(bench, names, options.data):
        print(one.line, flush=True)
        judged.append(one)
    foot = [
        summary(judged),
        "",
        "ATE in 1e-3 units of the truth, after Sim(3). Targets: every ATE with a trajectory at "
        f"most {MAX_RATIO} times that without (worst ratio), none above {1e3 * MAX_ATE:g}. Of "
        "medians: median over trajectories by median over seeds. Chance: largest over smallest "
        "ATE without a trajectory of the seeds; a ratio below it is within chance. Numbers "
        "under trajectories are seeds of degradations of the truth.",
        *(["", options.note] if options.note else []),
        *(["", f"With {', '.join(options.sets)}."] if options.sets else []),
    ]
    print("\n".join(["", *foot]))
    lines = [one.line for one in judged]
    head = ["# Open walks with and without a trajectory", "", *HEAD]
    write_table([*head, *lines, "", *foot], options.markdown)
    sys.exit(0 if all(one.held for one in judged) else 1)


if __name__ == "__main__":
    main()
