"""Correspondences from poses: between neighbours in time, across loops, and with map points."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from gsba.geometry import inverse
from gsba.matching import pairs, verification
from gsba.matching.guided_search import MAX_PARALLAX_RAD, PRIOR_GATE, Gate, MatchContext
from gsba.matching.verification import RelativePose
from gsba.trajectory.limits import TwoViewLimits
from gsba.types import Matches, Solution, VerifiedPairs

# Gates in degrees are for exact directions: `gate_factor` of settings widens those of a solved map.
SCARCE_MATCHES = 60  # pairs with fewer are matched with all keypoints
_MIN_INLIER_RATIO = 0.5  # of a step's matches to its pose; others are matched with all keypoints
_LOOP_DEG = 2.0  # gate around a known point, added to drift
_MAX_JOIN_ERROR_RAD = np.deg2rad(4.0)  # largest error of a joined part's pose, as an angle at the
# median depth


def match_neighbours(context: MatchContext, start: Solution) -> VerifiedPairs:
    """Match neighbours in time, guided by the coarse poses, and verify them.

    Where many matches of a step disagree, repeated structure may have won with few: people walking
    along hide the evidence against it. Such steps are matched again with all keypoints.
    """
    world_T_rigs, settings = start.world_T_rigs, context.settings
    chosen = pairs.adjacent(len(world_T_rigs))

    # The strongest keypoints suffice for a pair's geometry, at a tenth of the cost.
    search = context.by_search()
    found = search.match(chosen, world_T_rigs, [PRIOR_GATE] * len(chosen), strongest=True)
    f0_T_f1s = inverse(world_T_rigs[chosen[:, 0]]) @ world_T_rigs[chosen[:, 1]]
    agreeing = partial(
        verification.agree_with_prior,
        prior_f0_T_f1s=f0_T_f1s,
        position_sigmas=np.zeros(len(chosen)),
        settings=TwoViewLimits.of(settings),
    )
    estimates = _estimates(found, [PRIOR_GATE] * len(chosen), context)
    neighbours = agreeing(found, estimates)
    scarce = np.diff(found.offsets) < SCARCE_MATCHES
    steps = chosen[:, 1] - chosen[:, 0] == 1
    index = {(int(f0), int(f1)): p for p, (f0, f1) in enumerate(found.pairs)}
    at = [index[int(f0), int(f1)] for f0, f1 in neighbours.matches.pairs]
    shares = np.zeros(len(found.pairs))
    shares[at] = np.diff(neighbours.matches.offsets)
    doubtful = steps & (shares / np.maximum(np.diff(found.offsets), 1) < _MIN_INLIER_RATIO)
    rows = np.flatnonzero(scarce | doubtful)
    if len(rows) == 0:
        return neighbours
    gates = [PRIOR_GATE] * len(rows)
    again = context.match(chosen[rows], world_T_rigs, gates)
    for p, estimate in zip(rows, _estimates(again, gates, context), strict=True):
        estimates[p] = estimate
    each = [found.of(p) for p in range(len(found.pairs))]
    for n, p in enumerate(rows):
        each[p] = again.of(n)
    return agreeing(Matches.of_rows(found.pairs, each), estimates)


def match_loops(context: MatchContext, solved: Solution) -> VerifiedPairs:
    """Match frames close in space but far in time, as far as drift leaves them predictable.

    Only known points are searched, within the distance from their predicted bearing that drift
    allows. Repeated structure in the distance, arches or columns, is further off than that. After
    so long a way that drift predicts nothing, all points of both frames are compared, and the
    nearest few frames are enough: the rest is found when the loop is closed.
    """
    positions, depth = solved.world_T_rigs[:, :3, 3], solved.median_depth()
    chosen = pairs.closing(positions, depth, context.settings.pairs)
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    along = np.concatenate([[0], np.cumsum(steps)])
    # relative to the path between two frames
    drifts = 0.003 * (along[chosen[:, 1]] - along[chosen[:, 0]])
    radii = np.deg2rad(_LOOP_DEG) + 2 * drifts / max(depth, 1e-12)
    # from 60 degrees on, a search is of all points: two frames suffice then
    few = pairs.thinned(chosen, radii > np.deg2rad(60.0), 2)
    gates = [Gate.around_points(radius) for radius in radii[few]]
    return _verified_known_points(context, solved, chosen[few], gates, drifts[few])


def match_along_epipolars(
    context: MatchContext, solved: Solution, maps: np.ndarray | None = None
) -> Matches:
    """Match neighbours in time again, along the epipolar lines of poses that are nearly right.

    Neighbours of different maps (F,), -1 = of none, are left out: repeated structure along the
    epipolar lines of a step that only the trajectory gives agrees on another length of it.
    """
    poses, settings = solved.world_T_rigs, context.settings
    # The solved map is right to 0.4 degrees of rotation and a direction of tangent 0.005.
    turn = np.deg2rad(settings.gate_factor * 0.4)
    chosen = pairs.adjacent(len(poses))
    if maps is not None:
        first, second = maps[chosen].T
        chosen = chosen[(first == second) | (np.minimum(first, second) < 0)]
    lengths = np.linalg.norm(poses[chosen[:, 1], :3, 3] - poses[chosen[:, 0], :3, 3], axis=1)
    apart = context.cameras.baseline  # a ray may start at either lens
    gates = [Gate(turn, 0.005 + apart / max(length, 1e-12), MAX_PARALLAX_RAD) for length in lengths]
    # A learned matcher adds nothing where poses are known this well.
    return context.match(chosen, poses, gates, guided_only=True)


def match_across(
    context: MatchContext, solved: Solution, parts: np.ndarray, met: np.ndarray
) -> VerifiedPairs:
    """Match frames of joined map parts (F,) that are close in space, and verify them; met: (F,)
    bool, frames whose part was joined by images, not by the trajectory alone. Known points are
    searched within the error of a join around their predicted bearing."""
    poses, depth = solved.world_T_rigs, solved.median_depth()
    chosen = np.concatenate(pairs.covisible(poses[:, :3, 3], depth, context.settings.pairs))
    chosen = chosen[(parts[chosen[:, 0]] != parts[chosen[:, 1]]) & met[chosen].all(axis=1)]
    gates = [Gate.around_points(_MAX_JOIN_ERROR_RAD)] * len(chosen)
    sigmas = np.full(len(chosen), _MAX_JOIN_ERROR_RAD * depth)
    return _verified_known_points(context, solved, chosen, gates, sigmas)


def _verified_known_points(
    context: MatchContext,
    solved: Solution,
    chosen: np.ndarray,
    gates: Sequence[Gate],
    sigmas: np.ndarray,
) -> VerifiedPairs:
    """Verified matches of chosen pairs (P, 2), of known points within each pair's gate; sigmas
    (P,) of their relative positions, map units."""
    poses = solved.world_T_rigs
    found = context.match(chosen, poses, gates, solved.points_by_keypoint(context.keypoints))
    f0_T_f1s = inverse(poses[chosen[:, 0]]) @ poses[chosen[:, 1]]
    return verified(found, gates, f0_T_f1s, sigmas, context)


def match_known_points(context: MatchContext, solved: Solution, loops_closed: bool) -> Matches:
    """Match frames further apart, around the predicted bearings of known points only; frames far
    apart in time are predictable where loops are closed. The prediction verifies the match:
    repeated structure elsewhere, such as the next column, is no candidate."""
    positions = solved.world_T_rigs[:, :3, 3]
    near, loops = pairs.covisible(positions, solved.median_depth(), context.settings.pairs)
    chosen = near[near[:, 1] - near[:, 0] > 2]
    if loops_closed:
        chosen = np.concatenate([chosen, loops])
    return _known_points_of(context, solved, chosen)


def match_known_points_across(
    context: MatchContext, solved: Solution, parts: np.ndarray
) -> Matches:
    """Match frames of different parts (F,) of a map around predicted bearings of known points."""
    positions = solved.world_T_rigs[:, :3, 3]
    chosen = pairs.across(positions, solved.median_depth(), context.settings.pairs, parts)
    return _known_points_of(context, solved, chosen)


def _known_points_of(context: MatchContext, solved: Solution, chosen: np.ndarray) -> Matches:
    """Matches of chosen pairs (P, 2) within 0.6 degrees of predicted bearings of known points."""
    gate = Gate.around_points(np.deg2rad(context.settings.gate_factor * 0.6))
    known = solved.points_by_keypoint(context.keypoints)
    # A learned matcher adds nothing where a point is known this well.
    return context.match(chosen, solved.world_T_rigs, [gate] * len(chosen), known, guided_only=True)


def verified(
    found: Matches,
    gates: Sequence[Gate],
    f0_T_f1s: np.ndarray | None,
    sigmas: np.ndarray | None,
    context: MatchContext,
    rivals: bool = False,
) -> VerifiedPairs:
    """Matches that fit one relative pose of their pair, which agrees with the prior: poses (P, 4,
    4) of the trajectory, of position sigmas (P,), map units; None = no prior. Gates are of each
    pair; for rivals see `verification.estimate_relative_poses`."""
    estimates = _estimates(found, gates, context, rivals)
    limits = TwoViewLimits.of(context.settings)
    return verification.agree_with_prior(found, estimates, f0_T_f1s, sigmas, limits)


def _estimates(
    found: Matches, gates: Sequence[Gate], context: MatchContext, rivals: bool = False
) -> list[RelativePose | None]:
    """The relative pose of each pair within its gate, without the trajectory as prior."""
    limits, seed = TwoViewLimits.of(context.settings), context.settings.seed
    chances = np.array([gate.chance(np.deg2rad(limits.max_error_deg)) for gate in gates])
    return verification.estimate_relative_poses(
        found, context.keypoints, limits, seed, context.workers, chances, rivals
    )


def match_for_rotations(context: MatchContext, world_T_rigs: np.ndarray) -> Matches:
    """Matches of frames near and far in time, around bearings predicted by their rotations."""
    num = len(world_T_rigs)
    gaps = 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128
    chosen = [(f, f + gap) for gap in gaps for f in range(num - gap)]
    pairs = np.array(chosen, np.int32).reshape(-1, 2)
    still = world_T_rigs.copy()
    still[:, :3, 3] = 0
    gates = [Gate.around_points(np.deg2rad(2.0))] * len(pairs)
    directions = [context.keypoints.bearings_of(f) for f in range(num)]
    return context.match(pairs, still, gates, directions)
