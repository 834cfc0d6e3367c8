"""The test of joins of maps and of loops: evidence from the frames around a meeting, and rivals."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gsba.loop_closure import join_evidence
from gsba.loop_closure.join_evidence import FindingRates, JoinEvidence, Places, around
from gsba.loop_closure.map_similarity import (
    Meeting,
    Proposal,
    alike,
    difference,
    meetings_of,
    refined,
)
from gsba.matching.guided_search import MatchContext
from gsba.similarity import Sim3
from gsba.types import Matches


@dataclass(frozen=True, slots=True)
class Judged:
    """A proposal refined with all points that both sides share around its meeting, and its
    evidence before the last, small step."""

    proposal: Proposal
    evidence: JoinEvidence


@dataclass(slots=True)
class JoinTest:
    """Frames, their points, and the usual rate at which points are found again."""

    context: MatchContext
    poses: np.ndarray  # (F, 4, 4) float64, changes while maps grow
    known: Sequence[np.ndarray]  # (F) of (K_f, 3): points of keypoints, rig frames; NaN = unknown
    depth: float  # median distance of points, map units
    owners: np.ndarray  # (F,) int, recording of each frame
    # Measures the rates at which points of frames (F,) bool are found again: those of the
    # recordings that meet, as rooms of others may show more or fewer of their points again.
    measure_rates: Callable[[np.ndarray], FindingRates]
    _usual: dict[tuple[int, ...], FindingRates] = field(default_factory=dict)
    # Proposals judged before, by their similarity and the frames compared. A part is tested again
    # whenever the map has grown; until it is joined, poses of these frames do not change.
    _tested: dict[tuple[object, ...], Judged] = field(default_factory=dict)

    def judge(
        self, proposal: Proposal, rows: np.ndarray, inside: np.ndarray, judged: Sequence[Judged]
    ) -> Judged | None:
        """Weigh a proposal to join frames (N,) and (M,), ascending; None if it leads to the place
        of one that is confirmed already."""
        known = [one.proposal for one in judged if one.evidence.confirmed]
        (f, g), (reach, wider_reach) = proposal.frames, (join_evidence.LOCAL, join_evidence.WIDER)
        near = around(rows, f, reach), around(inside, g, reach)
        far = around(rows, f, wider_reach), around(inside, g, wider_reach)
        found = self._judged(proposal, near, known)
        if found is None or found.evidence.confirmed or found.evidence.refuted:
            return found
        if all(map(np.array_equal, near, far)):
            return found
        # More frames give more evidence, if drift permits.
        wider = self._judged(found.proposal, far, known)
        return wider and max((found, wider), key=lambda one: one.evidence.margin())

    def rivals(self, best: Judged, others: Sequence[Judged]) -> list[Judged]:
        """Accepted proposals for another place that `best` does not significantly beat. Those of
        one place may differ by twice as much as two estimates of one join: drifting parts meet a
        little differently at either end."""
        return [
            other
            for other in others
            if not best.evidence.beats(other.evidence)
            if not alike(best.proposal, other.proposal, self.poses, self.depth, 2.0)
        ]

    def weigh(
        self, rows: np.ndarray, inside: np.ndarray, move: Sim3
    ) -> tuple[JoinEvidence, Matches]:
        """Evidence for a similarity that carries frames `rows`, and the points found again."""
        poses, known = self.poses.copy(), list(self.known)
        poses[rows] = move.poses(poses[rows])
        for f in rows:
            known[f] = move.scale * known[f]
        frames = np.concatenate([rows, inside])
        owners = np.unique(self.owners[frames])
        key = tuple(owners.tolist())
        if key not in self._usual:
            self._usual[key] = self.measure_rates(np.isin(self.owners, owners))
        usual, places = self._usual[key], Places(poses, known)
        return join_evidence.weigh(self.context, places, (rows, inside), usual, self.depth)

    def meetings(
        self, matches: Matches, outside: np.ndarray, f0_T_f1s: np.ndarray | None = None
    ) -> list[Meeting]:
        """Matched points that both frames of pairs know, one of them outside (N,); see
        `meetings_of`."""
        return meetings_of(self.known, matches, outside, f0_T_f1s)

    def _judged(
        self, proposal: Proposal, groups: Sequence[np.ndarray], known: Sequence[Proposal]
    ) -> Judged | None:
        """The proposal tested by frames of both sides; None if it leads to a known one's place."""
        (f, g), move = proposal.frames, proposal.move
        given = f, g, move.scale, move.new_T_old.tobytes(), *(rows.tobytes() for rows in groups)
        found = self._tested.get(given) or self._settled(proposal, groups, known)
        if found is None or self._leads_to(found.proposal, known):
            return None
        self._tested[given] = found
        return found

    def _settled(
        self, proposal: Proposal, groups: Sequence[np.ndarray], known: Sequence[Proposal]
    ) -> Judged | None:
        """The proposal refined until it settles; None once it leads to a known one's place."""
        rows, inside = groups
        evidence, found = self.weigh(rows, inside, proposal.move)
        # Points found again improve a proposal, and a better one finds other points again.
        for _ in range(8):
            again = self.meetings(found, rows)
            if not again:
                break
            move = refined(again, proposal.move, self.poses)
            off, turned, stretched = difference(proposal.move, move, self.poses[rows])
            proposal = replace(proposal, move=move)
            if self._leads_to(proposal, known):
                return None
            # of a bearing to a point at median depth
            if off / self.depth + turned + stretched < np.deg2rad(0.1):
                break
            evidence, found = self.weigh(rows, inside, move)
        return Judged(proposal, evidence)

    def _leads_to(self, proposal: Proposal, known: Sequence[Proposal]) -> bool:
        return any(alike(proposal, other, self.poses, self.depth) for other in known)
