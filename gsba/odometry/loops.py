"""Places of one map that are met again, believed by the test that judges joins of maps."""

import logging
from dataclasses import dataclass, replace

import numpy as np

from gsba.geometry import inverse
from gsba.loop_closure import join_evidence, loops
from gsba.loop_closure.join_evidence import LOCAL
from gsba.loop_closure.join_evidence import Places as KnownPlaces
from gsba.loop_closure.join_test import JoinTest, Judged
from gsba.loop_closure.map_similarity import Meeting, Proposal, propose
from gsba.loop_closure.pose_graph import Loop
from gsba.loop_closure.retrieval import looks_of
from gsba.matching import recovery
from gsba.odometry.places import Places
from gsba.similarity import Sim3

logger = logging.getLogger(__name__)

_MAX_SCALE_DRIFT = 1.25  # of a map between two visits, either way
_MIN_POINTS = 6  # that both places of a pair know
_BESIDE = 4  # places from the ends of a meeting: others are a meeting of their own
_MAX_TRIED = 4  # proposals of one meeting that are weighed


@dataclass(frozen=True, slots=True)
class SimilarityLoop:
    """Two places of one map at which the same points are seen, and how one lies in the other."""

    first: int  # row of the earlier place
    second: int  # row of the later place
    first_T_second: Sim3  # carries the later rig, with its unit, into the earlier one
    share: float  # of what a true loop lets find again; see `JoinEvidence`


def find_loops(places: Places, unseen: np.ndarray) -> list[SimilarityLoop]:
    """Loops that appearance proposes, and that geometry and all that is around confirm.

    Args:
        places: of one map, in time order.
        unseen: (P - 1,) bool, steps between places that no image tells.
    """
    solved, context, num = places.solved, places.context, len(places.keyframes)
    looks = looks_of(context.strongest, num, context.settings.seed, context.workers)
    chosen = loops.candidates(looks, solved, unseen, context.settings)
    strongest = replace(context, frames=context.strongest)
    verified = recovery.match_anywhere(strongest, chosen, rivals=False)
    test = _join_test(places)
    none = np.zeros(0, np.int64)  # the later place of each pair is carried to the earlier one
    meetings = test.meetings(verified.matches, none, verified.f0_T_f1s)
    meetings = [found for found in meetings if len(found.own) >= _MIN_POINTS]
    judged = [
        one for group in _meeting_by_meeting(meetings) for one in _judged(group, places, unseen, test)
    ]
    kept = [one for one in judged if one.evidence.confirmed and not _rivals(one, judged, test)]
    for one in judged:
        logger.debug("a loop of places %s: %s", one.proposal.frames, one.evidence)
    return [_loop(one, solved.world_T_rigs) for one in kept]


def _join_test(places: Places) -> JoinTest:
    solved, context = places.solved, places.context
    by_keypoint = solved.points_by_keypoint(context.keypoints)
    frames = np.arange(len(places.keyframes))
    known = [by_keypoint[int(f)] for f in frames]

    def rates() -> join_evidence.Rates:
        beside = KnownPlaces(solved.world_T_rigs, known)
        return join_evidence.rates(context, beside, frames // (2 * LOCAL))

    return JoinTest(context, solved.world_T_rigs, known, solved.median_depth(), rates)


def _meeting_by_meeting(meetings: list[Meeting]) -> list[list[Meeting]]:
    """Pairs of places grouped with those beside them, around the pairs that share most points."""
    rest, groups = sorted(meetings, key=lambda m: -len(m.own)), list[list[Meeting]]()
    while rest:
        best = rest[0]
        near = [max(abs(m.f - best.f), abs(m.g - best.g)) <= _BESIDE for m in rest]
        groups.append([m for m, beside in zip(rest, near, strict=True) if beside])
        rest = [m for m, beside in zip(rest, near, strict=True) if not beside]
    return groups


def _judged(
    group: list[Meeting], places: Places, unseen: np.ndarray, test: JoinTest
) -> list[Judged]:
    """What the surroundings say of each similarity that a group of pairs proposes."""
    poses, seed = places.solved.world_T_rigs, places.context.settings.seed
    found = []
    for proposal in propose(group, poses, test.depth, seed)[:_MAX_TRIED]:
        if not _plausible(proposal, places, unseen):
            continue
        f, g = proposal.frames
        middle = (f + g + 1) // 2
        later, earlier = np.arange(middle, len(poses)), np.arange(middle)
        one = test.judge(proposal, later, earlier)
        if _plausible(one.proposal, places, unseen):
            found.append(one)
    return found


def _plausible(proposal: Proposal, places: Places, unseen: np.ndarray) -> bool:
    """Whether a loop asks for no more than the path between its places can have drifted."""
    if abs(np.log(proposal.move.scale)) > np.log(_MAX_SCALE_DRIFT):
        return False
    (f, g), poses = proposal.frames, places.solved.world_T_rigs
    g_T_f = inverse(poses[g]) @ proposal.move.poses(poses[f])
    loop = Loop(g, f, g_T_f, proposal.support)
    return loops.within_drift(loop, places.solved, unseen, places.context.settings)


def _rivals(one: Judged, judged: list[Judged], test: JoinTest) -> list[Judged]:
    """Other loops of the same stretch that would carry it elsewhere, and are no worse."""
    f, g = one.proposal.frames
    shared = [
        other
        for other in judged
        if min(abs(other.proposal.frames[0] - f), abs(other.proposal.frames[1] - g)) <= _BESIDE
    ]
    return test.rivals(one, shared)


def _loop(one: Judged, poses: np.ndarray) -> SimilarityLoop:
    (f, g), move = one.proposal.frames, one.proposal.move
    carried = inverse(poses[g]) @ move.poses(poses[f])
    return SimilarityLoop(g, f, Sim3.of(move.scale, carried), one.evidence.share)
