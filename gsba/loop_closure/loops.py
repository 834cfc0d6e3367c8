"""Loop closure: candidates by place recognition, tested against the map. Perfect loops to the wrong
place need more drift than the path can have, or contradict one another."""

import logging
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import KDTree

from factors import RobustLoss
from factors.threads import map_in_threads
from gsba.bundle.pose_variables import X, pose_noise, values_of
from gsba.config import RefineSettings
from gsba.geometry import inverse, relative_steps, rotation_angle, typical_length
from gsba.loop_closure import join_evidence
from gsba.loop_closure.join_evidence import LOCAL, Places, around
from gsba.loop_closure.retrieval import global_descriptors
from gsba.matching import recovery
from gsba.matching.guided_search import FAR_DRIFT, MatchContext
from gsba.matching.pairs import MAX_BASELINE_DEPTHS
from gsba.memory import release_mapped_files
from gsba.similarity import relative_similarity
from gsba.types import Counts, Solution
from gsba.types.records import slices

logger = logging.getLogger(__name__)
_NUM_CANDIDATES = 3  # candidate places for each frame
_ENOUGH_POINTS = 15  # common points by which two frames are held together in the map
_FRAMES_AT_ONCE, _ROWS_AT_ONCE = 32, 512  # frames compared together, each with so many others at a
# time: 16 MB of global descriptors
# Largest rotation error of the map between two frames; of each step without matches besides.
_MAX_ROTATION_DEG, _UNSEEN_ROTATION_DEG = 10.0, 45.0
AGREE_DEG, AGREE = 2.0, 0.1  # between two pairs; relative to the median depth
# Noise of a verified step, and of a loop: rotation; position in typical lengths of steps.
_STEP_SIGMA_DEG, _STEP_SIGMA_LENGTHS = 0.2, 0.02
_LOOP_SIGMA_DEG, _LOOP_SIGMA_LENGTHS = 0.3, 0.05


def path(
    world_T_rigs: np.ndarray, unseen: np.ndarray
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, gtsam.noiseModel.Base]:
    """A pose graph of the steps of poses (F, 4, 4), its first fixed, its values, and a loop's
    noise; steps `unseen` (F - 1,) bool without matches give way first."""
    graph, values = gtsam.NonlinearFactorGraph(), values_of(world_T_rigs)
    graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(world_T_rigs[0]), pose_noise(1e-6, 1e-6)))
    steps = relative_steps(world_T_rigs)
    lengths = np.linalg.norm(steps[:, :3, 3], axis=1)
    typical = typical_length(lengths)
    for f, step in enumerate(steps):
        noise = pose_noise(np.deg2rad(_STEP_SIGMA_DEG), _STEP_SIGMA_LENGTHS * typical)
        if unseen[f]:  # half a radian, and its length
            noise = pose_noise(0.5, float(max(lengths[f], typical)))
        graph.add(gtsam.BetweenFactorPose3(X(f), X(f + 1), gtsam.Pose3(step), noise))
    return graph, values, pose_noise(np.deg2rad(_LOOP_SIGMA_DEG), _LOOP_SIGMA_LENGTHS * typical)


def affordable(
    world_T_rigs: np.ndarray, unseen: np.ndarray, pairs: np.ndarray, f0_T_f1s: np.ndarray
) -> np.ndarray:
    """True (L,) for loops that the path can close within the noise of its steps.

    Graduated non-convexity with a truncated quadratic loss on loops only (Yang, Antonante,
    Tzoumas and Carlone, RA-L 5(2), 2020). A loop to a look-alike place bends verified steps further
    than many such loops are worth, and is switched off; one that needs normal drift, or moves a
    step without matches, stays.

    Args:
        world_T_rigs: (F, 4, 4) poses, accurate from one to the next.
        unseen: (F - 1,) bool, steps without matches, which give way first.
        pairs: (L, 2) frames of loops.
        f0_T_f1s: (L, 4, 4) relative poses by the loops, map units.
    """
    graph, values, noise = path(world_T_rigs, unseen)
    chain = graph.size()
    for (f0, f1), f0_T_f1 in zip(pairs.tolist(), f0_T_f1s, strict=True):
        graph.add(gtsam.BetweenFactorPose3(X(f0), X(f1), gtsam.Pose3(f0_T_f1), noise))
    parameters = gtsam.GncLMParams()
    parameters.setLossType(gtsam.GncLossType.TLS)
    parameters.setKnownInliers(list(range(chain)))
    solver = gtsam.GncLMOptimizer(graph, values, parameters)
    solver.setInlierCostThresholdsAtProbability(0.99)  # that a true loop is within its noise
    solver.optimize()
    return np.asarray(solver.getWeights())[chain:] > 0.5


