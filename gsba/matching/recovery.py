"""Neighbours that the trajectory cannot guide: matched without it, and what that says about it."""

from dataclasses import dataclass, replace

import numpy as np

from gsba.config import RefineSettings
from gsba.geometry import inverse
from gsba.matching import pairs
from gsba.matching.correspondences import verified
from gsba.matching.guided_search import Gate, MatchContext
from gsba.trajectory import clock, joining, judgement, misread
from gsba.trajectory.clock import ClockEstimate
from gsba.trajectory.joining import SegmentAlignment
from gsba.trajectory.judgement import StepChecks
from gsba.trajectory.steps import (
    Steps,
    given_up,
    image_steps,
    length_ratios,
    matches_of_steps,
    off_steps,
    without_steps,
)
from gsba.types import CoarsePoses, Counts, Keypoints, Trajectory, VerifiedPairs

_WIDER = 2, 4, 8  # frames
_MANY_LOST = 0.2  # part of the neighbours
_LEAST_ALIKE = 5  # points that tell how long a step is beside the one before it
_MAX_STEP_RATIO = 4.0  # of two steps in a row; beyond, a floor's pattern met one tile further on
_AGAIN = Gate(np.deg2rad(1.5), 0.03, np.pi)  # around relative poses that few matches have told


@dataclass(frozen=True, slots=True)
class Recovered:
    """Neighbours in time, verified with or without the trajectory, and its judgement."""

    neighbours: VerifiedPairs
    trust: StepChecks
    coarse: CoarsePoses  # the trajectory, its pieces in one world
    joints: tuple[SegmentAlignment, ...] = ()  # of those pieces

    @property
    def counts(self) -> Counts:
        """Of pairs."""
        return self.neighbours.counts


def recover(
    context: MatchContext, guided: VerifiedPairs, coarse: CoarsePoses, timestamps: np.ndarray
) -> Recovered:
    """Match the neighbours that guidance lost, judge the trajectory, and guide anew from that.

    Frames next to one another are compared as a whole: they share so much that repeated structure
    does not mislead. Frames two apart, or with a pause between them, where it does, are only
    matched along the steps found or the trajectory.

    Frames of two pieces of the trajectory are not compared here. Two views have no scale of their
    own, and what both show may ride along with the camera or be far away: how two pieces lie to
    one another is for `gsba.loop_closure.map_merging` to decide, from points that both know.

    Args:
        context: of the run.
        guided: neighbours verified under the trajectory's guidance; all of them where it is right.
        coarse: the trajectory.
        timestamps: (F,) seconds.

    Raises:
        GsbaError: the images contradict most of the trajectory.
    """
    settings, keypoints = context.settings, context.keypoints
    chosen = _of_one_piece(pairs.adjacent(len(coarse.sources)), coarse)
    guided = guided.within(coarse.segments)
    lost = guided.missing(_of_one_piece(pairs.without_pause(timestamps), coarse))
    absent = coarse.absent
    alone = VerifiedPairs.joined([guided, match_anywhere(context, lost)])
    alone = _with_wider(context, alone).within(coarse.segments)
    alone = _of_one_scale(context, alone) if absent else alone
    steps = image_steps(alone, keypoints)
    alone, guided = (_consistent(some, steps, keypoints, settings) for some in (alone, guided))
    coarse, joints = joining.join(coarse)
    misread.refuse_misfit(coarse, steps, settings.verify)
    trust = _judge(alone, keypoints, coarse, settings)
    if trust.sound and not joints:
        return Recovered(guided, trust, coarse)
    again = _of_one_piece(_two_apart(alone, steps, absent), coarse)
    over = _match_along(context, trust.world_T_rigs, again)
    neighbours = VerifiedPairs.joined([alone, _consistent(over, steps, keypoints, settings)])
    alike = judgement.confirmed(coarse, steps, settings.priors)
    doubtful = {
        (f0, f1)
        for f0, f1 in lost.tolist()
        if not (alike[f0] or _supported((f0, f1), neighbours, keypoints, absent))
    }
    if doubtful:
        frames = map(tuple, neighbours.matches.pairs.tolist())
        neighbours = neighbours.taken([p for p, pair in enumerate(frames) if pair not in doubtful])
        trust = _judge(neighbours, keypoints, coarse, settings)
    num, kept = len(chosen), len(neighbours.matches.pairs)
    counts = Counts(num, kept, "pairs", {"no common geometry": num - kept})
    neighbours = replace(neighbours, counts=counts)
    guessed = joining.guessed(joints, len(coarse.sources))
    guessed |= trust.unseen_steps & judgement.leaps(coarse.world_T_rigs, timestamps)
    trust = replace(trust, false_steps=trust.false_steps | guessed)
    return Recovered(neighbours, trust, coarse, joints)


