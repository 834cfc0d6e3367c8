"""Search for false joins: recordings of different flats, merged and refined together, in pairs.

    python benchmarks/false_joins.py --out WORK --markdown benchmarks/results/false_joins.md \
        [--jointly N] [--again FLAT AGAIN]... FLAT...

A FLAT is a folder with `images/` and their timestamps.csv, `groundtruth.tum` and `mask.png`. Its
recording is its first 24 frames. Each is refined once, from a trajectory with drift. Then every two
flats are merged by `gsba merge`, and N pairs, of neighbours in the order given first, are refined
by `gsba refine --recording A --recording B` without trajectories. FLAT and AGAIN are two walks
through one flat: the recording of AGAIN is its frames 13 to 36, which must be joined, so that the
table shows a test that does not refuse everything. Every run is a process of its own; rows are kept
in WORK and used again while code and input stay the same. The exit code is 1 if a map has frames of
two flats, a frame of a map is wrong, a command fails otherwise than by saying that the maps do not
meet, or no pair of one flat is joined.
"""

import argparse
import json
import re
import shutil
import sys
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import code_digest, digest, kept_row, run_row, take_frames, write_table
from scipy.spatial.transform import Rotation

from gsba.demo import degrade
from gsba.disk import write_text
from gsba.evaluate.trajectory import pose_errors
from gsba.geometry import pose
from gsba.similarity import Sim3
from gsba.store.finished import load_run
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory

NUM_FRAMES = 24  # of a recording
AGAIN_FROM = 12  # first frame of a second recording of a flat
MAX_ERROR = 0.03  # of a map's extent, of any of its frames
MIN_FRAMES = 3  # of a map that is checked: fewer can always be aligned to the truth
TIMEOUT_S = 3600.0
_SCALES = (0.4, 0.9, 1.7, 0.6, 1.2, 2.3)  # map units per metre of the trajectories
MEET_NOWHERE = "meet nowhere"  # in the message of `gsba merge` that refuses maps of two places
HEAD = [
    "| recordings | by | frames | maps: frames of each (worst frame, of its extent) | found again, "
    "at its place | CPU s | verdict |",
    "|---|---|---:|---|---:|---:|---|",
]
_SHARES = re.compile(
    r"(\d+) % \(sigma (\d+) %\) of the points expected.*?(-?\d+) % \(sigma (\d+) %\) at their place"
)  # that did not suffice for a join
_GSBA = [sys.executable, "-c", "from gsba.cli import main; main()"]
_SET = ["--allow-partial", "--set", "export.formats=[]"]


class Recording(NamedTuple):
    """A part of a walk through a flat, cut out as a recording."""

    flat: str
    walk: Path  # folder with `images/`, their timestamps.csv, and `groundtruth.tum`
    folder: Path  # of its frames, with timestamps.csv
    rows: np.ndarray  # (R,) frames of the walk

    @property
    def name(self) -> str:
        """Name of its frames' folder."""
        return self.folder.name

    @property
    def trajectory(self) -> Path:
        """TUM, with drift, in a world and scale of its own."""
        return self.folder.with_name(f"{self.name}.tum")

    @property
    def files(self) -> list[Path]:
        """Files that runs read."""
        return [*sorted(self.folder.iterdir()), self.trajectory, self.walk / "mask.png"]


def recording_of(flat: str, walk: Path, first: int, home: Path) -> Recording:
    """Recording of frames from `first` on of a walk, cut into the folder `home`; `first` decides
    world, scale and drift of its trajectory."""
    truth = read_trajectory(walk / "groundtruth.tum")
    num = len((walk / "images/timestamps.csv").read_text().splitlines()) - 1
    rows = np.arange(first, min(first + NUM_FRAMES, num))
    one = Recording(flat, walk, home / f"{walk.name}-from{first}", rows)
    times = truth.timestamps[rows] - truth.timestamps[first]
    take_frames(walk, rows, times, one.folder)
    coarse = degrade(Trajectory(times, truth.world_T_rigs[rows]), first, scale=_SCALES[first % 6])
    turn = Rotation.from_rotvec([0.3, 1.1 * first, -0.2]).as_matrix()
    moved = Sim3.of(1.0, pose(turn, np.array([3.0 * first, -2.0, 5.0])))
    write_tum(one.trajectory, Trajectory(coarse.timestamps, moved.poses(coarse.world_T_rigs)))
    return one


