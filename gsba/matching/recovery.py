"""Neighbours that the trajectory cannot guide: matched without it, to check it against images."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gsba.config import RefineSettings
from gsba.geometry import inverse, relative_steps
from gsba.log import GsbaError
from gsba.matching import guided_search, pairs
from gsba.matching.correspondences import SCARCE_MATCHES, verified
from gsba.matching.guided_search import PRIOR_GATE, Gate, MatchContext
from gsba.trajectory import clock, joining, judgement, misread, turning
from gsba.trajectory.clock import ClockEstimate
from gsba.trajectory.joining import SegmentAlignment
from gsba.trajectory.judgement import StepChecks
from gsba.trajectory.limits import TwoViewLimits
from gsba.trajectory.steps import (
    Steps,
    chained,
    given_up,
    image_steps,
    length_ratios,
    matches_of_steps,
    off_steps,
    ray_depths,
    step_errors,
    without_steps,
)
from gsba.types import CoarsePoses, Counts, Keypoints, Trajectory, VerifiedPairs, rows_across

_MIN_LOST_SHARE = 0.2  # share of lost neighbours from which whole panoramas are compared
_MIN_COMMON_POINTS = 5  # common points that suffice for the ratio of two steps' lengths
_FAR_STEP_DEPTHS = 0.5  # steps from which repeated structure may mislead, median depths
_NUM_TRIED_STEPS = 24  # steps that show whether it does


@dataclass(frozen=True, slots=True)
class Recovered:
    """Neighbours in time, verified with or without the trajectory, and the checks of its steps."""

    neighbours: VerifiedPairs
    trust: StepChecks
    coarse: CoarsePoses  # the trajectory, its pieces in one world
    joints: tuple[SegmentAlignment, ...] = ()  # alignments of those pieces

    @property
    def counts(self) -> Counts:
        """Of pairs."""
        return self.neighbours.counts


def recover(
    context: MatchContext, guided: VerifiedPairs, coarse: CoarsePoses, timestamps: np.ndarray
) -> Recovered:
    """Match the neighbours that guided matching lost, check the trajectory, and match guided by it.

    Frames next to one another are compared without prediction: they share so much that repetition
    does not mislead. Frames so far apart that it does, two apart, or with a pause between them are
    only matched guided by the steps found or the trajectory.

    Frames of two pieces of the trajectory are not compared here. Two views do not determine a
    scale, and the points of both may move with the camera or be far away: the relative pose of two
    pieces is estimated by `gsba.loop_closure.map_merging`, from points that both maps hold.

    Args:
        guided: neighbours verified under the trajectory's guidance, see `unless_misguided`; all of
            them where it is right.
        timestamps: (F,) seconds.

    Raises:
        GsbaError: the images contradict most of the trajectory.
    """
    settings, keypoints = context.settings, context.keypoints
    chosen = _pairs_of_one_piece(pairs.adjacent(len(coarse.sources)), coarse)
    guided = guided.within(coarse.segments)
    close = _pairs_of_one_piece(pairs.without_pause(timestamps), coarse)
    lost = guided.missing(close)
    absent = coarse.absent
    pieces, (coarse, joints) = coarse, joining.join(coarse)
    found = match_anywhere(context, lost)
    alone = _all_neighbours(context, guided, found, pieces)
    steps = image_steps(alone, keypoints)
    misread.refuse_misfit(coarse, steps, TwoViewLimits.of(settings))
    if len(lost) and not absent and _misleads(context, guided):
        found = _match_along(context, _walked_on(pieces, lost, found, timestamps), lost)
        alone = _all_neighbours(context, guided, found, pieces)
        steps = image_steps(alone, keypoints)
    alone, guided = (_consistent(some, steps, keypoints, settings) for some in (alone, guided))
    trust = _check_steps(alone, keypoints, coarse, settings)
    if trust.sound and not joints:
        return Recovered(guided, trust, coarse)
    first = np.arange(len(steps.verified) - 1)
    if absent:
        first = first[steps.verified[:-1] & steps.verified[1:]]
    again = _pairs_of_one_piece(alone.missing(np.column_stack([first, first + 2])), coarse)
    over = _match_along(context, trust.world_T_rigs, again)
    neighbours = VerifiedPairs.joined([alone, _consistent(over, steps, keypoints, settings)])
    alike = judgement.confirmed(coarse, steps, settings.priors)
    doubtful = {
        (f0, f1)
        for f0, f1 in lost.tolist()
        if not (alike[f0] or _is_supported((f0, f1), neighbours, keypoints, absent))
    }
    if doubtful:
        frames = map(tuple, neighbours.matches.pairs.tolist())
        neighbours = neighbours.taken([p for p, pair in enumerate(frames) if pair not in doubtful])
        trust = _check_steps(neighbours, keypoints, coarse, settings)
    num, kept = len(chosen), len(neighbours.matches.pairs)
    counts = Counts(num, kept, "pairs", {"no common geometry": num - kept})
    neighbours = replace(neighbours, counts=counts)
    guessed = joining.guessed(joints, len(coarse.sources))
    guessed |= trust.unseen_steps & judgement.leaps(coarse.world_T_rigs, timestamps)
    trust = replace(trust, false_steps=trust.false_steps | guessed)
    return Recovered(neighbours, trust, coarse, joints)


def _all_neighbours(
    context: MatchContext, guided: VerifiedPairs, found: VerifiedPairs, coarse: CoarsePoses
) -> VerifiedPairs:
    """Neighbours found with and without guidance, and wider pairs where these are too short."""
    found = VerifiedPairs.joined([guided, found])
    found = _with_wider_pairs(context, found).within(coarse.segments)
    return _with_consistent_scale(context, found) if coarse.absent else found


def _misleads(context: MatchContext, guided: VerifiedPairs) -> bool:
    """True if matching without guidance often does not find the steps that guided matching knows.

    Only steps that are long in the distances of what they show are in danger. Repeated structure
    makes a step look too short: a quarter of the steps decides whether they are.
    """
    steps, lengths = list[int](), list[float]()
    for p, (f0, f1) in enumerate(guided.matches.pairs.tolist()):
        if f1 - f0 == 1 and np.isfinite(guided.direction_sigmas[p]):
            rays = context.keypoints.matched(guided.matches.pairs[p], guided.matches.of(p))
            depths = ray_depths(*rays, guided.f0_T_f1s[p])
            steps.append(p)
            lengths.append(1 / float(np.nanmedian(np.append(depths, np.inf))))
    if not steps or np.quantile(lengths, 0.75) < _FAR_STEP_DEPTHS:
        return False
    tried = rows_across(len(steps), _NUM_TRIED_STEPS)
    known = guided.taken([steps[n] for n in tried.tolist()])
    found = match_anywhere(context, known.matches.pairs)
    true, seen = (image_steps(some, context.keypoints) for some in (known, found))
    off = step_errors(true.f_T_nexts, seen)[1]
    agreeing = seen.verified & (
        off < np.deg2rad(TwoViewLimits.of(context.settings).max_direction_deg)
    )
    missed = np.count_nonzero(true.verified & ~agreeing)
    # at most .08 in flats, .33 and more in most halls of bays
    return bool(missed > 0.15 * len(tried))


def unless_misguided(
    context: MatchContext, guided: VerifiedPairs, coarse: CoarsePoses, timestamps: np.ndarray
) -> VerifiedPairs:
    """Guided neighbours; none of them where many are lost and most of the others have another pose
    without guidance, which explains more matches.

    A gate around a false prediction keeps the false matches that fit it: guided neighbours confirm
    a reversed trajectory.
    """
    guided = guided.within(coarse.segments)
    chosen = _pairs_of_one_piece(pairs.without_pause(timestamps), coarse)
    rows = np.flatnonzero(np.diff(guided.matches.pairs, axis=1)[:, 0] == 1)
    if not len(rows) or len(guided.missing(chosen)) <= _MIN_LOST_SHARE * len(chosen):
        return guided
    tried = rows_across(len(rows), _NUM_TRIED_STEPS)
    known = guided.taken(rows[tried].tolist())
    free = match_anywhere(context, known.matches.pairs)
    ours, theirs = (image_steps(some, context.keypoints) for some in (known, free))
    turned, off = step_errors(ours.f_T_nexts, theirs)
    verify, num = TwoViewLimits.of(context.settings), len(context.keypoints.starts) - 1
    other = turned > np.deg2rad(verify.max_rotation_deg)
    other |= ours.directed & theirs.directed & (off > np.deg2rad(verify.max_direction_deg))
    other &= matches_of_steps(free, num) > matches_of_steps(known, num)
    misguided = np.count_nonzero(other & ours.verified & theirs.verified)
    return guided.taken([]) if misguided > 0.5 * len(tried) else guided


def _walked_on(
    coarse: CoarsePoses, lost: np.ndarray, found: VerifiedPairs, timestamps: np.ndarray
) -> np.ndarray:
    """Poses (F, 4, 4) chained along the trajectory, at lost steps (P, 2) by pairs without it."""
    poses, intervals = coarse.world_T_rigs, np.diff(timestamps)
    steps = relative_steps(poses)
    steps[found.matches.pairs[:, 0], :3, :3] = found.f0_T_f1s[:, :3, :3]
    world_R_rigs = poses[0, :3, :3] @ chained(steps)[:, :3, :3]
    velocities = np.diff(poses[:, :3, 3], axis=0) / intervals[:, None]
    one_piece = _pairs_of_one_piece(pairs.adjacent(len(poses), 1), coarse)
    known = np.setdiff1d(one_piece[:, 0], lost[:, 0])
    for f in lost[:, 0].tolist() if len(known) else []:
        beside = [*known[known < f][-1:], *known[known > f][:1]]
        steps[f, :3, 3] = world_R_rigs[f].T @ velocities[beside].mean(axis=0) * intervals[f]
    return chained(steps)


def _with_wider_pairs(context: MatchContext, found: VerifiedPairs) -> VerifiedPairs:
    """Neighbours, and wider pairs over steps too short to tell translation from rotation."""
    for gap in 2, 4, 8:  # frames
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


def _pairs_of_one_piece(chosen: np.ndarray, coarse: CoarsePoses) -> np.ndarray:
    """Pairs (P, 2) whose frames belong to one piece of the trajectory."""
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
    """The trajectory's clock offset, at which it turns when the images do.

    A trajectory that fits in another convention is refused first: it may turn at other times.

    Args:
        guided: see `recover`. Where it lacks many neighbours, whole panoramas are matched: a wrong
            clock loses the turns, which determine it.
        coarse: the trajectory at the frames' times.
        timestamps: (F,) seconds.
        trajectory: all entries of its file.

    Raises:
        GsbaError: the trajectory is reversed, mirrored, inverted or in other axes, or its clock
            runs at another rate.
    """
    settings, chosen = context.settings, pairs.without_pause(timestamps)
    lost = guided.missing(chosen)
    if len(lost) > _MIN_LOST_SHARE * len(chosen):
        guided = VerifiedPairs.joined([guided, match_anywhere(context, lost)])
    steps = image_steps(guided, context.keypoints)
    misread.refuse_misread(coarse, steps, TwoViewLimits.of(settings))
    estimate = clock.estimate_clock(timestamps, steps, trajectory, coarse.time_offset)
    rate = clock.other_rate(timestamps, steps, trajectory, estimate)
    if rate is not None:
        raise GsbaError(
            f"the trajectory turns as the images do on a clock of {rate:.2g} times the rate of the "
            f"frames': correct its times, or the frames' (--fps), {misread.ADVICE}"
        )
    return estimate


def _match_along(
    context: MatchContext, world_T_rigs: np.ndarray, chosen: np.ndarray
) -> VerifiedPairs:
    """Match pairs (P, 2) guided by the start, and verify that they agree with it."""

    def match(some: np.ndarray, search: bool = False) -> VerifiedPairs:
        gates = [PRIOR_GATE] * len(some)
        found = context.match(some, world_T_rigs, gates, guided_only=search)
        f0_T_f1s = inverse(world_T_rigs[some[:, 0]]) @ world_T_rigs[some[:, 1]]
        return verified(found, gates, f0_T_f1s, np.zeros(len(some)), context)

    return _scarce_learned(context, chosen, match(chosen, search=True), match)


def match_anywhere(context: MatchContext, chosen: np.ndarray, rivals: bool = True) -> VerifiedPairs:
    """Match whole panoramas without any prediction, and verify their geometry.

    The strongest features are searched first, then all for pairs that these leave open; or a
    learned matcher gets these pairs and those with scarce matches.

    Args:
        chosen: (P, 2) frame indices.
        rivals: True if another pose that explains about as many matches speaks against a pair.
    """
    nowhere = np.tile(np.eye(4), (len(context.keypoints.starts) - 1, 1, 1))

    def match(some: np.ndarray, first: bool = False) -> VerifiedPairs:
        gates = [Gate.anywhere()] * len(some)
        found = context.match(some, nowhere, gates, strongest=first, guided_only=first)
        return verified(found, gates, None, None, context, rivals)

    found = match(chosen, first=True)
    if context.strongest is not context.frames and context.matcher is guided_search.guided:
        rest = found.missing(chosen)
        return VerifiedPairs.joined([found, match(rest)]) if len(rest) else found
    return _scarce_learned(context, chosen, found, match)


def _scarce_learned(
    context: MatchContext,
    chosen: np.ndarray,
    found: VerifiedPairs,
    match: Callable[[np.ndarray], VerifiedPairs],
) -> VerifiedPairs:
    """Pairs found by search; those of `chosen` (P, 2) that it lacks or has scarce matches of, by
    `match` with the learned matcher, where the run has one."""
    if context.matcher is guided_search.guided:
        return found
    enough = np.flatnonzero(np.diff(found.matches.offsets) >= SCARCE_MATCHES)
    found = found.taken(enough.tolist())
    rest = found.missing(chosen)
    return VerifiedPairs.joined([found, match(rest)]) if len(rest) else found


def match_again(context: MatchContext, found: VerifiedPairs, steps: set[int]) -> VerifiedPairs:
    """Match steps again with all keypoints along the epipolar lines found, and verify them anew.
    `steps`: first frames of the steps; each keeps the pose with more inliers."""
    chosen = [
        p
        for p, (f0, f1) in enumerate(found.matches.pairs.tolist())
        if f1 - f0 == 1 and f0 in steps and np.isfinite(found.direction_sigmas[p])
    ]
    better = []
    for p in chosen:
        poses = np.tile(np.eye(4), (len(context.keypoints.starts) - 1, 1, 1))
        poses[found.matches.pairs[p, 1]] = found.f0_T_f1s[p]
        # around relative poses estimated from few matches
        pair, gates = found.matches.pairs[p : p + 1], [Gate(np.deg2rad(1.5), 0.03, np.pi)]
        matches = context.match(pair, poses, gates, guided_only=True)
        again = verified(matches, gates, None, None, context, rivals=True)
        if len(again.matches.pairs) and len(again.matches.of(0)) > len(found.matches.of(p)):
            better.append((p, again))
    replaced = {p for p, _ in better}
    kept = found.taken([p for p in range(len(found.matches.pairs)) if p not in replaced])
    return VerifiedPairs.joined([kept, *(again for _, again in better)])


def _check_steps(
    found: VerifiedPairs, keypoints: Keypoints, coarse: CoarsePoses, settings: RefineSettings
) -> StepChecks:
    steps = image_steps(found, keypoints)
    logs, sigmas = _length_ratios(found, steps, keypoints, coarse.absent)
    moved, verify = steps.directed.any(), TwoViewLimits.of(settings)
    turn = None if moved else turning.prove(found, keypoints, verify)
    return judgement.check_steps(coarse, steps, logs, sigmas, verify, settings.priors, turn)


def _length_ratios(
    found: VerifiedPairs, steps: Steps, keypoints: Keypoints, absent: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Length ratios like those of `length_ratios`; without a trajectory fewer points suffice."""
    return length_ratios(found, steps, keypoints, _MIN_COMMON_POINTS if absent else None)


