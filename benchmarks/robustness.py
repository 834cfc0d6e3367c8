"""How badly wrong a trajectory may be: drift, outliers, gaps and scale drift, swept one by one.

Renders a walk (or takes FRAMES and their TRUTH), spoils its exact trajectory by growing amounts,
refines each and compares with the truth. Frames are searched for features once.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from common import machine
from scipy.spatial.transform import Rotation

from gsba import refine
from gsba.config_file import load_config
from gsba.demo import degrade, make_walk
from gsba.evaluate import evaluate
from gsba.geometry import inverse
from gsba.log import GsbaError
from gsba.read import read_trajectory, write_tum
from gsba.types import Trajectory

RESULTS = Path(__file__).parent / "results"
DRIFTS = (0.0, 0.02, 0.05, 0.1, 0.2)  # of the path
OUTLIERS = (0.05, 0.1, 0.2, 0.3)  # of the frames
GAPS = (5, 10, 20)  # frames
SCALES = (0.1, 0.3)  # half the range over the run
TURN_DEG_PER_DRIFT = 100.0  # degrees of rotation drift that go with a drift of one path length
OUTLIER_STEPS, OUTLIER_DEG = (1.0, 3.0), (5.0, 20.0)  # how far off: least and most


def spoiled(truth: Trajectory, seed: int) -> Iterator[tuple[str, float, Trajectory, list[int]]]:
    """Name, amount, trajectory, and the frames made outliers, of every point of the sweeps."""
    base = degrade(truth, seed)
    for amount in DRIFTS:
        turn = TURN_DEG_PER_DRIFT * amount
        drifting = degrade(truth, seed, rotation_drift_deg=turn, translation_drift=amount)
        yield "drift", amount, drifting, []
    for amount in OUTLIERS:
        poses, frames = with_outliers(base.world_T_rigs, amount, seed)
        yield "outliers", amount, Trajectory(base.timestamps, poses), frames
    for gap in GAPS:
        first = (len(base.timestamps) - gap) // 2
        kept = np.r_[:first, first + gap : len(base.timestamps)]
        yield "gap", gap, Trajectory(base.timestamps[kept], base.world_T_rigs[kept]), []
    for amount in SCALES:
        yield "scale", amount, Trajectory(truth.timestamps, rescaled(truth, amount)), []
    backwards = Trajectory(base.timestamps, base.world_T_rigs[::-1].copy())
    yield "reversed", 1, backwards, []
    flip = np.diag([-1.0, 1, 1, 1])
    yield "mirrored", 1, Trajectory(base.timestamps, flip @ base.world_T_rigs @ flip), []


def with_outliers(
    world_T_rigs: np.ndarray, share: float, seed: int
) -> tuple[np.ndarray, list[int]]:
    """Poses of which some, never the ends, are displaced by steps and turned; and which ones."""
    rng = np.random.default_rng(seed)
    poses = world_T_rigs.copy()
    step = np.median(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))
    inner = np.arange(1, len(poses) - 1)
    frames = sorted(rng.choice(inner, round(share * len(poses)), replace=False).tolist())
    for f in frames:
        away, axis = rng.normal(size=3), rng.normal(size=3)
        poses[f, :3, 3] += rng.uniform(*OUTLIER_STEPS) * step * away / np.linalg.norm(away)
        turn = np.radians(rng.uniform(*OUTLIER_DEG)) * axis / np.linalg.norm(axis)
        poses[f, :3, :3] = poses[f, :3, :3] @ Rotation.from_rotvec(turn).as_matrix()
    return poses, frames


def rescaled(truth: Trajectory, amount: float) -> np.ndarray:
    """Poses whose steps grow from 1 - amount to 1 + amount of their length."""
    steps = inverse(truth.world_T_rigs[:-1]) @ truth.world_T_rigs[1:]
    steps[:, :3, 3] *= np.linspace(1 - amount, 1 + amount, len(steps))[:, None]
    poses = [truth.world_T_rigs[0]]
    for step in steps:
        poses.append(poses[-1] @ step)
    return np.array(poses)


def _point(run: Callable[[], dict[str, Any]], names: list[str], truth: Trajectory, out: Path):
    """Errors, naming of outliers and cost of one refinement, or why it was refused."""
    start = time.process_time()
    try:
        report = run()
    except GsbaError as error:
        return {"refused": str(error)}
    errors = evaluate(read_trajectory(out / "trajectory.tum"), truth)
    accused = set(report["trajectory"]["false_frames"])
    return {
        "posed": errors.num_matched,
        "ate": errors.ate.rmse,
        "rotation_deg": errors.rpe_rotation_deg.median,
        "named": len(accused & set(names)),
        "outliers": len(names),
        "accused_falsely": len(accused - set(names)),
        "cpu_s": time.process_time() - start,
    }


def to_markdown(rows: list[dict[str, Any]]) -> str:
    """Table of all points."""
    lines = [
        "| | amount | ATE before | ATE after | rel. rot. ° | outliers named | falsely | CPU s |"
    ]
    lines.append("|---|---:|---:|---:|---:|---:|---:|---:|")
    for row in rows:
        cells = [row["sweep"], f"{row['amount']:g}", f"{row['ate_before']:.4f}"]
        if "refused" in row:
            cells += [f"refused: {row['refused']}", "", "", "", ""]
        else:
            cells += [f"{row['ate']:.4f}", f"{row['rotation_deg']:.4f}"]
            cells += [f"{row['named']} of {row['outliers']}", str(row["accused_falsely"])]
            cells += [f"{row['cpu_s']:.0f}"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Parse, sweep, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path, help="folder for walk and runs")
    parser.add_argument("--frames", type=Path, help="frames instead of a rendered walk")
    parser.add_argument("--truth", type=Path, help="their exact trajectory")
    parser.add_argument("--name", default="robustness", help="of the result files")
    parser.add_argument("--set", action="append", default=[], metavar="STAGE.KEY=VALUE")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    frames, truth_path = arguments.frames, arguments.truth
    if frames is None:
        walk = make_walk(arguments.work / "walk", num_frames=40, width=768, seed=arguments.seed)
        frames, truth_path = walk.frames_dir, walk.truth_path
    truth = read_trajectory(truth_path)
    all_names = sorted(path.stem for path in frames.iterdir() if path.suffix != ".csv")
    out, slam = arguments.work / "run", arguments.work / "slam.tum"
    settings = load_config(None, ['export.formats=["tum"]', *arguments.set])
    rows = []
    for sweep, amount, trajectory, outliers in spoiled(truth, arguments.seed):
        write_tum(slam, trajectory)
        names = [all_names[f] for f in outliers]
        before = evaluate(trajectory, truth).ate.rmse
        point = _point(lambda: refine(frames, slam, out, settings).report, names, truth, out)
        rows.append({"sweep": sweep, "amount": amount, "ate_before": before, **point})
        print(rows[-1], flush=True)
    head = f"{machine()}; seed {arguments.seed}; settings {arguments.set or 'defaults'}\n\n"
    (RESULTS / f"{arguments.name}.md").write_text(head + to_markdown(rows) + "\n")
    (RESULTS / f"{arguments.name}.json").write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
