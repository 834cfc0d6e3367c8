"""Search for wrong maps: walks through ambiguous places, with every map of every run checked.

    python benchmarks/wrong_maps.py --out WORK --markdown benchmarks/results/wrong_maps.md \
        WALK... WALK:0-27,31-53

A WALK is a folder with `images/` and their timestamps.csv, `groundtruth.tum` and perhaps a mask:
white-walled flats, similar rooms, dim rooms. WALK:A-B,C-D takes only these frames of it, A to B - 1
and C to D - 1: a video that was paused. A-B/K takes every K-th of them: frames far apart. Each is
refined without a trajectory and from one with drift and jumps. All maps of a run are aligned to the
truth, each by itself: a map is wrong if the error of one of its frames exceeds 3 % of the map's
extent. Left-out frames and several maps are not wrong. Every run is a separate process; rows are
kept in WORK and used again while code, options and input stay the same. The exit code is 1 if a map
is wrong.
"""

import argparse
import json
import re
import shutil
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import (
    code_digest,
    digest,
    kept_row,
    refine_command,
    run_row,
    take_frames,
    write_table,
)

from gsba.demo import degrade
from gsba.evaluate.trajectory import pose_errors
from gsba.store.finished import load_run
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory

MAX_ERROR = 0.03  # of a map's extent, of any of its frames
MIN_FRAMES = 3  # of a map that is checked: fewer can always be aligned to the truth
TIMEOUT_S = 3600.0
HEAD = [
    "| walk | frames | start | in the exported map | other maps | ATE 1e-3 | worst frame, of the "
    "extent | rel. rotation ° | CPU s | verdict |",
    "|---|---:|---|---:|---|---:|---:|---:|---:|---|",
]


class CheckedMap(NamedTuple):
    """Errors of one map of a run."""

    frames: int
    ate: float  # truth units
    worst: float  # largest error of a frame's position, of the map's extent
    rotation_deg: float  # rms error of the steps between neighbouring frames, degrees


def check_maps(run: Path, truth: Trajectory) -> list[CheckedMap]:
    """Checked maps of a run, the exported one first.

    Raises:
        GsbaError: all positions of a map coincide.
    """
    report = json.loads((run / "report.json").read_text())
    checked = []
    for entry in report["maps"]:
        if entry["frames"] >= MIN_FRAMES:
            reconstruction, frames = load_run(run, entry["map"])
            checked.append(
                _check(Trajectory(frames.timestamps, reconstruction.world_T_rigs), truth)
            )
    return checked


def _check(poses: Trajectory, truth: Trajectory) -> CheckedMap:
    found = pose_errors(poses, truth)
    true_T_rigs, world_T_rigs = truth.world_T_rigs[found.true_rows], poses.world_T_rigs[found.rows]
    extent = float(np.linalg.norm(np.ptp(true_T_rigs[:, :3, 3], axis=0)))
    steps = np.flatnonzero(np.diff(found.true_rows) == 1)
    angles = [_turn(world_T_rigs, n) @ _turn(true_T_rigs, n).T for n in steps.tolist()]
    cosines = [np.clip((np.trace(turn) - 1) / 2, -1, 1) for turn in angles]
    rms = float(np.sqrt(np.mean(np.arccos(cosines) ** 2))) if len(steps) else np.nan
    ate = float(np.sqrt(np.mean(found.positions**2)))
    return CheckedMap(len(found.rows), ate, float(found.positions.max()) / extent, np.rad2deg(rms))


def _turn(poses: np.ndarray, n: int) -> np.ndarray:
    return poses[n, :3, :3].T @ poses[n + 1, :3, :3]


