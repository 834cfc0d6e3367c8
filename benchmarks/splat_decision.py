"""Decisions on moves of poses by a splat: helpful moves should be kept, harmful ones undone.

    python benchmarks/splat_decision.py --table benchmarks/results/splat_decision.md

The walk is that of the tests, eight frames, with a seed for the errors of its poses and for the
training. In the first scene all poses have errors and all observations low weights; in the second
one three frames have few and noisy observations (half as many seeds). Moves are those of the joint
step, or are made harmful. All is done twice: with code for this CPU, and with generic kernels and
another CPU's BLAS. The exit code is 1 if more than one helpful move in twenty of the first scene is
undone, or any harmful one is kept.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from unittest import mock

import numpy as np

from gsba.bundle import adjustment
from gsba.bundle.bearings import Bearings
from gsba.bundle.families import Families
from gsba.bundle.optimizer import optimize
from gsba.bundle.trajectory_prior import TrajectoryPrior
from gsba.camera.rig import CubeRig
from gsba.evaluate.trajectory import evaluate
from gsba.splat import refinement
from gsba.store.store import load_stage
from gsba.types import Keypoints, Solution, Tracks, Trajectory

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from splat_moves import HARMS, Given, harmed, run, settings_for, spoiled  # type: ignore[import-not-found]
from tiny_run import SETTINGS, Case, make_case  # type: ignore[import-not-found]

KINDS: dict[str, dict[str, str]] = {
    "this CPU": {},
    "generic": {"NUMBA_CPU_NAME": "generic", "OPENBLAS_CORETYPE": "Haswell"},
}
FOUND = "as found"
DOUBTED, POOR = "observations doubted", "three poor frames"
MOVES = {DOUBTED: (FOUND, *HARMS), POOR: (FOUND, "reversed", "noise of its size")}
LEAST_TAKEN = 0.95  # of helpful moves in the first scene
WEAK, FEW, WEAK_DEG = (1, 4, 5), 25, 2.0  # frames, observations left of each, their noise


@dataclass(frozen=True, slots=True)
class Decision:
    """Move of poses, and the decision on it."""

    kind: str  # of CPU code
    scene: str
    move: str
    seed: int
    taken: bool
    gain_db: float
    gain_sigma: float
    growth: float
    evidence: float
    ate_ratio: float  # of the moved poses, over that before
    turn_ratio: float  # median relative rotation error of the moved poses, over that before


def poor_frames(case: Case, seed: int) -> Given:
    """Solved walk, solved again with few and noisy observations of three frames."""
    solved, keypoints = load_stage(case.out, "aligned2", tuple[Solution, Keypoints])
    rng, tracks = np.random.default_rng(seed), solved.landmarks.tracks
    kept = ~np.isin(tracks.frames, WEAK)
    for f in WEAK:
        kept[rng.choice(np.flatnonzero(tracks.frames == f), FEW, replace=False)] = True
    kept &= np.bincount(tracks.points[kept], minlength=tracks.num_points)[tracks.points] >= 2
    points, renumbered = np.unique(tracks.points[kept], return_inverse=True)
    landmarks = replace(
        solved.landmarks,
        points_world=solved.landmarks.points_world[points],
        tracks=Tracks(
            renumbered.astype(np.int32), tracks.frames[kept], tracks.keypoints[kept], len(points)
        ),
    )
    weak = np.isin(np.repeat(np.arange(len(keypoints.starts) - 1), np.diff(keypoints.starts)), WEAK)
    noise = np.where(weak, np.deg2rad(WEAK_DEG), 0.0)
    bearings = keypoints.bearings_rig + noise[:, None] * rng.standard_normal((len(noise), 3))
    keypoints = replace(
        keypoints,
        bearings_rig=bearings / np.linalg.norm(bearings, axis=1, keepdims=True),
        sigmas_rad=np.where(weak, noise, solved.noise * keypoints.sigmas_rad),
        sqrt_infos=None,
    )
    rig = CubeRig(SETTINGS.cubemap.face_size, np.pi / 2)  # bearings ask no face
    priors = TrajectoryPrior(case.result.coarse.world_T_rigs, SETTINGS.priors)
    problem = adjustment.AdjustmentContext(Families((Bearings(), priors)), rig, SETTINGS, 2)
    block = adjustment.landmark_block(landmarks, keypoints, 1.0, problem)
    terms = problem.terms(solved)
    block.polish(terms.values)
    values = optimize(terms.graph, [block], terms.values, SETTINGS.solver).values
    poses = adjustment.poses_of(values, len(solved.world_T_rigs))
    landmarks = replace(landmarks, points_world=block.points_world)
    start = replace(solved, world_T_rigs=poses, landmarks=landmarks, noise=1.0)
    return case.result.frames, keypoints, start


def decide(case: Case, kind: str, scene: str, move: str, seed: int) -> Decision:
    """Decision on the first move of all poses."""
    if scene == DOUBTED:
        given = spoiled(case, 0.1, 0.003, 50.0, seed)
        settings = settings_for(sizes=(48,), first_steps=80, steps=120)
    else:
        given = poor_frames(case, seed)
        settings = settings_for(sizes=(96,), first_steps=600, steps=150)
    settings = settings.model_copy(update={"seed": seed})
    made: list[np.ndarray] = []
    real = refinement._Turns._moved
    chosen = real if move == FOUND else harmed(real, HARMS[move], seed)

    def noted(*arguments):
        found = chosen(*arguments)
        made.append(found[0])
        return found

    with mock.patch.object(refinement._Turns, "_moved", noted):
        result = run(case, given, settings).moves[0]
    times = case.result.frames.timestamps
    before, after = (
        evaluate(Trajectory(times, poses), case.truth) for poses in (given[2].world_T_rigs, made[0])
    )
    return Decision(
        kind, scene, move, seed, result.accepted, result.psnr_moved - result.psnr_stayed,
        result.psnr_sigma, result.growth, result.evidence, after.ate.rmse / before.ate.rmse,
        after.rpe_rotation_deg.median / before.rpe_rotation_deg.median,
    )  # fmt: skip


def one_kind(kind: str, seeds: int) -> Iterator[Decision]:
    """Yield all decisions of this process."""
    with tempfile.TemporaryDirectory() as folder:
        case = make_case(Path(folder))
        for scene, moves in MOVES.items():
            for seed in range(seeds if scene == DOUBTED else seeds // 2):
                for move in moves:
                    yield decide(case, kind, scene, move, seed)


def other_process(kind: str, seeds: int) -> Iterator[Decision]:
    """Yield all decisions by code of another kind, with a separate cache of compiled kernels."""
    with tempfile.TemporaryDirectory() as cache:
        apart = {"NUMBA_CACHE_DIR": cache} if KINDS[kind] else {}
        command = [sys.executable, __file__, "--seeds", str(seeds), "--kind", kind]
        environment = {**os.environ, **KINDS[kind], **apart}
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as child:
            for line in child.stdout or ():
                if line.startswith("{"):
                    yield Decision(**json.loads(line))
                    print(".", end="", file=sys.stderr, flush=True)
        if child.returncode:
            raise SystemExit(f"{kind}: exit code {child.returncode}")


def format_rows(decisions: list[Decision]) -> list[str]:
    """A line of the table for each scene and move."""
    rows = [
        "| scene | move | "
        + " | ".join(f"taken, {kind}" for kind in KINDS)
        + " | ATE | rotation | held out, dB | "
        "cost of observations | evidence |",
        "|---|---|" + "---:|" * (len(KINDS) + 5),
    ]
    columns: Mapping[str, Callable[[Decision], float]] = {
        "× {:.2f}": lambda d: d.ate_ratio,
        "× {:.2f} ": lambda d: d.turn_ratio,
        "{:+.3f}": lambda d: d.gain_db,
        "× {:.3f}": lambda d: d.growth,
        "{:+.1f}": lambda d: d.evidence,
    }
    for scene, moves in MOVES.items():
        for move in moves:
            of = [d for d in decisions if (d.scene, d.move) == (scene, move)]
            counts = ([d.taken for d in of if d.kind == kind] for kind in KINDS)
            cells = [f"{sum(taken)} of {len(taken)}" for taken in counts]
            for form, value in columns.items():
                low, middle, high = np.percentile([value(d) for d in of], [0, 50, 100])
                one = form.strip().format
                cells.append(f"{one(middle)} ({one(low).lstrip('× ')} to {one(high).lstrip('× ')})")
            rows.append(f"| {scene} | {move} | {' | '.join(cells)} |")
    return rows


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--table", type=Path, help="Markdown to write")
    parser.add_argument("--kind", choices=list(KINDS), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.kind:
        for decision in one_kind(options.kind, options.seeds):
            print(json.dumps(asdict(decision)), flush=True)
        return
    decisions = [d for kind in KINDS for d in other_process(kind, options.seeds)]
    found = [d.taken for d in decisions if (d.scene, d.move) == (DOUBTED, FOUND)]
    harmful = [d.taken for d in decisions if d.move != FOUND]
    holds = np.mean(found) >= LEAST_TAKEN and not any(harmful)
    lines = [
        "# Are moves of poses against a splat kept where they help?",
        "",
        f"`python benchmarks/splat_decision.py`, {options.seeds} seeds. ATE and rotation:",
        "errors after the move over those before. Median (least to most) over seeds and kinds.",
        "",
        *format_rows(decisions),
        "",
        f"{'ok' if holds else 'MISS'}: {sum(found)} of {len(found)} helpful moves taken, at least "
        f"{LEAST_TAKEN:.0%}; {sum(harmful)} of {len(harmful)} harmful ones, none.",
    ]
    print("\n".join(["", *lines]))
    if options.table:
        options.table.write_text("\n".join(lines) + "\n")
    sys.exit(0 if holds else 1)


if __name__ == "__main__":
    main()