def check_maps(run: Path, recordings: Sequence[Recording]) -> list[dict[str, Any]]:
    """Frames and flats of each map of a run, its worst frame's error, of the map's extent, and why
    it was not joined."""
    report = json.loads((run / "report.json").read_text())
    by_name = {one.name: one for one in recordings}
    checked = []
    for entry in report["maps"]:
        reconstruction, frames = load_run(run, entry["map"])
        names = [name.rpartition("/") for name in frames.names]
        owners = [by_name.get(owner, recordings[0]) for owner, _, _ in names]
        flats = sorted({one.flat for one in owners})
        worst = None
        if len(flats) == 1 and len(names) >= MIN_FRAMES:
            truths = {one.name: read_trajectory(one.walk / "groundtruth.tum") for one in owners}
            pairs = zip(owners, names, strict=True)
            true = np.array([truths[one.name].world_T_rigs[int(name)] for one, (*_, name) in pairs])
            numbers = np.arange(len(true), dtype=np.float64)  # frames may be of several clocks
            estimate = Trajectory(numbers, reconstruction.world_T_rigs)
            errors = pose_errors(estimate, Trajectory(numbers, true)).positions
            worst = float(errors.max() / np.linalg.norm(np.ptp(true[:, :3, 3], axis=0)))
        both = len({one.name for one in owners}) > 1
        found = {"frames": len(names), "flats": flats, "worst": worst, "joined": both}
        checked.append(found | {"apart": entry["reason"]})
    return checked


class Bench(NamedTuple):
    """Folder and code of the rows of one call."""

    out: Path
    code: str

    def alone(self, one: Recording) -> dict[str, Any]:
        """Row of a recording refined alone."""
        words = ["refine", str(one.folder), str(one.trajectory), "--fresh", *_SET]
        return self._row([one], "alone", [*words, "--masks", str(one.walk / "mask.png")])

    def merged(self, one: Recording, other: Recording) -> dict[str, Any]:
        """Row of two runs merged."""
        runs = [str(self.out / "alone" / each.name / "run") for each in (one, other)]
        return self._row([one, other], "merge", ["merge", *runs, "--allow-partial"])

    def jointly(self, one: Recording, other: Recording) -> dict[str, Any]:
        """Row of two recordings in one run, without trajectories."""
        words = ["refine", "--no-trajectory", "--fresh", *_SET]
        for each in (one, other):
            words += ["--recording", f"{each.folder},masks={each.walk / 'mask.png'}"]
        return self._row([one, other], "refine", words)

    def _row(self, recordings: Sequence[Recording], by: str, words: list[str]) -> dict[str, Any]:
        folder = self.out / by / "+".join(one.name for one in recordings)
        files = [path for one in recordings for path in one.files]
        key = {"code": self.code, "input": digest(files)}
        run = folder / "run"
        if (row := kept_row(folder, key, TIMEOUT_S)) and (by != "alone" or run.exists()):
            return row
        print(f"running {folder}", file=sys.stderr, flush=True)
        shutil.rmtree(folder, ignore_errors=True)  # a refused merge would go on where it was

        def finish() -> dict[str, Any]:
            return {"errors": check_maps(run, recordings)}

        row = {"key": key, "by": by, "frames": sum(len(one.rows) for one in recordings)}
        row = run_row([*_GSBA, *words, "--out", str(run)], folder, row, finish, TIMEOUT_S)
        if by == "merge" and MEET_NOWHERE in row.get("reason", ""):
            row["errors"] = []  # a result, not a failure: the row is kept
            write_text(folder / "row.json", json.dumps(row, indent=1))
        if by != "alone":
            shutil.rmtree(run, ignore_errors=True)
        return row


def verdict(row: dict[str, Any]) -> str:
    """Verdict on the maps of a run."""
    if "errors" not in row:
        return f"**failed**: {row['reason']}"
    if any(len(one["flats"]) > 1 for one in row["errors"]):
        return "**false join**"
    if any((one["worst"] or 0.0) > MAX_ERROR for one in row["errors"]):
        return "**wrong map**"
    return "joined" if any(one["joined"] for one in row["errors"]) else "apart"


