"""Error rates of the verdict: maps of known truth that it calls good, and good ones that it doubts.

    python benchmarks/verdict.py --out WORK [--shift FRAMES] WALK...
    python benchmarks/verdict.py --out WORK --markdown benchmarks/results/verdict.md \
        [--judge RUN=TRUTH...]

Parts of each WALK (a folder with truth, see `wrong_maps.py`) are refined: short and long steps,
small, noisy, dim and blurred pictures, without a trajectory, from good, drifting and broken ones.
Runs that are finished stay; a stopped call goes on. Without a WALK nothing is refined: each
finished run in WORK, and each RUN, is judged from what its folder holds, and compared with the
truth. So limits are set by data, without refining again. --shift gives other parts and seeds than
those that limits were chosen on.
"""

import argparse
import json
import math
import re
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from common import refine_command, write_table
from scipy.stats import beta

from gsba.demo import degrade
from gsba.demo.degrade import Drift
from gsba.evaluate.trajectory import pose_errors
from gsba.report.maps import MIN_SHARE_IN_ONE_MAP
from gsba.report.verdict import MAX_POSITION_ERROR, Level, judge
from gsba.store.finished import load_run
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory

TIMEOUT_S = 900.0
FOOT = """
Off: the worst frame of the exported map is further than 1 % of the map's extent from the truth,
after the best similarity. Right: it is not, and nine tenths of the frames are in the map. Below:
95 % upper bound of the rate.

*Every frame*, *every second* and *every third frame* are parts of 12 to 14 frames of rendered walks
(halls of Sponza, a flat, the demo's gallery), 512 pixels wide. *Turns by hand* are cameras turned
at arm's length or moved by a hand's breadth, refined by earlier code, which refused fewer of them;
*whole walks* are runs of earlier days. Parts of one walk overlap, and runs of one walk from other
trajectories are alike: rates are less certain than their bounds. The limits were chosen on the
first 184 of 248 runs.
"""
EVERY = {1: "every frame", 2: "every second frame", 3: "every third frame"}
_UNSHOWN = (
    "no image shows",
    "hardly any matches",
)  # reasons: what the run started from is believed
STARTS = {  # arguments of `degrade`; none = no trajectory
    "none": None,
    "good": {},
    "drifting": {"drift": Drift(8.0, 0.08, 0.1)},
    "broken": {"num_jumps": 3, "num_lost": 3},
    "wrong": {"drift": Drift(20.0, 0.2, 0.3), "jitter": 0.05},
}