@dataclass(frozen=True, slots=True)
class Loop:
    """Two frames that observe the same map points, and their relative pose."""

    f0: int
    f1: int
    f0_T_f1: np.ndarray  # (4, 4) float64, map units
    support: int  # number of inliers


def bend(solved: Solution, loops: list[Loop], unseen: np.ndarray) -> Solution:
    """Distribute the residuals of loops over the path, each point with its first frame; steps
    `unseen` (F - 1,) bool without matches give way first."""
    poses = solved.world_T_rigs
    graph, values, noise = path(poses, unseen)
    robust = RobustLoss("cauchy", 2.0).noise_model(noise)
    for loop in loops:
        between = gtsam.Pose3(loop.f0_T_f1)
        graph.add(gtsam.BetweenFactorPose3(X(loop.f0), X(loop.f1), between, robust))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    bent = np.array([result.atPose3(X(f)).matrix() for f in range(len(poses))])
    landmarks = solved.landmarks.moved(np.ones(len(poses)), bent @ inverse(poses))
    return Solution(bent, landmarks, solved.noise, ())


@dataclass(frozen=True, slots=True)
class Closed:
    """A map with its loops closed."""

    solved: Solution
    pairs: np.ndarray  # (L, 2) int32, accepted loops
    counts: Counts  # of pairs compared


def close(
    context: MatchContext, solved: Solution, unseen: np.ndarray, scratch: Path | None = None
) -> Closed:
    """Find revisited places, and deform the map so that they coincide; steps `unseen` (F - 1,) bool
    may be off by their length. `scratch` takes global descriptors on the disk."""
    settings, keypoints = context.settings, context.keypoints
    num = len(solved.world_T_rigs)
    looks = global_descriptors(context.strongest, num, settings.seed, context.workers, scratch)
    # Frames that see `_ENOUGH_POINTS` or more in common are held together by the map already.
    tracks = solved.landmarks.tracks
    ones = np.ones(len(tracks), np.int32)
    seen = csr_matrix((ones, (tracks.frames, tracks.points)), (num, tracks.num_points))
    common = (seen @ seen.T).tocsr()
    common.data[common.data < _ENOUGH_POINTS] = 0
    common.eliminate_zeros()
    chosen = candidates(looks, solved, unseen, settings, common, context.far_drift)
    verified = recovery.match_anywhere(context.of_strongest(), chosen)
    known = solved.points_by_keypoint(keypoints)
    loops = []
    for p, (f0, f1) in enumerate(verified.matches.pairs.tolist()):
        rows = verified.matches.of(p)
        points0, points1 = known[f0][rows[:, 0]], known[f1][rows[:, 1]]
        both = np.isfinite(points0).all(axis=1) & np.isfinite(points1).all(axis=1)
        measured = relative_similarity(points0[both], points1[both], settings.seed)
        if measured is not None:
            step, inliers = measured
            loops.append(Loop(f0, f1, step.new_T_old, int(inliers.sum())))
    poses, depth = solved.world_T_rigs, solved.median_depth()
    within = [loop for loop in loops if within_drift(loop, poses, depth, unseen, context.far_drift)]
    agreeing = consistent(within, solved, settings.pairs.window)
    upheld = _not_refuted(context, solved, agreeing)
    ends = np.array([(loop.f0, loop.f1) for loop in upheld], np.int32).reshape(-1, 2)
    steps = np.array([loop.f0_T_f1 for loop in upheld])
    kept = affordable(poses, unseen, ends, steps) if upheld else np.zeros(0, bool)
    believed = [loop for loop, stays in zip(upheld, kept, strict=True) if stays]
    counts = Counts(
        len(chosen),
        len(believed),
        "pairs",
        {
            "no common geometry": len(chosen) - len(loops),
            "further than drift": len(loops) - len(within),
            "contradicted": len(within) - len(agreeing),
            "refuted by what is around": len(agreeing) - len(upheld),
            "bend confirmed steps": len(upheld) - len(believed),
        },
    )
    return Closed(bend(solved, believed, unseen) if believed else solved, ends[kept], counts)