def _is_supported(
    pair: tuple[int, int], found: VerifiedPairs, keypoints: Keypoints, absent: bool
) -> bool:
    """True if a third frame confirms a step that no trajectory guided.

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


def _with_consistent_scale(context: MatchContext, found: VerifiedPairs) -> VerifiedPairs:
    """Neighbours, found without a trajectory, without steps that are many times too short, by
    points common to two steps.

    Where a floor's pattern is matched one tile further on, relative poses look right. One of the
    two steps is dropped there, and pairs over it: the map splits, and the test of joins may rejoin
    it. Steps that share too few points for a ratio of their lengths are first matched with all
    keypoints.
    """
    open_at = _frames_of_open_ratio(context, found)[0]
    found = match_again(context, found, {step for f in open_at for step in (f - 1, f)})
    matches = matches_of_steps(found, len(context.keypoints.starts) - 1)
    return without_steps(found, given_up(_frames_of_open_ratio(context, found)[1], matches))


def _frames_of_open_ratio(context: MatchContext, found: VerifiedPairs) -> tuple[set[int], set[int]]:
    """Frames between two steps of open or excessive ratio of lengths; and the latter alone."""
    steps = image_steps(found, context.keypoints)
    logs, sigmas = length_ratios(found, steps, context.keypoints, _MIN_COMMON_POINTS)
    rows = {int(f0): p for p, (f0, f1) in enumerate(found.matches.pairs) if f1 - f0 == 1}
    unknown, extreme = set[int](), set[int]()
    for f in range(1, len(steps.verified)):
        both = [rows[g] for g in (f - 1, f) if g in rows]
        if len(both) < 2 or not np.isfinite(found.direction_sigmas[both]).any():
            continue  # a break, or rotations on the spot
        before, after = (found.matches.of(p) for p in both)
        shared = len(np.intersect1d(before[:, 1], after[:, 0]))
        if shared >= SCARCE_MATCHES:
            continue
        if np.isinf(sigmas[f - 1]):
            unknown.add(f)
        elif abs(logs[f - 1]) > np.log(4.0):  # a repeated pattern exceeds it
            extreme.add(f)
    return unknown | extreme, extreme


def _consistent(
    found: VerifiedPairs, steps: Steps, keypoints: Keypoints, settings: RefineSettings
) -> VerifiedPairs:
    """Pairs without those over two steps that repeated structure contradicts, see `off_steps`."""
    off = off_steps(found, steps)
    # true pairs deviate by less than 1 degree, pairs of look-alike places by 10
    false = off > np.deg2rad(3.0)
    return found.taken(np.flatnonzero(~false).tolist()) if false.any() else found
