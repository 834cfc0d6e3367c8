"""GPS factors on a long open walk: error and sigma at its far end, without and with fixes.

    python -m benchmarks.gps [--seeds 8] [--markdown benchmarks/results/gps.md]

Poses and tracks of a walk of 900 m in 750 s are generated. Points are so few and bearings so noisy
that images leave most of the drift of a SLAM-like start. Errors of fixes are a first-order
Gauss-Markov process of 3 m horizontally and 5 m vertically, with a time constant of 60 s. Every row
places its poses on the earth by its fixes; errors are of the last tenth of the frames. "claimed" is
the sigma of these frames by the placement (images alone) or by the covariances of the adjustment
(with fixes). The second table is of a walk with good images: it shows the motion of its poses by
fixes, beside the sigma of these poses without fixes.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.common import write_table
from gsba.bundle.adjustment import (
    AdjustmentContext,
    adjust,
    landmark_block,
    pose_covariances,
)
from gsba.bundle.bearings import Bearings
from gsba.bundle.families import Families, Family
from gsba.bundle.fixes import FrameFixes
from gsba.bundle.gps_factors import AnchoredFixes, GpsFixes, linear_factors
from gsba.bundle.optimizer import marginal_covariances
from gsba.bundle.pose_variables import X, values_of
from gsba.bundle.trajectory_prior import TrajectoryPrior
from gsba.camera.rig import CubeRig, owner_faces
from gsba.config import GpsSettings, RefineSettings
from gsba.demo.degrade import Drift, degrade
from gsba.geometry import furthest, inverse, pose
from gsba.placement.gps_fit import fit_fixes
from gsba.types import Keypoints, Solution, Tracks, Trajectory

RIG = CubeRig(512, np.pi / 2)
SIGMAS_M = np.array([3.0, 3.0, 5.0])  # of fixes, east, north, up
TAU_S, WHITE = 60.0, 0.1  # of their errors: time constant, and share of the variance that is white
SPEED = 1.2  # m/s
WILD_M = 50.0  # error of an outlier
GATES = (60.0, 6.0)


@dataclass(frozen=True, slots=True)
class Walk:
    """True walk, its observations, and a SLAM-like trajectory."""

    level_T_rigs: np.ndarray  # (F, 4, 4) metres, east, north, up
    times: np.ndarray  # (F,) seconds
    keypoints: Keypoints
    tracks: Tracks
    coarse_T_rigs: np.ndarray  # (F, 4, 4) map units


def lasting_errors(times: np.ndarray, rng: np.random.Generator, tau: float = TAU_S) -> np.ndarray:
    """Errors (F, 3) of fixes at these times, metres."""
    states, state = np.empty((len(times), 3)), rng.normal(size=3)
    for f, gap in enumerate(np.diff(times, prepend=times[0])):
        memory = np.exp(-gap / tau)
        state = memory * state + np.sqrt(1 - memory**2) * rng.normal(size=3)
        states[f] = state
    white = rng.normal(size=states.shape)
    return SIGMAS_M * (np.sqrt(1 - WHITE) * states + np.sqrt(WHITE) * white)


def make_walk(
    seed: int, num: int = 240, length: float = 900.0, noise: float = 2e-2, per_frame: int = 5
) -> Walk:
    """Open walk with points around it, each observed by the frames near it.

    Args:
        seed: seed of the walk.
        num: number of frames.
        length: metres.
        noise: noise of bearings, radians per axis.
        per_frame: number of points for each frame.
    """
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 1, num)
    positions = np.column_stack([t, 0.15 * np.sin(5 * t), 0.01 * np.sin(9 * t)]) * length
    positions *= length / np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()
    sway = rng.normal(0, 0.05, (num, 3)) + np.array([-np.pi / 2, 0, 0])  # rig: y down
    level_T_rigs = pose(Rotation.from_rotvec(sway).as_matrix(), positions)
    around = rng.normal(size=(per_frame * num, 3)) * [7, 7, 4]
    points = positions[rng.integers(0, num, len(around))] + around
    distances = np.linalg.norm(points - positions[:, None], axis=2)  # (F, J)
    seen = (distances < 10) & (distances > 2) & (rng.random(distances.shape) < 0.7)
    seen &= seen.sum(axis=0) > 2
    frames, which = np.nonzero(seen)
    away = points[which] - positions[frames]
    bearings = np.einsum("nji,nj->ni", level_T_rigs[frames, :3, :3], away)
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    bearings += rng.normal(0, noise, bearings.shape)
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    starts, faces = np.searchsorted(frames, np.arange(num + 1)), owner_faces(bearings)
    keypoints = Keypoints(
        starts,
        RIG.project(bearings, faces),
        faces,
        bearings,
        np.full(len(bearings), noise),
        np.full((len(bearings), 3), 128, np.uint8),
    )
    order = np.lexsort((frames, which))
    _, compact = np.unique(which[order], return_inverse=True)
    tracks = Tracks(
        compact.astype(np.int32),
        frames[order].astype(np.int32),
        (order - starts[frames[order]]).astype(np.int32),
        int(compact.max()) + 1,
    )
    times = t * length / SPEED
    drift = Drift(rotation_deg=20.0, scale=0.3)
    slam = degrade(Trajectory(times, level_T_rigs), seed, drift=drift)
    return Walk(level_T_rigs, times, keypoints, tracks, slam.world_T_rigs)


def fixes_of(walk: Walk, rng: np.random.Generator, wild: float) -> FrameFixes:
    """Noisy fixes of all frames, a share `wild` of them outliers."""
    positions = walk.level_T_rigs[:, :3, 3] + lasting_errors(walk.times, rng)
    num = len(positions)
    away = rng.normal(size=(num, 3))
    away *= WILD_M / np.linalg.norm(away, axis=1, keepdims=True)
    positions += np.where(rng.random(num)[:, None] < wild, away, 0.0)
    sigmas, origin = np.tile(SIGMAS_M, (num, 1)), np.zeros(3)
    return FrameFixes(np.arange(num), positions, sigmas, walk.times, origin, TAU_S)


def problem_of(walk: Walk, world_T_rigs: np.ndarray, fixes: FrameFixes | None) -> AdjustmentContext:
    """Context of an adjustment from these poses: priors and fixes."""
    settings = RefineSettings()
    faint, first = settings.priors.faint(), world_T_rigs[0]
    prior = TrajectoryPrior(walk.coarse_T_rigs, faint, first=first)
    members: list[Family] = [Bearings(), prior]
    members += [] if fixes is None else [GpsFixes(fixes, GpsSettings())]
    families = Families(tuple(members)).fitted(Solution.without_points(world_T_rigs))
    return AdjustmentContext(families, RIG, settings, 1)


def solve(
    walk: Walk, fixes: FrameFixes | None, start: np.ndarray | None = None, passes: int = 2
) -> Solution:
    """Walk after `passes` adjustments, with fixes aligned to its poses before each."""
    poses = walk.coarse_T_rigs if start is None else start
    solved = Solution.without_points(poses)
    for gates in (GATES, *[GATES[-1:]] * (passes - 1)):
        problem = problem_of(walk, solved.world_T_rigs, fixes)
        solved = adjust(walk.tracks, walk.keypoints, replace(solved, noise=1.0), problem, gates)
    return solved


def far_end(walk: Walk, solved: Solution, fixes: FrameFixes) -> tuple[float, float]:
    """Error of the last tenth of the frames placed by the fixes, and its sigma by the placement."""
    poses = solved.world_T_rigs[:, :3, 3]
    found, last = fit_fixes(poses, fixes), slice(-max(len(poses) // 10, 1), None)
    off = found.similarity.points(poses)[last] - walk.level_T_rigs[last, :3, 3]
    claimed = found.position_sigmas(poses[last])
    return _length(off), _length(claimed)


def claimed_of(walk: Walk, solved: Solution, fixes: FrameFixes) -> float:
    """Sigma of the last tenth of the frames by the covariances of the adjustment, metres."""
    problem = problem_of(walk, solved.world_T_rigs, fixes)
    gps = next(one for one in problem.families.members if isinstance(one, AnchoredFixes))
    block = landmark_block(solved.landmarks, walk.keypoints, solved.noise, problem)
    keys = [X(f) for f in range(len(walk.times))]
    snapshot = replace(problem.families.snapshot(solved), gauge_held=True)
    graph, values = gtsam.NonlinearFactorGraph(), values_of(solved.world_T_rigs)
    for family in problem.families.members:
        if family is not gps:
            graph.push_back(family.graph(snapshot))
    linear, own = linear_factors(gps.anchors, solved.world_T_rigs, free_similarity=False)
    graph.push_back(linear)
    values.insert(own)
    found, _ = marginal_covariances(graph, [block], values, keys)
    scale = gps.anchors.level_from_map[0].scale
    variances = np.einsum("fii->f", found[-len(keys) // 10 :, 3:, 3:])
    return scale * float(np.sqrt(variances.mean()))


def _length(vectors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def moved_by_fixes(seed: int) -> tuple[float, float]:
    """Motion by fixes of the poses of a walk with good images, and sigma of these poses without.

    Both are in the gauge of the covariances, which fixes the first pose and the extent; metres,
    RMS.
    """
    walk = make_walk(seed, num=120, length=240.0, noise=1e-3, per_frame=12)
    alone = solve(walk, None)
    held = solve(walk, fixes_of(walk, np.random.default_rng([seed, 7]), 0.0))
    claimed, _ = pose_covariances(alone, walk.keypoints, problem_of(walk, alone.world_T_rigs, None))
    first, far = alone.world_T_rigs[0], furthest(alone.world_T_rigs[:, :3, 3])[1]
    stretch = far / furthest(held.world_T_rigs[:, :3, 3])[1]
    steps = inverse(held.world_T_rigs[0]) @ held.world_T_rigs
    there = stretch * steps[:, :3, 3] @ first[:3, :3].T + first[:3, 3]
    metres = 240.0 / np.linalg.norm(np.diff(alone.world_T_rigs[:, :3, 3], axis=0), axis=1).sum()
    sigmas = np.sqrt(np.einsum("fii->fi", claimed[1:, 3:, 3:]))
    return metres * _length(there - alone.world_T_rigs[:, :3, 3]), metres * _length(sigmas)


def rows(seeds: Sequence[int], **walk_options: float) -> dict[str, np.ndarray]:
    """Errors and sigmas (S, 2) by seed for each kind of row, metres."""
    out: dict[str, list[tuple[float, float]]] = {}
    for seed in seeds:
        walk = make_walk(seed, **walk_options)  # type: ignore[arg-type]
        alone = solve(walk, None)
        for name, wild in (("with fixes", 0.0), ("with fixes, 10 % wild", 0.1)):
            fixes = fixes_of(walk, np.random.default_rng([seed, 7]), wild)
            if not wild:
                out.setdefault("images alone", []).append(far_end(walk, alone, fixes))
            solved = solve(walk, fixes)
            error, _ = far_end(walk, solved, fixes)
            out.setdefault(name, []).append((error, claimed_of(walk, solved, fixes)))
    return {name: np.array(pairs) for name, pairs in out.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    started = time.process_time()
    lines = ["| | error m, rms | claimed m | error / claimed |", "|---|---|---|---|"]
    for name, found in rows(range(options.seeds)).items():
        error, claimed = np.sqrt(np.mean(found**2, axis=0))
        lines.append(f"| {name} | {error:.2f} | {claimed:.2f} | {error / claimed:.2f} |")
    moved, known = np.sqrt(np.mean(np.square([moved_by_fixes(s) for s in range(3)]), axis=0))
    lines += ["", "| good images | m, rms |", "|---|---|"]
    lines += [f"| moved by fixes | {moved:.3f} |", f"| known to without them | {known:.3f} |"]
    print(*lines, f"{time.process_time() - started:.0f} CPU seconds", sep="\n")
    write_table(lines, options.markdown)


if __name__ == "__main__":
    main()