class Case(NamedTuple):
    """A part of a walk as it is photographed, and what the run starts from."""

    walk: str  # name of its folder
    first: int  # frame
    end: int  # frame after the last
    every: int = 1  # frames from one to the next
    start: str = "none"
    seed: int = 101  # of the trajectory's errors and of the pictures' noise
    width: int = 512  # pixels
    noise: float = 0.0  # standard deviation, grey values
    blur: float = 0.0  # standard deviation, pixels
    contrast: float = 1.0

    @property
    def name(self) -> str:
        """Folder of the case."""
        spoiled = f"n{self.noise:g}b{self.blur:g}c{self.contrast:g}w{self.width}"
        part = f"{self.walk}_{self.first}-{self.end}by{self.every}"
        return f"{part}_{self.start}{self.seed}_{spoiled}"

    def write(self, walk: Path, home: Path) -> list[str]:
        """Write pictures, truth and start into a folder; give the options of `refine`."""
        truth, rng = read_trajectory(walk / "groundtruth.tum"), np.random.default_rng(self.seed)
        images = sorted(path for path in (walk / "images").iterdir() if path.suffix != ".csv")
        rows = np.arange(self.first, min(self.end, len(images)), self.every)
        (home / "images").mkdir(parents=True, exist_ok=True)
        for path in (images[row] for row in rows):
            cv2.imwrite(str(home / "images" / f"{path.stem}.jpg"), self._spoiled(path, rng))
        kept = Trajectory(truth.timestamps[rows], truth.world_T_rigs[rows])
        names = [
            f"{images[r].stem}.jpg,{t:.6f}" for r, t in zip(rows, kept.timestamps, strict=True)
        ]
        (home / "images/timestamps.csv").write_text("\n".join(["name,timestamp", *names, ""]))
        write_tum(home / "truth.tum", kept)
        wrong, options = STARTS[self.start], list[str]()
        if (walk / "mask.png").exists():
            mask = cv2.imread(str(walk / "mask.png"), cv2.IMREAD_GRAYSCALE)
            size = (self.width, self.width // 2)
            mask = cv2.resize(np.asarray(mask), size, interpolation=cv2.INTER_NEAREST)
            cv2.imwrite(str(home / "mask.png"), mask)
            options = ["--masks", str(home / "mask.png")]
        if wrong is None:
            return [*options, "--no-trajectory"]
        write_tum(home / "start.tum", degrade(kept, self.seed, **wrong))
        return [str(home / "start.tum"), *options]

    def _spoiled(self, path: Path, rng: np.random.Generator) -> np.ndarray:
        image = cv2.imread(str(path))
        assert image is not None
        image = cv2.resize(image, (self.width, self.width // 2), interpolation=cv2.INTER_AREA)
        pixels = np.asarray(image, np.float64)
        if self.blur:
            pixels = cv2.GaussianBlur(pixels, (0, 0), self.blur)
        pixels = (
            128 + self.contrast * (pixels - 128) + self.noise * rng.standard_normal(pixels.shape)
        )
        return np.clip(np.round(pixels), 0, 255).astype(np.uint8)


def cases(lengths: Mapping[str, int], shift: int = 0) -> Iterator[Case]:
    """All cases, those that differ most first: a stopped call leaves a fair sample.

    Args:
        lengths: numbers of frames of the walks.
        shift: frames by which parts begin later, and added to all seeds.
    """
    for n in range(12):
        for walk, num in lengths.items():
            first, seed = (11 * n + shift) % max(num - 28, 1), 101 + n + shift
            early, spoiled = n < 4, dict[str, Any]()  # the hardest pictures come first
            if n % 4 == 0:
                yield Case(walk, first, first + 12, 1, "none", seed)
                if early:
                    yield Case(walk, first % 12, first % 12 + 36, 3, "good", seed)
                else:
                    yield Case(walk, first, first + 28, 2, "drifting", seed)
            elif n % 4 == 1:
                noise = 8.0 if early else 4.0
                yield Case(walk, first, first + 12, 1, "broken", seed, noise=noise)
                yield Case(walk, first % 12, first % 12 + 36, 3, "drifting", seed)
            elif n % 4 == 2:
                spoiled |= {"blur": 2.0, "contrast": 0.3} if early else {"contrast": 0.6}
                yield Case(walk, first, first + 12, 1, "good", seed, **spoiled)
                yield Case(walk, first, first + 28, 2, "none", seed)
            else:
                spoiled |= {"blur": 4.0, "contrast": 0.1, "noise": 3} if early else {"blur": 1.0}
                yield Case(walk, first, first + 12, 1, "wrong", seed, **spoiled)
                yield Case(walk, first, first + 24, 2, "broken", seed)


def run_all(walks: Sequence[Path], out: Path, shift: int) -> None:
    """Refine the cases that are not finished; `shift` as in `cases`."""
    folders = {walk.name: walk for walk in walks}
    lengths = {
        name: len(list((walk / "images").glob("*.[jp]*g"))) for name, walk in folders.items()
    }
    for case in cases(lengths, shift):
        home = out / case.name
        if (home / "log.txt").exists():
            continue
        options = case.write(folders[case.walk], home)
        command = refine_command(home / "images", home / "run", options)
        print(case.name, flush=True)
        with (home / "running.txt").open("w") as log:
            try:
                code = subprocess.run(
                    command, stdout=log, stderr=log, timeout=TIMEOUT_S, check=False
                ).returncode
            except subprocess.TimeoutExpired:
                code = 124
            print(f"exit code {code}", file=log)
        (home / "running.txt").rename(home / "log.txt")


class Judged(NamedTuple):
    """A run of known truth, and the verdict on it."""

    name: str
    group: str  # of cases that are counted together
    error: float  # of the worst frame's position after the best similarity, of the extent; NaN = no
    # map was written
    whole: bool  # nine tenths of the frames and more are in the exported map
    level: str  # of the verdict
    tests: tuple[str, ...]  # first words of the reasons
    bound: float  # position error that the verdict states, of the extent

    @property
    def off(self) -> bool:
        """True if the exported map is off by more than a hundredth of its extent."""
        return self.error > MAX_POSITION_ERROR


def judged(name: str, group: str, run: Path, truth: Path) -> Judged:
    """Verdict on a finished run by today's limits, beside the truth."""
    if not (run / "report.json").exists():
        return Judged(name, group, math.nan, False, "refused", (), math.nan)
    report = json.loads((run / "report.json").read_text())
    main, shown = load_run(run)
    verdict, true = judge(report, main, shown), read_trajectory(truth)
    error = math.nan
    if len(main.points_world):
        found = pose_errors(Trajectory(shown.timestamps, main.world_T_rigs), true)
        positions = true.world_T_rigs[found.true_rows, :3, 3]
        error = float(found.positions.max() / np.linalg.norm(np.ptp(positions, axis=0)))
    share = len(shown) / report["summary"]["frames"]
    tests = tuple(" ".join(one.cause.split()[:3]) for one in verdict.reasons)
    whole = share >= MIN_SHARE_IN_ONE_MAP
    bound = verdict.figures.position_error
    return Judged(name, group, error, whole, verdict.level.value, tests, bound)


def all_judged(out: Path, others: Sequence[str]) -> Iterator[Judged]:
    """Verdicts on the cases that are finished, and on other runs given as RUN=TRUTH."""
    for log in sorted(out.glob("*/log.txt")):
        home, every = log.parent, re.search(r"by(\d)_", log.parent.name)
        group = "photographs of a flat" if every is None else EVERY[int(every[1])]
        yield judged(home.name, group, home / "run", home / "truth.tum")
    for one in others:
        run, _, truth = one.rpartition("=")
        group = "turns by hand" if "turn" in Path(truth).name else "whole walks"
        yield judged(Path(run).name, group, Path(run), Path(truth))


def table(rows: Sequence[Judged]) -> list[str]:
    """Counts of verdicts by what the maps are, and the two error rates."""
    kinds = {
        "off": lambda row: row.off,
        "right": lambda row: row.error <= MAX_POSITION_ERROR and row.whole,
        "right, but less than nine tenths of the frames": lambda row: (
            row.error <= MAX_POSITION_ERROR and not row.whole
        ),
        "rotations only, or refused by the run": lambda row: math.isnan(row.error),
    }
    levels = [level.value for level in Level]
    lines = [
        f"| runs | map | number | {' | '.join(levels)} |",
        f"|---|---|---:|{'---:|' * len(levels)}",
    ]
    for group in [*dict.fromkeys(row.group for row in rows), "all"]:
        own = [row for row in rows if group in (row.group, "all")]
        for kind, holds in kinds.items():
            found = [row for row in own if holds(row)]
            counts = [sum(row.level == level for row in found) for level in levels]
            if found:
                lines.append(
                    f"| {group} | {kind} | {len(found)} | {' | '.join(map(str, counts))} |"
                )
    off = [row for row in rows if kinds["off"](row)]
    right = [row for row in rows if kinds["right"](row)]
    passed = sum(row.level == Level.GOOD for row in off)
    doubted = sum(row.level != Level.GOOD for row in right)
    lines += ["", f"Called good though off: {_rate(passed, len(off))}."]
    lines += [f"Doubted though right: {_rate(doubted, len(right))}."]
    shown = [row for row in right if not any(test.startswith(_UNSHOWN) for test in row.tests)]
    doubted = sum(row.level != Level.GOOD for row in shown)
    lines += [f"Of these, where images show every step: {_rate(doubted, len(shown))}.", ""]
    ratios = np.array([row.error / row.bound for row in right if row.bound > 0])
    beyond = int(np.count_nonzero(ratios > 1))
    lines.append(
        "Positions of right maps that are further off than the verdict says they may be: "
        f"{_rate(beyond, len(ratios))}; median of error over stated error {np.median(ratios):.2f}."
    )
    return lines


def _rate(count: int, num: int) -> str:
    """A count, its share, and the 95 % upper bound of the rate (Clopper and Pearson)."""
    upper = 1.0 if count == num else float(beta.ppf(0.95, count + 1, num - count))
    return f"{count} of {num} ({100 * count / max(num, 1):.1f} %; below {100 * upper:.1f} %)"


def mistakes(rows: Sequence[Judged]) -> list[str]:
    """Lines on each run whose verdict is wrong."""
    right = [row for row in rows if row.error <= MAX_POSITION_ERROR and row.whole]
    wrong = [row for row in right if row.level != Level.GOOD]
    wrong += [row for row in rows if row.off and row.level == Level.GOOD]
    lines = ["| run | worst frame, of the extent | stated | verdict | reasons |"]
    lines += ["|---|---:|---:|---|---|"]
    for row in wrong:
        cells = [row.name, f"{100 * row.error:.2f} %", f"{100 * row.bound:.2f} %", row.level]
        lines.append(f"| {' | '.join([*cells, '; '.join(row.tests)])} |")
    return lines if len(lines) > 2 else ["None."]


def main() -> None:
    """Run, or judge what was run."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("walks", nargs="*", type=Path, metavar="WALK")
    parser.add_argument("--out", type=Path, default=Path("build/verdict"))
    parser.add_argument("--shift", type=int, default=0, metavar="FRAMES")
    parser.add_argument("--judge", nargs="*", default=[], metavar="RUN=TRUTH")
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    if options.walks:
        run_all([walk.absolute() for walk in options.walks], options.out.resolve(), options.shift)
        return
    rows = list(all_judged(options.out, options.judge))
    lines = table(rows)
    lines = ["# Error rates of the verdict", "", *lines]
    lines += [FOOT, "## Wrong verdicts", "", *mistakes(rows)]
    print("\n".join(lines))
    write_table(lines, options.markdown)


if __name__ == "__main__":
    main()
