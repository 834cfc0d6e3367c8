"""Places met again that drift has moved out of reach: found by looks, believed by consistency.

What looks alike (`gsba.loop_closure.retrieval`) is compared point by point, and every loop is
tested against the map: repeated structure makes perfect loops to the wrong place, but those ask
for more drift than the path can have, or disagree with one another.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np

from gsba.config import RefineSettings
from gsba.geometry import inverse, rotation_angle
from gsba.loop_closure import join_evidence
from gsba.loop_closure.connectivity import parted
from gsba.loop_closure.join_evidence import LOCAL, Places, around
from gsba.loop_closure.pose_graph import Loop, bend, met
from gsba.loop_closure.retrieval import global_descriptors
from gsba.matching import recovery
from gsba.matching.guided_search import MatchContext
from gsba.similarity import relative_map
from gsba.types import Counts, Keypoints, Solution, VerifiedPairs

logger = logging.getLogger(__name__)
_LOOKS = 3  # places compared for each frame
MIN_GROUP = 3  # pairs that must agree
RIVAL = 1.5  # by how much a group must outweigh one that contradicts it
_TURN_DEG, _UNSEEN_TURN_DEG = 10.0, 45.0  # of the map between two frames, and per unseen step
AGREE_DEG, AGREE = 2.0, 0.1  # of two pairs; part of the median depth


@dataclass(frozen=True, slots=True)
class Closed:
    """A map bent so that its far loops meet."""

    solved: Solution
    pairs: np.ndarray  # (L, 2) int32, loops that were believed
    counts: Counts  # of pairs compared


def close(context: MatchContext, solved: Solution, unseen: np.ndarray) -> Closed:
    """Find places met again, and bend the map so that they coincide.

    Args:
        context: of the run; its strongest features are compared.
        solved: poses and points that are right between neighbours.
        unseen: (F - 1,) bool, steps that no images confirm: they may be off by their length.
    """
    settings, keypoints = context.settings, context.keypoints
    num = len(solved.world_T_rigs)
    looks = global_descriptors(context.strongest, num, settings.seed, context.workers)
    chosen = candidates(looks, solved, unseen, settings)
    strongest = replace(context, frames=context.strongest)
    verified = recovery.match_anywhere(strongest, chosen)
    loops = _measure(verified, keypoints, solved, settings.seed)
    within = [loop for loop in loops if within_drift(loop, solved, unseen, settings)]
    agreeing = consistent(within, solved, settings.pairs.window)
    upheld = _upheld(context, solved, agreeing)
    believed = met(upheld, solved, unseen)
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
    pairs = np.array([(loop.f0, loop.f1) for loop in believed], np.int32).reshape(-1, 2)
    return Closed(bend(solved, believed, unseen) if believed else solved, pairs, counts)


def connected(unseen: np.ndarray, pairs: np.ndarray) -> bool:
    """Whether loops (P, 2) link what steps (F - 1,) that no images confirm leave apart."""
    return parted(pairs, ~unseen) is None


def candidates(
    looks: np.ndarray, solved: Solution, unseen: np.ndarray, settings: RefineSettings
) -> np.ndarray:
    """Pairs (P, 2) int32 that look most alike among those that drift can have brought apart."""
    positions, depth = solved.world_T_rigs[:, :3, 3], solved.median_depth()
    num = len(positions)
    drifts = np.concatenate([[0.0], np.cumsum(_drifts(positions, unseen, settings))])
    found: set[tuple[int, int]] = set()
    for f in range(num):
        others = np.arange(num)
        others = others[np.abs(others - f) > settings.pairs.window // 4]
        distance = np.linalg.norm(positions[others] - positions[f], axis=1)
        reach = settings.pairs.max_baseline_depths * depth
        others = others[distance < reach + np.abs(drifts[others] - drifts[f])]
        for g in others[np.argsort(-(looks[others] @ looks[f]))[:_LOOKS]]:
            found.add((min(f, int(g)), max(f, int(g))))
    return np.array(sorted(found), np.int32).reshape(-1, 2)


def _drift(
    f0: int, f1: int, positions: np.ndarray, unseen: np.ndarray, settings: RefineSettings
) -> float:
    """How far the map may have the one frame wrong relative to the other, map units."""
    first, last = min(f0, f1), max(f0, f1)
    between = positions[first : last + 1]
    return float(_drifts(between, unseen[first:last], settings).sum())


def _drifts(positions: np.ndarray, unseen: np.ndarray, settings: RefineSettings) -> np.ndarray:
    """How far each step (N - 1,) between positions (N, 3) may be off, map units."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return np.where(unseen, 1.0, settings.pairs.far_drift) * steps


def _measure(
    verified: VerifiedPairs, keypoints: Keypoints, solved: Solution, seed: int
) -> list[Loop]:
    """Loops, from points of the map that both frames of a pair see."""
    known = solved.points_by_keypoint(keypoints)
    loops = []
    for p, (f0, f1) in enumerate(verified.matches.pairs.tolist()):
        rows = verified.matches.of(p)
        points0, points1 = known[f0][rows[:, 0]], known[f1][rows[:, 1]]
        both = np.isfinite(points0).all(axis=1) & np.isfinite(points1).all(axis=1)
        measured = relative_map(points0[both], points1[both], seed)
        if measured is not None:
            loops.append(Loop(f0, f1, *measured))
    return loops


def within_drift(
    loop: Loop, solved: Solution, unseen: np.ndarray, settings: RefineSettings
) -> bool:
    """Whether a loop asks for no more than the path between its frames can have drifted."""
    poses = solved.world_T_rigs
    slack = _drift(loop.f0, loop.f1, poses[:, :3, 3], unseen, settings)
    expected = poses[loop.f0] @ loop.f0_T_f1
    moved = np.linalg.norm(expected[:3, 3] - poses[loop.f1, :3, 3])
    turned = np.degrees(rotation_angle(expected[:3, :3].T @ poses[loop.f1, :3, :3]))
    allowed = _TURN_DEG + _UNSEEN_TURN_DEG * np.count_nonzero(unseen[loop.f0 : loop.f1])
    return bool(moved < slack + AGREE * solved.median_depth() and turned < allowed)


def consistent(loops: list[Loop], solved: Solution, window: int) -> list[Loop]:
    """Loops that agree with others around them and outweigh what contradicts them.

    Two loops between the same stretches of the path agree if going once around (one loop, along
    the path, back over the other) leads to where one started.

    Args:
        loops: all that could be measured.
        solved: the map, right over short stretches.
        window: frames up to which a stretch counts as right.
    """
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
        if len(group) >= MIN_GROUP and weight >= RIVAL * contrary:
            believed.append(loops[i])
    return believed


def _upheld(context: MatchContext, solved: Solution, loops: list[Loop]) -> list[Loop]:
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
    """Whether two loops and the path between their ends return to the start."""
    there = inverse(poses[one.f0]) @ poses[other.f0] @ other.f0_T_f1
    back = there @ inverse(poses[other.f1]) @ poses[one.f1]
    around = inverse(one.f0_T_f1) @ back
    turned = rotation_angle(around[:3, :3])
    return bool(
        turned < np.deg2rad(AGREE_DEG) and np.linalg.norm(around[:3, 3]) < AGREE * max(depth, 1e-12)
    )