def _two_apart(found: VerifiedPairs, steps: Steps, absent: bool) -> np.ndarray:
    """Pairs (P, 2) of frames two apart that are not found yet; without a trajectory, over steps
    that images show: nothing else tells how long one is."""
    first = np.arange(len(steps.verified) - 1)
    if absent:
        first = first[steps.verified[:-1] & steps.verified[1:]]
    return found.missing(np.column_stack([first, first + 2]))


def _with_wider(context: MatchContext, found: VerifiedPairs) -> VerifiedPairs:
    """Neighbours, and where most of them are too close to tell walking from turning, pairs of
    frames further apart over those."""
    for gap in _WIDER:
        steps = image_steps(found, context.keypoints)
        short = steps.verified & ~steps.directed
        if 2 * np.count_nonzero(short) <= np.count_nonzero(steps.verified):
            break
        first = np.arange(len(short) + 1 - gap)
        over = [short[f : f + gap].any() and steps.verified[f : f + gap].all() for f in first]
        chosen = first[np.array(over, bool)]
        wider = found.missing(np.column_stack([chosen, chosen + gap]))
        found = VerifiedPairs.joined([found, match_anywhere(context, wider)])
    return found


def _of_one_piece(chosen: np.ndarray, coarse: CoarsePoses) -> np.ndarray:
    """Those pairs (P, 2) whose frames belong to one piece of the trajectory."""
    if coarse.segments is None:
        return chosen
    pieces = coarse.segments[chosen]
    return chosen[pieces[:, 0] == pieces[:, 1]]


def check_clock(
    context: MatchContext,
    guided: VerifiedPairs,
    coarse: CoarsePoses,
    timestamps: np.ndarray,
    trajectory: Trajectory,
) -> ClockEstimate:
    """Whether the trajectory turns when the images do, or at other times.

    One that fits if read otherwise is refused first: it may turn like the images at other times.

    Args:
        context: of the run.
        guided: neighbours verified under the trajectory's guidance. Where it lost many, whole
            panoramas are compared: a clock that is off loses the turns, which tell it.
        coarse: the trajectory at the frames' times.
        timestamps: (F,) seconds.
        trajectory: all its entries.

    Raises:
        GsbaError: it is reversed, mirrored, inverted or in other axes.
    """
    settings, chosen = context.settings, pairs.without_pause(timestamps)
    lost = guided.missing(chosen)
    if len(lost) > _MANY_LOST * len(chosen):
        guided = VerifiedPairs.joined([guided, match_anywhere(context, lost)])
    steps = image_steps(guided, context.keypoints)
    misread.refuse_misread(coarse, steps, settings.verify)
    reach = settings.read.max_clock_shift_s
    return clock.estimate(timestamps, steps, trajectory, coarse.time_offset, reach)


def _match_along(
    context: MatchContext, world_T_rigs: np.ndarray, chosen: np.ndarray
) -> VerifiedPairs:
    """Match pairs (P, 2) guided by the start, and verify that they agree with it."""
    settings = context.settings.pairs
    prior, limit = settings.prior, np.deg2rad(settings.max_parallax_deg)
    gates = [Gate(np.deg2rad(prior.rotation_deg), prior.direction, limit)] * len(chosen)
    found = context.match(chosen, world_T_rigs, gates)
    f0_T_f1s = inverse(world_T_rigs[chosen[:, 0]]) @ world_T_rigs[chosen[:, 1]]
    return verified(found, gates, f0_T_f1s, np.zeros(len(chosen)), context)


def match_anywhere(context: MatchContext, chosen: np.ndarray, rivals: bool = True) -> VerifiedPairs:
    """Match whole panoramas without any prediction, and verify their geometry alone.

    The strongest features are tried first, and all for pairs that those do not settle.

    Args:
        context: of the run.
        chosen: (P, 2) frame indices.
        rivals: whether another pose that explains about as many matches speaks against a pair.
    """
    nowhere = np.tile(np.eye(4), (len(context.keypoints.starts) - 1, 1, 1))

    def match(some: np.ndarray, strongest: bool) -> VerifiedPairs:
        gates = [Gate.anywhere()] * len(some)
        # Nothing predicts which faces a learned matcher should compare.
        found = context.match(some, nowhere, gates, strongest=strongest, guided_only=True)
        return verified(found, gates, None, None, context, rivals)

    first = match(chosen, strongest=True)
    if context.strongest is context.frames:
        return first
    rest = first.missing(chosen)
    return VerifiedPairs.joined([first, match(rest, strongest=False)]) if len(rest) else first


