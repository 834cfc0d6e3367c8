"""Places met again that drift has moved out of reach: found by looks, believed by consistency.

Looks are compared as vectors of locally aggregated descriptors (VLAD: Jegou et al., CVPR 2010;
normalised word by word as in Arandjelovic and Zisserman, CVPR 2013) over whole panoramas, so that
heading does not matter. What looks alike is compared point by point, and every loop is tested
against the map: repeated structure makes perfect loops to the wrong place, but those ask for more
drift than the path can have, or disagree with one another.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.sparse import csr_matrix

from gsba.bundle.adjustment import Adjustment
from gsba.bundle.prior_factors import X
from gsba.config import RefineSettings
from gsba.geometry import NoSimilarityError, inverse, pose, rotation_angle, similarity
from gsba.loop_closure import pose_graph
from gsba.loop_closure.connectivity import parted
from gsba.matching import recovery
from gsba.matching.correspondences import median_depth, points_by_keypoint
from gsba.matching.guided_search import MatchContext, SearchableFrames
from gsba.types import Counts, Keypoints, Landmarks, VerifiedPairs

_WORDS = 64  # of the vocabulary
_SAMPLES = 20_000  # descriptors it is made from
_ROUNDING = 1e-5  # of descriptors, float32 and of length one: a shorter sum has no direction
_LOOKS = 3  # places compared for each frame
_TRIALS = 200  # of three points each
_POINT_DEG = 1.0  # a point of one frame's map seen in the other
_MIN_POINTS = 15
_MIN_SHARE = 0.25  # of the matches, to measure a loop at all: consistency decides
_MIN_GROUP = 3  # loops that must agree
_RIVAL = 1.5  # by how much a group must outweigh one that contradicts it
_TURN_DEG, _UNSEEN_TURN_DEG = 10.0, 45.0  # of the map between two frames, and per unseen step
_AGREE_DEG, _AGREE = 2.0, 0.1  # of two loops; part of the median depth


@dataclass(frozen=True, slots=True)
class Loop:
    """Two frames that see the same points of the map, and how one lies in the other."""

    f0: int
    f1: int
    f0_T_f1: np.ndarray  # (4, 4) float64, map units
    support: int  # points that agree


@dataclass(frozen=True, slots=True)
class Closed:
    """A map bent so that its far loops meet."""

    solved: Adjustment
    pairs: np.ndarray  # (L, 2) int32, loops that were believed
    counts: Counts  # of pairs compared


def run(context: MatchContext, solved: Adjustment, unseen: np.ndarray) -> Closed:
    """Find places met again, and bend the map so that they coincide.

    Args:
        context: of the run; its strongest features are compared.
        solved: poses and points that are right between neighbours.
        unseen: (F - 1,) bool, steps that no images confirm: they may be off by their length.
    """
    settings, keypoints = context.settings, context.keypoints
    looks = describe(context.strongest, len(solved.world_T_rigs), settings.seed)
    chosen = candidates(looks, solved, unseen, settings)
    strongest = replace(context, frames=context.strongest)
    verified = recovery.match_anywhere(strongest, chosen, _MIN_SHARE)
    loops = _measure(verified, keypoints, solved, settings.seed)
    within = [loop for loop in loops if within_drift(loop, solved, unseen, settings)]
    agreeing = consistent(within, solved, settings.pairs.window)
    believed = _affordable(agreeing, solved, unseen)
    counts = Counts(
        len(chosen),
        len(believed),
        "pairs",
        {
            "no common geometry": len(chosen) - len(loops),
            "further than drift": len(loops) - len(within),
            "contradicted": len(within) - len(agreeing),
            "bend confirmed steps": len(agreeing) - len(believed),
        },
    )
    pairs = np.array([(loop.f0, loop.f1) for loop in believed], np.int32).reshape(-1, 2)
    return Closed(bend(solved, believed, unseen) if believed else solved, pairs, counts)


def connected(unseen: np.ndarray, pairs: np.ndarray) -> bool:
    """Whether loops (P, 2) link what steps (F - 1,) that no images confirm leave apart."""
    return parted(pairs, ~unseen) is None


def describe(frames: SearchableFrames, num_frames: int, seed: int) -> np.ndarray:
    """What each panorama looks like, whatever its heading: (F, D) float32 of length one."""
    rng = np.random.default_rng(seed)
    share = max(_SAMPLES // max(num_frames, 1), 8)
    sample = np.concatenate(
        [rng.permutation(frames[f].descriptors)[:share] for f in range(num_frames)]
    )
    words = _words(sample, rng)
    looks = [_aggregate(frames[f].descriptors, words) for f in range(num_frames)]
    return np.array(looks, np.float32)


def _words(sample: np.ndarray, rng: np.random.Generator, rounds: int = 12) -> np.ndarray:
    """Centres (W, D) of a k-means clustering."""
    words = sample[rng.permutation(len(sample))[:_WORDS]].copy()
    for _ in range(rounds):
        nearest = _nearest(sample, words)
        counts = np.bincount(nearest, minlength=len(words))
        sums = _sums(sample, nearest, len(words))
        words = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], words)
    return words


def _nearest(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    return np.argmax(descriptors @ words.T - 0.5 * np.sum(words**2, axis=1), axis=1)


def _sums(rows: np.ndarray, groups: np.ndarray, num: int) -> np.ndarray:
    """Sums (num, D) of the rows (K, D) of each group."""
    ones, starts = np.ones(len(rows), rows.dtype), np.arange(len(rows) + 1)
    return csr_matrix((ones, groups, starts), shape=(len(rows), num)).T @ rows


def _aggregate(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Sums of the differences from the nearest words, each word's of length one."""
    nearest = _nearest(descriptors, words)
    sums = _sums(descriptors - words[nearest], nearest, len(words))
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    sums = np.divide(sums, lengths, out=np.zeros_like(sums), where=lengths > _ROUNDING)
    return sums.ravel() / max(float(np.linalg.norm(sums)), 1e-12)