class Bench(NamedTuple):
    """Folder and conditions of the rows of one call."""

    out: Path
    code: str
    sets: list[str]  # KEY=VALUE of every run
    seeds: list[int]  # of the spoiled trajectories

    def rows(self, walk: Path) -> list[dict[str, Any]]:
        """Rows of a walk: without a trajectory, then from each spoiled one."""
        home = self.out / walk.name
        home.mkdir(parents=True, exist_ok=True)
        truth = read_trajectory(walk / "groundtruth.tum")
        rows = [self._row(walk, home / "none", truth, ["--no-trajectory"], [])]
        for seed in self.seeds:
            start = home / f"{seed}.tum"
            write_tum(start, degrade(truth, seed))
            rows.append(self._row(walk, home / f"from{seed}", truth, [str(start)], [start]))
        return rows

    def _row(
        self, walk: Path, home: Path, truth: Trajectory, options: list[str], files: list[Path]
    ) -> dict[str, Any]:
        files = [*sorted((walk / "images").iterdir()), walk / "groundtruth.tum", *files]
        key = {"code": self.code, "input": digest(files), "sets": self.sets}
        if row := kept_row(home, key, TIMEOUT_S):
            return row
        print(f"running {home}", file=sys.stderr, flush=True)
        options = [*options, *(word for one in self.sets for word in ("--set", one))]

        def finish() -> dict[str, Any]:
            maps = check_maps(home / "run", truth)
            return {"errors": [one._asdict() for one in maps]}

        command = refine_command(walk / "images", home / "run", options)
        row = {"key": key, "start": home.name, "frames": len(truth.timestamps)}
        return run_row(command, home, row, finish, TIMEOUT_S)


def paused(text: str, out: Path) -> Path:
    """Folder of a walk; of WALK:A-B,C-D/K a copy with these frames only."""
    name, _, spans = text.partition(":")
    walk = Path(name).resolve()
    if not spans:
        return walk
    home = (out / f"{walk.name}_{spans.replace(',', '_').replace('/', 'by')}").resolve()
    shutil.rmtree(home, ignore_errors=True)
    ends = [tuple(map(int, re.split("[-/]", f"{span}/1")[:3])) for span in spans.split(",")]
    rows = np.concatenate([np.arange(*each) for each in ends])
    truth = read_trajectory(walk / "groundtruth.tum")
    kept = Trajectory(truth.timestamps[rows], truth.world_T_rigs[rows])
    take_frames(walk, rows, kept.timestamps, home / "images")
    write_tum(home / "groundtruth.tum", kept)
    if (walk / "mask.png").exists():
        shutil.copy(walk / "mask.png", home)
    return home


def is_wrong(row: dict[str, Any]) -> bool:
    """True if a run has a wrong map."""
    return any(one["worst"] > MAX_ERROR for one in row.get("errors", ()))


def line(walk: str, row: dict[str, Any]) -> str:
    """Line of the table for a run."""
    cells = [walk, str(row["frames"]), row["start"]]
    cost = f"{row['cpu_s']:.0f}"
    if not row.get("errors"):
        verdict = f"refused: {row.get('reason', 'no map of three frames')}"
        return f"| {' | '.join([*cells, '', '', '', '', '', cost, verdict])} |"
    first, *others = row["errors"]
    verdict = "**wrong**" if is_wrong(row) else "right"
    cells += [
        str(first["frames"]),
        ", ".join(f"{one['frames']} ({1e3 * one['ate']:.1f})" for one in others),
        f"{1e3 * first['ate']:.2f}",
        f"{100 * max(one['worst'] for one in row['errors']):.2f} %",
        f"{first['rotation_deg']:.4f}",
        cost,
        verdict,
    ]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Parse, run, print; exit with 1 if a map is wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("walks", nargs="+", metavar="WALK")
    parser.add_argument("--set", action="append", default=[], dest="sets", metavar="KEY=VALUE")
    parser.add_argument(
        "--seed", action="append", type=int, help="seeds of the trajectories' errors"
    )
    parser.add_argument("--out", type=Path, default=Path("build/wrong_maps"), help="kept rows")
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    bench = Bench(options.out.resolve(), code_digest(), options.sets, options.seed or [101])
    print("\n".join(HEAD), flush=True)
    lines, rows = [], []
    for walk in (paused(text, bench.out / "walks") for text in options.walks):
        for row in bench.rows(walk):
            rows.append(row)
            lines.append(line(walk.name, row))
            print(lines[-1], flush=True)
    foot = (
        f"Wrong: a frame of a map is off by more than {MAX_ERROR:.0%} of that map's extent after "
        "alignment of that map to the truth. Other maps: frames of each (its ATE, 1e-3). Start: "
        "none = without a trajectory; from101 = from the truth, spoiled with seed 101."
    )
    print("\n" + foot)
    write_table(["# Is any exported map wrong?", "", *HEAD, *lines, "", foot], options.markdown)
    sys.exit(any(map(is_wrong, rows)))


if __name__ == "__main__":
    main()
