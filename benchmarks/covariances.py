"""Consistency of pose covariances: errors over sigma and NEES, on sequences with a truth.

    python benchmarks/covariances.py --out WORK --markdown benchmarks/results/covariances.md

Refines each sequence (a finished run in WORK is used again) and prints the statistics of
`gsba.evaluate.consistency`. Open walks are the first part of closed ones, and the demo's.
Recorded sequences are read from `--data` and skipped if absent; `--walk FILE.tum` is a trajectory
of your own, beside `images/` and `groundtruth.tum`.
"""

import argparse
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from common import Case, cut_short, write_table

from gsba import refine
from gsba.config import RefineSettings
from gsba.demo import make_walk
from gsba.demo.walk import Heading, WalkPath
from gsba.evaluate.consistency import Consistency, Statistic, consistency_of
from gsba.evaluate.trajectory import evaluate
from gsba.log import GsbaError
from gsba.store.finished import load_run
from gsba.trajectory.files import read_trajectory
from gsba.types import Trajectory

DATA = Path(__file__).resolve().parents[2] / "shared/data"
WANTED = 0.7, 1.5  # error over sigma


class Recorded(NamedTuple):
    """Sequence of the data folder, whole or its first frames."""

    folder: str
    trajectory: str = "slam.tum"
    num_frames: int | None = None


RECORDED = {
    "aisle_loop": Recorded("aisle_loop"),
    "gallery_forward": Recorded("gallery_forward"),
    "aisle_slam, real SLAM": Recorded("aisle_slam", "frame_trajectory.txt"),
    "aisle_loop, 40 frames": Recorded("aisle_loop", num_frames=40),
    "gallery_forward, 32 frames": Recorded("gallery_forward", num_frames=32),
}
DEMOS: dict[str, tuple[WalkPath, Heading]] = {
    "demo rectangle": ("rectangle", "locked"),
    "demo oval": ("oval", "forward"),
    "demo open": ("open", "forward"),
}


def find(name: str, data: Path, out: Path) -> Case:
    """Inputs of a sequence; GsbaError if it is not on this machine."""
    if name in DEMOS:
        folder = out / "walk"
        if not (folder / "groundtruth.tum").exists():
            make_walk(folder, *DEMOS[name])
        return Case(folder / "images", folder / "slam.tum", folder / "groundtruth.tum")
    own = Recorded(*os.path.split(name))  # data / an absolute path is that path
    chosen = RECORDED.get(name, own)
    folder = data / chosen.folder
    if not folder.is_dir():
        raise GsbaError(f"{folder} is absent")
    case = Case(folder / "images", folder / chosen.trajectory, folder / "groundtruth.tum")
    return case if chosen.num_frames is None else cut_short(case, chosen.num_frames, out / "cut")


def measured(case: Case, out: Path) -> tuple[Consistency, float]:
    """Consistency of a run's covariances, and its ATE in units of the truth."""
    settings = RefineSettings.model_validate({"export": {"formats": []}})
    refine(case.images, case.trajectory, out, settings)
    reconstruction, frames = load_run(out)
    truth = read_trajectory(case.truth)
    found = consistency_of(reconstruction, frames.timestamps, truth)
    whole = Trajectory(frames.timestamps, reconstruction.world_T_rigs)
    return found, evaluate(whole, truth).ate.rmse


def table(names: list[str], data: Path, out: Path) -> Iterator[str]:
    """Lines of the table."""
    yield "| sequence | ATE e-3 | poses | rotation error/σ | position error/σ | NEES |"
    yield "|---|---|---|---|---|---|"
    for given in names:
        name = "/".join(Path(given).parts[-2:])
        folder = out / re.sub(r"\W+", "_", name)
        try:
            found, ate = measured(find(given, data, folder), folder / "run")
        except GsbaError as error:
            yield f"| {name} | | | | | {error} |"
            continue
        head = f"{name} | {1e3 * ate:.2f}"
        for kind, claims in (("absolute", found.absolute), ("consecutive", found.consecutive)):
            if claims is None:
                continue
            cells = [_cell(claims.rotation), _cell(claims.position), _cell(claims.nees, False)]
            yield f"| {head} | {claims.num} {kind} | {' | '.join(cells)} |"
            head = " | "


def _cell(one: Statistic, wanted: bool = True) -> str:
    """Statistic with its interval; bold if it is outside of the target range."""
    right = WANTED[0] <= one.value <= WANTED[1] if wanted else one.expected
    value = f"{one.value:.2f}" if right else f"**{one.value:.2f}**"
    return f"{value} ({one.low:.2f} to {one.high:.2f})"


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    every = [*RECORDED, *DEMOS]
    parser.add_argument("--data", type=Path, default=DATA, help="recorded sequences")
    parser.add_argument("--only", action="append", choices=every, help="repeatable")
    parser.add_argument("--walk", action="append", default=[], type=os.path.abspath)
    parser.add_argument("--out", type=Path, default=Path("build/covariances"))
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    names = [*(options.only or ([] if options.walk else every)), *options.walk]
    lines = []
    for line in table(names, options.data, options.out):
        print(line, flush=True)
        lines.append(line)
    head = ["# Errors over what covariances claim", ""]
    foot = [
        "",
        f"Bold: outside {WANTED[0]} to {WANTED[1]}, or NEES outside its interval. In brackets what",
        "95 % of errors drawn from the joint covariance of all poses would give.",
    ]
    write_table([*head, *lines, *foot], options.markdown)


if __name__ == "__main__":
    main()