def match_again(context: MatchContext, found: VerifiedPairs, steps: set[int]) -> VerifiedPairs:
    """Match steps once more, all keypoints along the epipolar lines found, and verify them anew.

    Args:
        context: of the run.
        found: neighbours.
        steps: first frames of the steps; each keeps what more matches agree on.
    """
    chosen = [
        p
        for p, (f0, f1) in enumerate(found.matches.pairs.tolist())
        if f1 - f0 == 1 and f0 in steps and np.isfinite(found.direction_sigmas[p])
    ]
    better = []
    for p in chosen:
        poses = np.tile(np.eye(4), (len(context.keypoints.starts) - 1, 1, 1))
        poses[found.matches.pairs[p, 1]] = found.f0_T_f1s[p]
        pair, gates = found.matches.pairs[p : p + 1], [_AGAIN]
        matches = context.match(pair, poses, gates, guided_only=True)
        again = verified(matches, gates, None, None, context, rivals=True)
        if len(again.matches.pairs) and len(again.matches.of(0)) > len(found.matches.of(p)):
            better.append((p, again))
    replaced = {p for p, _ in better}
    kept = found.taken([p for p in range(len(found.matches.pairs)) if p not in replaced])
    return VerifiedPairs.joined([kept, *(again for _, again in better)])


def _judge(
    found: VerifiedPairs, keypoints: Keypoints, coarse: CoarsePoses, settings: RefineSettings
) -> StepChecks:
    steps = image_steps(found, keypoints)
    logs, sigmas = _length_ratios(found, steps, keypoints, coarse.absent)
    return judgement.judge(coarse, steps, logs, sigmas, settings.verify, settings.priors)


def _length_ratios(
    found: VerifiedPairs, steps: Steps, keypoints: Keypoints, absent: bool
) -> tuple[np.ndarray, np.ndarray]:
    """See `length_ratios`; without a trajectory fewer points suffice, if they agree."""
    return length_ratios(found, steps, keypoints, _LEAST_ALIKE if absent else None)


def _supported(
    pair: tuple[int, int], found: VerifiedPairs, keypoints: Keypoints, absent: bool
) -> bool:
    """Whether a third frame confirms a step that no trajectory guided.

    Either a pair that spans it fits the steps it is made of, or points that it shares with a step
    beside it lie at distances in one proportion.
    """
    f = pair[0]
    present = found.frames()
    if {(f - 1, f + 1), (f, f + 2)} & present:
        return True
    steps = image_steps(found, keypoints)
    if not steps.directed[f]:
        return True  # a turn on the spot: whole panoramas agree on one rotation
    sigmas = _length_ratios(found, steps, keypoints, absent)[1]
    return bool(np.isfinite(sigmas[max(f - 1, 0) : f + 1]).any()) or len(steps.verified) == 1


def _of_one_scale(context: MatchContext, found: VerifiedPairs) -> VerifiedPairs:
    """Neighbours without steps that are many times too short, as points beside them tell.

    Where a floor's pattern is met one tile further on, relative poses look right. One of the two
    steps is given up there, and pairs over it: the map goes in parts, which the test of joins may
    join. Steps that share too few points to tell their lengths are matched with all keypoints
    first.

    Args:
        context: of the run, which has no trajectory.
        found: neighbours.
    """
    open_at = _open_ratios(context, found)[0]
    found = match_again(context, found, {step for f in open_at for step in (f - 1, f)})
    matches = matches_of_steps(found, len(context.keypoints.starts) - 1)
    return without_steps(found, given_up(_open_ratios(context, found)[1], matches))


def _open_ratios(context: MatchContext, found: VerifiedPairs) -> tuple[set[int], set[int]]:
    """Frames between two steps that share few points: where these do not tell how long one step is
    beside the other, or tell more than `_MAX_STEP_RATIO`; and the latter alone."""
    steps = image_steps(found, context.keypoints)
    logs, sigmas = length_ratios(found, steps, context.keypoints, _LEAST_ALIKE)
    rows = {int(f0): p for p, (f0, f1) in enumerate(found.matches.pairs) if f1 - f0 == 1}
    unknown, extreme = set[int](), set[int]()
    for f in range(1, len(steps.verified)):
        both = [rows[g] for g in (f - 1, f) if g in rows]
        if len(both) < 2 or not np.isfinite(found.direction_sigmas[both]).any():
            continue  # a break, or turns on the spot
        before, after = (found.matches.of(p) for p in both)
        shared = len(np.intersect1d(before[:, 1], after[:, 0]))
        if shared >= context.settings.pairs.scarce_matches:
            continue
        if np.isinf(sigmas[f - 1]):
            unknown.add(f)
        elif abs(logs[f - 1]) > np.log(_MAX_STEP_RATIO):
            extreme.add(f)
    return unknown | extreme, extreme


def _consistent(
    found: VerifiedPairs, steps: Steps, keypoints: Keypoints, settings: RefineSettings
) -> VerifiedPairs:
    """Pairs without those over two steps that a repeated structure made up: see `off_steps`."""
    off = off_steps(found, steps)
    false = off > np.deg2rad(settings.verify.max_triplet_deg)
    return found.taken(np.flatnonzero(~false).tolist()) if false.any() else found