def candidates(
    looks: np.ndarray, solved: Adjustment, unseen: np.ndarray, settings: RefineSettings
) -> np.ndarray:
    """Pairs (P, 2) int32 that look most alike among those that drift can have brought apart."""
    positions, depth = solved.world_T_rigs[:, :3, 3], median_depth(solved)
    num = len(positions)
    alike = looks @ looks.T
    found: set[tuple[int, int]] = set()
    for f in range(num):
        others = np.arange(num)
        others = others[np.abs(others - f) > settings.pairs.window // 4]
        distance = np.linalg.norm(positions[others] - positions[f], axis=1)
        reach = settings.pairs.max_baseline_depths * depth
        slack = np.array([_drift(f, int(g), positions, unseen, settings) for g in others])
        others = others[distance < reach + slack]
        for g in others[np.argsort(-alike[f, others])[:_LOOKS]]:
            found.add((min(f, int(g)), max(f, int(g))))
    return np.array(sorted(found), np.int32).reshape(-1, 2)


def _drift(
    f0: int, f1: int, positions: np.ndarray, unseen: np.ndarray, settings: RefineSettings
) -> float:
    """How far the map may have the one frame wrong relative to the other, map units."""
    first, last = min(f0, f1), max(f0, f1)
    steps = np.linalg.norm(np.diff(positions[first : last + 1], axis=0), axis=1)
    share = np.where(unseen[first:last], 1.0, settings.pairs.far_drift)
    return float(share @ steps)


def _measure(
    verified: VerifiedPairs, keypoints: Keypoints, solved: Adjustment, seed: int
) -> list[Loop]:
    """Loops, from points of the map that both frames of a pair see."""
    known = points_by_keypoint(solved, keypoints)
    loops = []
    for p, (f0, f1) in enumerate(verified.matches.pairs.tolist()):
        rows = verified.matches.of(p)
        points0, points1 = known[f0][rows[:, 0]], known[f1][rows[:, 1]]
        both = np.isfinite(points0).all(axis=1) & np.isfinite(points1).all(axis=1)
        measured = relative_map(points0[both], points1[both], seed)
        if measured is not None:
            loops.append(Loop(f0, f1, *measured))
    return loops


def relative_map(
    points0: np.ndarray, points1: np.ndarray, seed: int
) -> tuple[np.ndarray, int] | None:
    """Pose of one frame in another from the same points in both, each with a scale of its own.

    Args:
        points0, points1: (m, 3) points in the rigs of both frames, map units.
        seed: of the sampling.

    Returns:
        f0_T_f1 (4, 4) in the units of frame 0, and how many points agree; None if too few.
    """
    found = relative_similarity(points0, points1, seed)
    return None if found is None else (found[1], int(found[2].sum()))


def relative_similarity(
    points0: np.ndarray, points1: np.ndarray, seed: int
) -> tuple[float, np.ndarray, np.ndarray] | None:
    """As `relative_map`; also frame 1's unit in units of frame 0, and which points (m,) agree."""
    if len(points0) < _MIN_POINTS:
        return None
    rng = np.random.default_rng(seed)
    best = np.zeros(len(points0), bool)
    for _ in range(_TRIALS):
        three = rng.choice(len(points0), 3, replace=False)
        agree = _agree(points0, points1, three)
        best = agree if agree.sum() > best.sum() else best
    for _ in range(3):
        if best.sum() < _MIN_POINTS:
            return None
        best = _agree(points0, points1, np.flatnonzero(best))
    if best.sum() < _MIN_POINTS:
        return None
    scale, rotation, translation = similarity(points1[best], points0[best])
    return scale, pose(rotation, translation), best


def _agree(points0: np.ndarray, points1: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Which points (m,) are seen alike from both frames under the fit to some of them."""
    try:
        scale, rotation, translation = similarity(points1[chosen], points0[chosen])
    except NoSimilarityError:
        return np.zeros(len(points0), bool)
    in0 = scale * points1 @ rotation.T + translation
    in1 = (points0 - translation) @ rotation / scale
    limit = np.cos(np.deg2rad(_POINT_DEG))
    return (_cosines(in0, points0) > limit) & (_cosines(in1, points1) > limit)


def _cosines(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    return np.einsum("mi,mi->m", a, b) / np.maximum(lengths, 1e-12)


def within_drift(
    loop: Loop, solved: Adjustment, unseen: np.ndarray, settings: RefineSettings
) -> bool:
    """Whether a loop asks for no more than the path between its frames can have drifted."""
    poses = solved.world_T_rigs
    slack = _drift(loop.f0, loop.f1, poses[:, :3, 3], unseen, settings)
    expected = poses[loop.f0] @ loop.f0_T_f1
    moved = np.linalg.norm(expected[:3, 3] - poses[loop.f1, :3, 3])
    turned = np.degrees(rotation_angle(expected[:3, :3].T @ poses[loop.f1, :3, :3]))
    allowed = _TURN_DEG + _UNSEEN_TURN_DEG * np.count_nonzero(unseen[loop.f0 : loop.f1])
    return bool(moved < slack + _AGREE * median_depth(solved) and turned < allowed)


def consistent(loops: list[Loop], solved: Adjustment, window: int) -> list[Loop]:
    """Loops that agree with others around them and outweigh what contradicts them.

    Two loops between the same stretches of the path agree if going once around (one loop, along
    the path, back over the other) leads to where one started.

    Args:
        loops: all that could be measured.
        solved: the map, right over short stretches.
        window: frames up to which a stretch counts as right.
    """
    depth, poses = median_depth(solved), solved.world_T_rigs
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
        if len(group) >= _MIN_GROUP and weight >= _RIVAL * contrary:
            believed.append(loops[i])
    return believed


def _closes(one: Loop, other: Loop, poses: np.ndarray, depth: float) -> bool:
    """Whether two loops and the path between their ends return to the start."""
    there = inverse(poses[one.f0]) @ poses[other.f0] @ other.f0_T_f1
    back = there @ inverse(poses[other.f1]) @ poses[one.f1]
    around = inverse(one.f0_T_f1) @ back
    turned = rotation_angle(around[:3, :3])
    return bool(
        turned < np.deg2rad(_AGREE_DEG)
        and np.linalg.norm(around[:3, 3]) < _AGREE * max(depth, 1e-12)
    )


def _affordable(loops: list[Loop], solved: Adjustment, unseen: np.ndarray) -> list[Loop]:
    """Loops that the path can meet without bending steps that images confirm."""
    if not loops:
        return loops
    pairs = np.array([(loop.f0, loop.f1) for loop in loops])
    asserted = np.array([loop.f0_T_f1 for loop in loops])
    kept = pose_graph.affordable(solved.world_T_rigs, unseen, pairs, asserted)
    return [loop for loop, stays in zip(loops, kept, strict=True) if stays]


def bend(solved: Adjustment, loops: list[Loop], unseen: np.ndarray) -> Adjustment:
    """Spread what loops leave open over the path: a pose graph of its steps and the loops.

    Points move with the first frame that sees them.

    Args:
        solved: poses and points.
        loops: to be closed, under a robust loss.
        unseen: (F - 1,) bool, steps that give way first.
    """
    poses = solved.world_T_rigs
    graph, values, noise = pose_graph.path(poses, unseen)
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(2.0)
    robust = gtsam.noiseModel.Robust.Create(cauchy, noise)
    for loop in loops:
        between = gtsam.Pose3(loop.f0_T_f1)
        graph.add(gtsam.BetweenFactorPose3(X(loop.f0), X(loop.f1), between, robust))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    bent = np.array([result.atPose3(X(f)).matrix() for f in range(len(poses))])
    tracks = solved.landmarks.tracks
    hosts = tracks.frames[np.searchsorted(tracks.points, np.arange(tracks.num_points))]
    moves = bent[hosts] @ inverse(poses[hosts])
    points = np.einsum("jik,jk->ji", moves[:, :3, :3], solved.landmarks.points_world)
    landmarks = Landmarks(points + moves[:, :3, 3], tracks, solved.landmarks.counts)
    return Adjustment(bent, landmarks, solved.noise, ())
