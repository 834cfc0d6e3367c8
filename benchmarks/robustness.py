"""Robustness to errors of the trajectory: drift, outliers, gaps, scale, clock, swept one by one.

Renders a walk (or takes FRAMES and their TRUTH), adds errors of growing size to its exact
trajectory, refines each and compares with the truth. Features are detected once. `missing loop`
leaves out the last frames and poses of a drifting trajectory, so that it does not return to its
start; `false loops` forces loop closures between different places into the run.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
from common import link_frames, machine
from scipy.spatial import cKDTree  # type: ignore[attr-defined]
from scipy.spatial.transform import Rotation

from gsba import refine
from gsba.config import RefineSettings
from gsba.config_file import load_config
from gsba.demo import degrade, make_walk
from gsba.demo.degrade import Drift
from gsba.evaluate.trajectory import evaluate
from gsba.geometry import inverse
from gsba.log import GsbaError
from gsba.matching import correspondences
from gsba.matching.guided_search import MatchContext
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Counts, Matches, Solution, Trajectory, VerifiedPairs

RESULTS = Path(__file__).parent / "results"
DRIFTS = (0.0, 0.02, 0.05, 0.1, 0.2)  # of the path
OUTLIERS = (0.05, 0.1, 0.2, 0.3)  # of the frames
GAPS = (5, 10, 20)  # frames
SCALES = (0.1, 0.3)  # half the range over the run
CLOCKS = ((0.2, 1.0), (0.7, 1.0), (0.7, 1.01), (-2.0, 0.99))  # offset in seconds, rate
MISSING = (5, 10, 20)  # last frames left out
MISSING_DRIFT = 0.05  # of the path, of the trajectory whose loop is missing
FALSE_LOOPS = (3, 8)  # in a row, between frames a quarter and three quarters into the walk
TURN_DEG_PER_DRIFT = 100.0  # degrees of rotation drift that go with a drift of one path length
OUTLIER_STEPS, OUTLIER_DEG = (1.0, 3.0), (5.0, 20.0)  # smallest and largest error of an outlier
MAX_DEG = 0.5  # between a keypoint and the other frame's point projected by the false pose


class Point(NamedTuple):
    """Trajectory to refine, of one sweep and amount."""

    sweep: str
    amount: float
    trajectory: Trajectory
    outliers: list[int]  # frames that were displaced


def forge(context: MatchContext, solved: Solution, pairs: list[tuple[int, int]]) -> VerifiedPairs:
    """Verified matches of frames that share no part of the scene.

    The second frame of a pair gets the pose of the first one's successor. Its matches are the
    keypoints near map points projected by that pose.
    """
    known = solved.points_by_keypoint(context.keypoints)
    rows, poses = [], []
    for f0, f1 in pairs:
        f0_T_f1 = inverse(solved.world_T_rigs[f0]) @ solved.world_T_rigs[f0 + 1]
        mine = np.flatnonzero(np.isfinite(known[f0]).all(axis=1))
        seen = (known[f0][mine] - f0_T_f1[:3, 3]) @ f0_T_f1[:3, :3]
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        away, theirs = cKDTree(context.keypoints.bearings_of(f1)).query(seen)
        _, first = np.unique(theirs, return_index=True)
        first = first[away[first] < np.radians(MAX_DEG)]
        rows.append(np.column_stack([mine[first], theirs[first]]).astype(np.int32))
        f0_T_f1[:3, 3] /= np.linalg.norm(f0_T_f1[:3, 3])
        poses.append(f0_T_f1)
    matches = Matches.of_rows(np.array(pairs, np.int32), rows)
    counts = Counts(len(pairs), len(pairs), "pairs")
    return VerifiedPairs(matches, np.array(poses), np.zeros(len(pairs)), counts)


@contextmanager
def forged_loops(first: int, far: int, count: int) -> Iterator[list[int]]:
    """Add `count` false loop closures to runs in this context, of frames `first` + n and n + `far`.

    Yields:
        number of matches of each false pair, filled when a run has closed its loops.
    """
    honest, sizes = correspondences.match_loops, []

    def match_loops(context: MatchContext, solved: Solution) -> VerifiedPairs:
        found = honest(context, solved)
        pairs = [(first + n, first + n + far) for n in range(count)]
        false = forge(context, solved, pairs)
        sizes[:] = np.diff(false.matches.offsets).tolist()
        ours, theirs = found.matches, false.matches
        both = Matches(
            np.concatenate([ours.pairs, theirs.pairs]),
            np.concatenate([ours.offsets, ours.offsets[-1] + theirs.offsets[1:]]),
            np.concatenate([ours.keypoints, theirs.keypoints]),
        )
        poses = np.concatenate([found.f0_T_f1s, false.f0_T_f1s])
        sigmas = np.concatenate([found.direction_sigmas, false.direction_sigmas])
        return VerifiedPairs(both, poses, sigmas, found.counts)

    with patch.object(correspondences, "match_loops", match_loops):
        yield sizes


def spoiled(truth: Trajectory, seed: int) -> Iterator[tuple[str, float, Trajectory, list[int]]]:
    """Yield name, amount, trajectory and outlier frames of every point of the sweeps."""
    base = degrade(truth, seed)
    for amount in DRIFTS:
        turn = TURN_DEG_PER_DRIFT * amount
        drifting = degrade(truth, seed, drift=Drift(turn, amount))
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
    for offset, rate in CLOCKS:
        times = offset + rate * base.timestamps
        yield f"clock, rate {rate:g}", offset, Trajectory(times, base.world_T_rigs), []
    turn = TURN_DEG_PER_DRIFT * MISSING_DRIFT
    drifting = degrade(truth, seed, drift=Drift(turn, MISSING_DRIFT))
    for missing in MISSING:
        left = slice(0, -missing)
        open_end = Trajectory(drifting.timestamps[left], drifting.world_T_rigs[left])
        yield "missing loop", missing, open_end, []
    for count in FALSE_LOOPS:
        yield "false loops", count, base, []
    backwards = Trajectory(base.timestamps, base.world_T_rigs[::-1].copy())
    yield "reversed", 1, backwards, []
    flip = np.diag([-1.0, 1, 1, 1])
    yield "mirrored", 1, Trajectory(base.timestamps, flip @ base.world_T_rigs @ flip), []


def with_outliers(
    world_T_rigs: np.ndarray, share: float, seed: int
) -> tuple[np.ndarray, list[int]]:
    """Poses of which a share, without the ends, is displaced and rotated; and these frames."""
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
    """Errors, detection of outliers and cost of one refinement, or the reason of its refusal."""
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


def _row(
    point: Point, frames: Path, truth: Trajectory, work: Path, settings: RefineSettings
) -> dict[str, Any]:
    """Row of one refinement; points with the same frames and stages share a folder."""
    slam, folder, false, trajectory = (
        work / "slam.tum",
        work / "run",
        nullcontext(),
        point.trajectory,
    )
    write_tum(slam, trajectory)
    all_names = sorted(path.stem for path in frames.iterdir() if path.suffix != ".csv")
    names, before = [all_names[f] for f in point.outliers], trajectory
    if point.sweep.startswith("clock"):
        before = Trajectory(truth.timestamps, trajectory.world_T_rigs)
    elif point.sweep == "missing loop":
        folder = work / f"run-cut{point.amount}"
        frames = _without_last(frames, truth, int(point.amount), work / f"cut{point.amount}")
    elif point.sweep == "false loops":
        folder = work / f"run-false{point.amount}"
        false = forged_loops(len(all_names) // 4, len(all_names) // 2, int(point.amount))
    with false:
        run = partial(_report, frames, slam, folder, settings, point.sweep == "false loops")
        errors = _point(run, names, truth, folder)
    ate = evaluate(before, truth).ate.rmse
    return {"sweep": point.sweep, "amount": point.amount, "ate_before": ate, **errors}


def _report(
    frames: Path, slam: Path, out: Path, settings: RefineSettings, fresh: bool
) -> dict[str, Any]:
    return refine(frames, slam, out, settings, fresh=fresh).report


def _without_last(frames: Path, truth: Trajectory, missing: int, folder: Path) -> Path:
    """Folder of links to all frames but the last ones, and their times."""
    images = sorted(path for path in frames.iterdir() if path.suffix != ".csv")[:-missing]
    link_frames(images, folder)
    rows = [
        f"{image.name},{t!r}" for image, t in zip(images, truth.timestamps.tolist(), strict=False)
    ]
    (folder / "timestamps.csv").write_text("\n".join(["name,timestamp", *rows]) + "\n")
    return folder


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
    parser.add_argument("--only", action="append", metavar="SWEEP", help="the others are kept")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    frames, truth_path = arguments.frames, arguments.truth
    arguments.work.mkdir(parents=True, exist_ok=True)
    if frames is None:
        walk = make_walk(arguments.work / "walk", num_frames=40, width=768, seed=arguments.seed)
        frames, truth_path = walk.frames_dir, walk.truth_path
    truth = read_trajectory(truth_path)
    settings = load_config(None, ['export.formats=["tum"]', *arguments.set])
    kept = RESULTS / f"{arguments.name}.json"
    rows = json.loads(kept.read_text()) if arguments.only and kept.exists() else []
    for sweep, amount, trajectory, outliers in spoiled(truth, arguments.seed):
        if arguments.only and sweep not in arguments.only:
            continue
        point = Point(sweep, amount, trajectory, outliers)
        row = _row(point, frames, truth, arguments.work, settings)
        rows = [r for r in rows if (r["sweep"], r["amount"]) != (sweep, amount)] + [row]
        print(row, flush=True)
    head = f"{machine()}; seed {arguments.seed}; settings {arguments.set or 'defaults'}\n\n"
    (RESULTS / f"{arguments.name}.md").write_text(head + to_markdown(rows) + "\n")
    kept.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
