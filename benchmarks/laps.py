"""Cost of a walk of several laps through the same places: n frames, 2n, 4n, ...

    python ../shared/tools/render_long.py WALK -n 800          (needs open3d)
    python -m benchmarks.laps WALK --out WORK [--frames 200 400 800] [--markdown FILE]
        [--enlarged 8192] [--export colmap]

Each row is a whole run of `gsba refine` over the walk's first frames, from a trajectory whose drift
grows with the root of the path. CPU seconds are those of stages in the run's report; "solving" are
the stages whose cost grows with the visits of each place: `closed`, `refined`, `aligned`,
`reconstruction`. Enlarged frames are files of that width with their own noise: their cost is
realistic, their detail is not.
"""

import argparse
import json
import sys
from pathlib import Path

import cv2
import numpy as np

from benchmarks.common import measure, refine_command, write_table
from gsba.demo.degrade import Drift, degrade
from gsba.evaluate import evaluate
from gsba.export import ExportFormat
from gsba.trajectory import read_trajectory, write_tum
from gsba.types import Trajectory

GROUPS = {
    "solving": ("closed", "refined", "aligned", "reconstruction"),
    "features, matching": (
        "features", "keypoints", "neighbours", "adjacent", "near", "loops", "everywhere"
    ),
    "patches": ("align",),
}  # fmt: skip
NOISE_GREY = 2.0  # standard deviation, of enlarged frames
DRIFT_OF = 200  # frames of a walk with the default drift of `degrade`


def cut(
    walk: Path, num: int, folder: Path, seed: int, width: int | None = None
) -> tuple[Path, Path, Path]:
    """First frames of a walk as links or enlarged, their trajectory with drift, and the truth."""
    images = folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    header, *rows = (walk / "images/timestamps.csv").read_text().splitlines()
    noise = camera_noise(width, seed) if width else None
    for n, row in enumerate(rows[:num]):
        name = Path(row.partition(",")[0]).with_suffix(".jpg").name
        if (images / name).exists():
            continue
        if noise is None:
            (images / name).symlink_to((walk / "images" / name).resolve())
        else:
            enlarge(walk / "images" / name, images / name, np.roll(noise, 37 * n, axis=1))
    (images / "timestamps.csv").write_text("\n".join([header, *rows[:num], ""]))
    whole = read_trajectory(walk / "groundtruth.tum")
    truth = Trajectory(whole.timestamps[:num], whole.world_T_rigs[:num])
    write_tum(folder / "groundtruth.tum", truth)
    growth = np.sqrt(num / DRIFT_OF)
    spoiled = degrade(
        truth,
        seed,
        drift=Drift(2.0 * growth, 0.015 / growth, 0.02 * growth),
        num_jumps=2,
        num_lost=num // 50,
    )
    write_tum(folder / "slam.tum", spoiled)
    return images, folder / "slam.tum", folder / "groundtruth.tum"


def camera_noise(width: int, seed: int) -> np.ndarray:
    """Noise (width / 2, width, 3) int8 of a panorama."""
    noise = np.random.default_rng(seed).normal(0, NOISE_GREY, (width // 2, width, 3))
    return noise.round().astype(np.int8)


def enlarge(source: Path, target: Path, noise: np.ndarray) -> None:
    """Write a panorama with noise (h, w, 3) int8, enlarged to its size."""
    picture = cv2.imread(str(source))
    assert picture is not None, source
    large = cv2.resize(picture, noise.shape[1::-1], interpolation=cv2.INTER_CUBIC)
    noisy = cv2.add(large, noise, dtype=cv2.CV_8U)
    cv2.imwrite(str(target), noisy, [cv2.IMWRITE_JPEG_QUALITY, 92])


def group(stage: str) -> str:
    """Group of stages that a stage belongs to."""
    name = stage.partition("-")[0].rstrip("0123456789")
    if name == "export":
        return name
    return next((title for title, names in GROUPS.items() if name in names), "other")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("walk", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--frames", type=int, nargs="+", default=[200, 400, 800])
    parser.add_argument("--enlarged", type=int, metavar="WIDTH")
    parser.add_argument(
        "--export", choices=[to.value for to in ExportFormat], nargs="+", default=[]
    )
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--timeout", type=float, default=7200)
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    titles = [*GROUPS, "export", "other"]
    lines = [
        f"| frames | CPU s | a frame | {' | '.join(titles)} | wall s | peak MB | ATE |",
        f"|---|---|---|{'---|' * len(titles)}---|---|---|",
    ]
    for num in options.frames:
        folder = options.out / f"{num}"
        images, slam, truth = cut(options.walk, num, folder, options.seed, options.enlarged)
        run = folder / "run"
        formats = f"export.formats={json.dumps(options.export)}"
        command = [*refine_command(images, run, [str(slam)]), "--set", formats]
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