def candidates(
    looks: np.ndarray,
    solved: Solution,
    unseen: np.ndarray,
    settings: RefineSettings,
    held: csr_matrix | None = None,
    far_drift: float = FAR_DRIFT,
) -> np.ndarray:
    """Pairs (P, 2) int32 with the most similar global descriptors within reach of drift.

    Where places are met again, some frames look at least as much alike as almost all neighbours
    along the path do: elsewhere only frames on two sides of a step that no images confirm are
    compared.

    Args:
        looks: (F, D) global descriptors.
        unseen: (F - 1,) bool, steps that no images confirm.
        held: sparse matrix (F, F) of frames that the map holds together already, which are left
            out; None = none are.
        far_drift: largest relative drift that a loop closure may correct.
    """
    positions, depth = solved.world_T_rigs[:, :3, 3], solved.median_depth()
    num, reach = len(positions), MAX_BASELINE_DEPTHS * depth
    drifts = np.concatenate([[0.0], np.cumsum(_max_step_drifts(positions, unseen, far_drift))])
    unseen_before = np.concatenate([[0], np.cumsum(unseen)])
    least = _least_similarity(looks, solved, unseen_before, settings.pairs.window)
    blocks = list(slices(num, _FRAMES_AT_ONCE))
    apart = settings.pairs.window // 4  # frames along the path that are too near to be compared

    def within_reach(f: int) -> np.ndarray:
        distance = np.linalg.norm(positions - positions[f], axis=1)
        chosen = distance < reach + np.abs(drifts - drifts[f])
        chosen[max(f - apart, 0) : f + apart + 1] = False
        if held is not None:
            chosen[held.indices[held.indptr[f] : held.indptr[f + 1]]] = False
        return np.flatnonzero(chosen)

    def most_alike(block: int) -> list[tuple[int, int, float]]:
        """Some frames, each with those that look most like it, and how much."""
        frames, best = blocks[block], []
        others = [within_reach(f) for f in range(frames.start, frames.stop)]
        every = np.unique(np.concatenate(others))
        alike = np.empty((len(every), len(others)), looks.dtype)
        for some in slices(len(every), _ROWS_AT_ONCE):
            alike[some] = looks[every[some]] @ looks[frames].T
        for n, rows in enumerate(others):
            own = alike[np.searchsorted(every, rows), n]
            first = np.argsort(-own, kind="stable")[:_NUM_CANDIDATES]
            best += [(frames.start + n, int(rows[k]), float(own[k])) for k in first]
        return best

    each = map_in_threads(most_alike, len(blocks), settings.solver.threads())
    found = dict[tuple[int, int], float]()
    for best in each:
        found |= {(min(f, g), max(f, g)): similarity for f, g, similarity in best}
        release_mapped_files()
    pairs = np.array(sorted(found), np.int32).reshape(-1, 2)
    kept = unseen_before[pairs[:, 0]] < unseen_before[pairs[:, 1]]
    seeds = pairs[[found[f, g] >= least for f, g in pairs.tolist()]]
    if len(seeds):
        kept |= KDTree(seeds).query(pairs, p=np.inf)[0] <= settings.pairs.window
    return pairs[kept]


def _least_similarity(
    looks: np.ndarray, solved: Solution, unseen_before: np.ndarray, window: int
) -> float:
    """Similarity of almost all frames some way apart over confirmed steps, else of successive on"""
    positions, depth = solved.world_T_rigs[:, :3, 3], solved.median_depth()
    near, successive = [np.zeros(0)], np.zeros(0)
    for gap in range(1, min(window, len(positions) - 1) + 1):
        first = np.flatnonzero(unseen_before[gap:] == unseen_before[:-gap])
        found = np.concatenate(
            [
                np.einsum("fd,fd->f", looks[first[some]], looks[first[some] + gap])
                for some in slices(len(first), _ROWS_AT_ONCE)
            ]
        )
        distances = np.linalg.norm(positions[first + gap] - positions[first], axis=1)
        near.append(found[(distances > 0.25 * depth) & (distances < 0.5 * depth)])
        successive = found if gap == 1 else successive
    some = np.concatenate(near)
    some = some if len(some) else successive
    return float(np.quantile(some, 0.01)) if len(some) else -1.0  # of almost all


