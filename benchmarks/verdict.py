"""Error rates of the verdict: maps of known truth that it calls good, and good ones that it doubts.

    python benchmarks/verdict.py --data DATA --out WORK --run [WALK...]
    python benchmarks/verdict.py --out WORK --markdown benchmarks/results/verdict.md [RUN=TRUTH...]

With --run, parts of walks with truth (folders of DATA or WALKs, see `wrong_maps.py`) are refined:
short and long steps, small, noisy, dim and blurred pictures, without a trajectory, from good,
drifting and broken ones. Runs that are finished stay; a stopped call goes on. Without it, nothing
is refined: each finished run in WORK, and each RUN beside its TRUTH, is judged again from what its
folder holds, and compared with the truth. So limits can be set by data.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from common import refine_command

from gsba.demo import degrade
from gsba.demo.degrade import Drift
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory

TIMEOUT_S = 900.0
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
        names = [f"{images[r].stem}.jpg,{t:.6f}" for r, t in zip(rows, kept.timestamps, strict=True)]
        (home / "images/timestamps.csv").write_text("\n".join(["name,timestamp", *names, ""]))
        write_tum(home / "truth.tum", kept)
        wrong = STARTS[self.start]
        if wrong is None:
            return ["--no-trajectory"]
        write_tum(home / "start.tum", degrade(kept, self.seed, **wrong))
        return [str(home / "start.tum")]

    def _spoiled(self, path: Path, rng: np.random.Generator) -> np.ndarray:
        image = cv2.imread(str(path))
        assert image is not None
        image = cv2.resize(image, (self.width, self.width // 2), interpolation=cv2.INTER_AREA)
        pixels = np.asarray(image, np.float64)
        if self.blur:
            pixels = cv2.GaussianBlur(pixels, (0, 0), self.blur)
        pixels = 128 + self.contrast * (pixels - 128) + self.noise * rng.standard_normal(pixels.shape)
        return np.clip(np.round(pixels), 0, 255).astype(np.uint8)


def cases() -> Iterator[Case]:
    """All cases, those that differ most first: a stopped call leaves a fair sample."""
    halls = {"aisle_loop": 60, "gallery_forward": 48, "two_lens": 60, "aisle_slam": 60}
    halls |= {"two_lens_stabilised": 60}
    for n in range(12):
        for walk, num in halls.items():
            first, seed = (11 * n) % (num - 28), 101 + n
            if n % 4 == 0:
                yield Case(walk, first, first + 12, 1, "none", seed)
                yield Case(walk, first % 12, first % 12 + 36, 3, "good", seed)
            elif n % 4 == 1:
                yield Case(walk, first, first + 12, 1, "broken", seed, noise=8.0)
                yield Case(walk, first % 12, first % 12 + 36, 3, "drifting", seed)
            elif n % 4 == 2:
                yield Case(walk, first, first + 12, 1, "good", seed, blur=2.0, contrast=0.3)
                yield Case(walk, first, first + 28, 2, "none", seed)
            else:
                yield Case(walk, first, first + 12, 1, "wrong", seed, blur=4.0, contrast=0.1, noise=3)
                yield Case(walk, first, first + 24, 2, "broken", seed)


def run_all(data: Path, out: Path) -> None:
    """Refine the cases that are not finished."""
    for case in cases():
        home = out / case.name
        if (home / "log.txt").exists():
            continue
        options = case.write(data / case.walk, home)
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


def main() -> None:
    """Run, or judge what was run."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path)
    parser.add_argument("--out", type=Path, default=Path("build/verdict"))
    options = parser.parse_args()
    run_all(options.data.resolve(), options.out.resolve())


if __name__ == "__main__":
    main()
