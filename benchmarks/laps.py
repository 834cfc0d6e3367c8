"""Cost of a walk that comes back to the same places, lap after lap: n frames, 2n, 4n, ...

    python ../shared/tools/render_long.py WALK -n 800          (needs open3d)
    python -m benchmarks.laps WALK --out WORK [--frames 200 400 800] [--markdown FILE]

Each row is a whole run (`gsba refine`, no dataset) of the walk's first frames from a spoiled
trajectory whose steps are as good at any length: drift grows as the root of the path. CPU seconds
are the stages' own, of the run's report; "solving" is what grows with the places' visits:
`closed`, `refined`, `aligned`, `reconstruction`.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from benchmarks.common import measure, refine_command, write_table
from gsba.demo.degrade import degrade
from gsba.evaluate import evaluate
from gsba.trajectory import read_trajectory, write_tum
from gsba.types import Trajectory

GROUPS = {
    "solving": ("closed", "refined", "aligned", "reconstruction"),
    "features, matching": (
        "features", "keypoints", "neighbours", "adjacent", "near", "loops", "everywhere"
    ),
    "patches": ("align",),
}  # fmt: skip
DRIFT_OF = 200  # frames of a walk whose drift is that of `degrade`


def cut(walk: Path, num: int, folder: Path, seed: int) -> tuple[Path, Path, Path]:
    """The first frames of a walk as links, their spoiled trajectory, and the truth."""
    images = folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    header, *rows = (walk / "images/timestamps.csv").read_text().splitlines()
    for row in rows[:num]:
        name = f"{row.partition(',')[0]}.jpg"
        if not (images / name).exists():
            (images / name).symlink_to((walk / "images" / name).resolve())
    (images / "timestamps.csv").write_text("\n".join([header, *rows[:num], ""]))
    whole = read_trajectory(walk / "groundtruth.tum")
    truth = Trajectory(whole.timestamps[:num], whole.world_T_rigs[:num])
    write_tum(folder / "truth.tum", truth)
    growth = np.sqrt(num / DRIFT_OF)
    spoiled = degrade(
        truth,
        seed,
        rotation_drift_deg=2.0 * growth,
        translation_drift=0.015 / growth,  # of the path's length
        scale_drift=0.02 * growth,
        num_jumps=2,
        num_lost=num // 50,
    )
    write_tum(folder / "slam.tum", spoiled)
    return images, folder / "slam.tum", folder / "truth.tum"


def group(stage: str) -> str:
    """What a stage counts to."""
    name = stage.rstrip("0123456789")
    return next((title for title, names in GROUPS.items() if name in names), "other")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("walk", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--frames", type=int, nargs="+", default=[200, 400, 800])
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--timeout", type=float, default=7200)
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    titles = [*GROUPS, "other"]
    lines = [
        f"| frames | CPU s | a frame | {' | '.join(titles)} | wall s | peak MB | ATE |",
        f"|---|---|---|{'---|' * len(titles)}---|---|---|",
    ]
    for num in options.frames:
        images, slam, truth = cut(options.walk, num, options.out / f"{num}", options.seed)
        run = options.out / f"{num}/run"
        command = refine_command(images, run, [str(slam)])
        cost = measure(command, options.out / f"{num}.log", options.timeout)
        if cost.exit_code:
            sys.exit(f"{num} frames: see {options.out / f'{num}.log'}")
        cpu = dict.fromkeys(titles, 0.0)
        for stage in json.loads((run / "report.json").read_text())["stages"]:
            cpu[group(stage["name"])] += stage["cpu_seconds"]
        error = evaluate(read_trajectory(run / "trajectory.tum"), read_trajectory(truth))
        lines.append(
            f"| {num} | {cost.cpu_s:.0f} | {cost.cpu_s / num:.2f} | "
            + " | ".join(f"{cpu[title]:.0f}" for title in titles)
            + f" | {cost.wall_s:.0f} | {cost.peak_mb:.0f} | {error.ate.rmse:.4f} |"
        )
        print(lines[-1], flush=True)
    write_table(lines, options.markdown)


if __name__ == "__main__":
    main()