def line(what: str, row: dict[str, Any]) -> str:
    """Line of the table."""
    maps = [
        f"{one['frames']}" + (f" ({one['worst']:.2%})" if one["worst"] is not None else "")
        for one in row.get("errors", ())
    ]
    cells = [what, row["by"], str(row["frames"]), ", ".join(maps) or "nothing written"]
    reasons = [one["apart"] or "" for one in row.get("errors", ())]
    shares = _SHARES.findall("; ".join([row.get("reason", ""), *reasons]))
    found = "; ".join("{} ± {} %, {} ± {} %".format(*each) for each in shares)
    cells += [found, f"{row['cpu_s']:.0f}", verdict(row)]
    return f"| {' | '.join(cells)} |"


def summary(lines: Sequence[tuple[str, dict[str, Any], bool]]) -> list[str]:
    """Table of the numbers of pairs by command and verdict, of different flats and of one."""
    text = [
        "| pairs of | by | pairs | joined | apart | false joins | wrong maps | failed |",
        "|---|---|---:|---:|---:|---:|---:|---:|",
    ]
    for same, by in ((s, b) for s in (False, True) for b in ("merge", "refine")):
        found = [verdict(row).partition(":")[0] for _, row, one in lines if one == same]
        own = [row["by"] == by for _, row, one in lines if one == same]
        found = [one for one, mine in zip(found, own, strict=True) if mine]
        kinds = ("joined", "apart", "**false join**", "**wrong map**", "**failed**")
        cells = ["one flat" if same else "different flats", f"`{by}`", str(len(found))]
        text.append(f"| {' | '.join([*cells, *(str(found.count(kind)) for kind in kinds)])} |")
    return text


def main() -> None:
    """Parse, run, print; exit with 1 if a map is wrong or nothing true is joined."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("flats", nargs="+", type=Path, metavar="FLAT")
    parser.add_argument(
        "--again", action="append", nargs=2, type=Path, default=[], metavar=("FLAT", "AGAIN")
    )
    parser.add_argument("--jointly", type=int, default=12, metavar="N", help="pairs by refine")
    parser.add_argument("--out", type=Path, default=Path("build/false_joins"), help="kept rows")
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    bench = Bench(options.out.resolve(), code_digest())
    cuts = bench.out / "cuts"
    firsts = [recording_of(one.name, one.resolve(), 0, cuts) for one in options.flats]
    pairs = list(combinations(firsts, 2))
    apart = [n - m for m, n in combinations(range(len(firsts)), 2)]
    chosen = np.argsort(apart, kind="stable")[: options.jointly]
    true = [
        (
            recording_of(flat.name, flat.resolve(), 0, cuts),
            recording_of(flat.name, again.resolve(), AGAIN_FROM, cuts),
        )
        for flat, again in options.again
    ]
    for one in {
        one.name: one for one in (*firsts, *(one for pair in true for one in pair))
    }.values():
        bench.alone(one)
    lines: list[tuple[str, dict[str, Any], bool]] = []
    print("\n".join(HEAD), flush=True)

    def add(pair: tuple[Recording, Recording], row: dict[str, Any], same: bool) -> None:
        what = f"{pair[0].walk.name} + {pair[1].walk.name}"
        lines.append((line(what, row), row, same))
        print(lines[-1][0], flush=True)

    for pair in true:
        add(pair, bench.merged(*pair), True)
        add(pair, bench.jointly(*pair), True)
    for pair in pairs:
        add(pair, bench.merged(*pair), False)
    for n in chosen.tolist():
        add(pairs[n], bench.jointly(*pairs[n]), False)
    foot = (
        f"False join: a map has frames of two flats. Wrong map: a frame is off by more than "
        f"{MAX_ERROR:.0%} of its map's extent after alignment of the map to the truth. "
        "Found again: points expected in both recordings, at the best place that was refused, and "
        "those of them at their place, as shares of a true join's. Recordings: "
        f"{NUM_FRAMES} frames. `merge`: of runs refined alone, from trajectories with drift. "
        "`refine`: both recordings in one run, from images alone."
    )
    found = summary(lines)
    print("\n".join(["", *found, "", foot]))
    head = ["# Are recordings of different places joined?", "", *found, "", foot, "", *HEAD]
    write_table([*head, *(text for text, _, _ in lines)], options.markdown)
    joined = any(verdict(row) == "joined" for _, row, same in lines if same)
    sys.exit(any("**" in verdict(row) for _, row, _ in lines) or bool(true and not joined))


if __name__ == "__main__":
    main()