def _max_step_drifts(positions: np.ndarray, unseen: np.ndarray, far_drift: float) -> np.ndarray:
    """Largest error (N - 1,) of each step between positions (N, 3), map units."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return np.where(unseen, 1.0, far_drift) * steps


def within_drift(
    loop: Loop, poses: np.ndarray, depth: float, unseen: np.ndarray, far_drift: float
) -> bool:
    """True if a loop needs no more drift than the path (F, 4, 4) between its frames can have, whose
    steps `unseen` (F - 1,) bool no images confirm; `depth`, the median, in map units."""
    first, last = min(loop.f0, loop.f1), max(loop.f0, loop.f1)
    between, steps = poses[first : last + 1, :3, 3], unseen[first:last]
    slack = float(_max_step_drifts(between, steps, far_drift).sum())
    expected = poses[loop.f0] @ loop.f0_T_f1
    moved = np.linalg.norm(expected[:3, 3] - poses[loop.f1, :3, 3])
    turned = np.degrees(rotation_angle(expected[:3, :3].T @ poses[loop.f1, :3, :3]))
    allowed = _MAX_ROTATION_DEG + _UNSEEN_ROTATION_DEG * np.count_nonzero(unseen[loop.f0 : loop.f1])
    return bool(moved < slack + AGREE * depth and turned < allowed)


def consistent(loops: list[Loop], solved: Solution, window: int) -> list[Loop]:
    """Loops that outweigh those that contradict them, and agree with others within `window` frames:
    a round trip over both and the path leads back to its start."""
    depth, poses = solved.median_depth(), solved.world_T_rigs
    rivals = [
        [
            j
            for j, other in enumerate(loops)
            if abs(other.f0 - loop.f0) <= window and abs(other.f1 - loop.f1) <= window
        ]
        for loop in loops
    ]
    agree = {
        (i, j): _closes(loops[i], loops[j], poses, depth)
        for i, near in enumerate(rivals)
        for j in near
    }
    believed = []
    for i, near in enumerate(rivals):
        group = [j for j in near if agree[i, j]]
        against = [j for j in near if not agree[i, j]]
        weight = sum(loops[j].support for j in group)
        contrary = max(
            (sum(loops[k].support for k in against if agree.get((j, k))) for j in against),
            default=0,
        )
        # three pairs agree, and outweigh those that contradict them by half
        if len(group) >= 3 and weight >= 1.5 * contrary:
            believed.append(loops[i])
    return believed


def _not_refuted(context: MatchContext, solved: Solution, loops: list[Loop]) -> list[Loop]:
    """Loops that the surroundings of both places do not refute, weighed stretch by stretch."""
    if not loops:
        return loops
    poses, frames = solved.world_T_rigs, np.arange(len(solved.world_T_rigs))
    by_keypoint, depth = solved.points_by_keypoint(context.keypoints), solved.median_depth()
    known = [by_keypoint[f] for f in range(len(frames))]
    usual = join_evidence.rates(context, Places(poses, known), frames // (2 * LOCAL))
    rest, upheld = sorted(loops, key=lambda loop: -loop.support), list[Loop]()
    while rest:
        best = rest[0]
        beside = [max(abs(loop.f0 - best.f0), abs(loop.f1 - best.f1)) <= LOCAL for loop in rest]
        groups = around(frames, best.f0), around(frames, best.f1)
        groups = groups[0], np.setdiff1d(groups[1], groups[0])
        moved = poses.copy()
        moved[groups[1]] = (
            poses[best.f0] @ best.f0_T_f1 @ inverse(poses[best.f1]) @ poses[groups[1]]
        )
        evidence, _ = join_evidence.weigh(context, Places(moved, known), groups, usual, depth)
        logger.info("a loop of frames %d and %d: %s", best.f0, best.f1, evidence)
        if not evidence.refuted:
            upheld += [loop for loop, near in zip(rest, beside, strict=True) if near]
        rest = [loop for loop, near in zip(rest, beside, strict=True) if not near]
    return upheld


def _closes(one: Loop, other: Loop, poses: np.ndarray, depth: float) -> bool:
    """True if two loops and the path between their ends return to the start."""
    there = inverse(poses[one.f0]) @ poses[other.f0] @ other.f0_T_f1
    back = there @ inverse(poses[other.f1]) @ poses[one.f1]
    around = inverse(one.f0_T_f1) @ back
    turned = rotation_angle(around[:3, :3])
    return bool(
        turned < np.deg2rad(AGREE_DEG) and np.linalg.norm(around[:3, 3]) < AGREE * max(depth, 1e-12)
    )
