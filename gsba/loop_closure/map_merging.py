"""Map merging: parts of a map that no verified step connects, joined where they overlap.

Points that both know, of frames that look alike, give the similarity; single frames get their pose
from points of a map. Parts without overlap keep the trajectory's pose, or become maps of their own.
"""

import logging
from functools import partial
from itertools import combinations

import numpy as np

from gsba.geometry import angles_between, inverse, typical_length, unit
from gsba.loop_closure import join_evidence, loops
from gsba.loop_closure.break_crossing import Breaks, agreed, crossing
from gsba.loop_closure.connectivity import MIN_MAP_FRAMES, by_size
from gsba.loop_closure.join_evidence import GATE_RAD, FindingRates, Places
from gsba.loop_closure.join_test import JoinTest, Judged
from gsba.loop_closure.loops import Loop
from gsba.loop_closure.map_similarity import Meeting, Proposal, propose
from gsba.loop_closure.merged_map import Registered, carried, laid_out
from gsba.loop_closure.registration import resect
from gsba.loop_closure.retrieval import global_descriptors
from gsba.matching import pairs, recovery
from gsba.matching.absolute_pose import FoundPose
from gsba.matching.guided_search import Gate, MatchContext
from gsba.similarity import Sim3
from gsba.trajectory.judgement import long_steps, over_missing_frames
from gsba.trajectory.limits import TwoViewLimits
from gsba.types import Counts, Matches, Solution

logger = logging.getLogger(__name__)
_NUM_CANDIDATES = 3  # candidate places for each frame of a part; twice as many for a single frame
_NUM_MEETINGS = 24  # pairs of frames sharing the most points, to propose a similarity at each pace
_BREAK_REACH_FRAMES = 3  # frames from a break that are compared in any case
_MIN_UNIT_POINTS = 8  # least number of points by which a single frame's unit is known
_MAX_PACES = 3.0  # largest distance of a single frame from its neighbours, in median paces
# Largest angle between the verticals of two parts, besides the spread within each: of one
# recording, and of two, whose cameras may be held in another way.
_MAX_TILT_RAD, _MAX_TILT_BETWEEN_RAD = np.deg2rad(5.0), np.deg2rad(45.0)


def merge(
    context: MatchContext,
    solved: Solution,
    parts: np.ndarray,
    held: np.ndarray,
    seen: np.ndarray,
    timestamps: np.ndarray,
    absent: bool = True,
    recordings: np.ndarray | None = None,
) -> Registered:
    """Join the parts of a map where they overlap, and register single frames.

    Args:
        parts: (F,) int, see `gsba.loop_closure.connectivity.parted`.
        held: (F - 1,) bool, steps without matches whose pose the trajectory gives.
        seen: (F - 1,) bool, steps verified by images: they tie frames with too few points.
        timestamps: (F,) seconds.
        absent: True if there is no trajectory; then small maps are not joined.
        recordings: (F,) int, number of each frame's recording; None = there is one. Single frames
            do not join recordings.
    """
    # two small parts in rooms with one floor look like one place all around
    min_testable = 6 if absent else MIN_MAP_FRAMES
    owners = np.zeros(len(parts), np.int64) if recordings is None else recordings
    ties = held | seen
    joining = _Joining(context, solved, parts, held, ties, timestamps, min_testable, owners)
    component = 0
    while joining.begin(component):
        joining.grow()
        component += 1
    while joining.by_grown_maps():
        joining.grow()
    return joining.result()


class _Joining:
    """The growing map, and the similarity by which each frame was moved so far."""

    def __init__(
        self,
        context: MatchContext,
        solved: Solution,
        parts: np.ndarray,
        held: np.ndarray,
        ties: np.ndarray,
        timestamps: np.ndarray,
        min_testable: int,
        recordings: np.ndarray,
    ) -> None:
        num = len(parts)
        self.context, self.solved, self.parts = context, solved, parts
        self.held, self.ties = held, ties
        self.times, self.depth = timestamps, solved.median_depth()
        self.looks = global_descriptors(
            context.strongest, num, context.settings.seed, context.workers
        )
        self.poses = solved.world_T_rigs.copy()
        known = solved.points_by_keypoint(context.keypoints)
        self.own_known = [known[f] for f in range(num)]  # rig frames, units of their parts
        self.known = list(self.own_known)  # in the map's unit once moved there
        places = Places(solved.world_T_rigs, self.own_known)
        usual = partial(join_evidence.rates, context, places, parts)  # within the original parts
        self.test = JoinTest(
            context, self.poses, self.known, self.depth, recordings, lambda rows: usual(chosen=rows)
        )
        self.usual_anywhere: FindingRates | None = None
        self.min_testable = min_testable  # frames of a map that joins can be tested by
        self.recordings = recordings
        # Steps over which bays of a hall may be taken for one another.
        self.missing = over_missing_frames(timestamps, recordings)
        self.wide = self.missing | (long_steps(solved.world_T_rigs, self.depth) & ~ties)
        self.moves = [Sim3()] * num  # of each frame, from its part to the map
        self.components = np.full(num, -1)
        self.met, self.alone = np.zeros(num, bool), np.zeros(num, bool)
        self.reasons: dict[int, str] = {}  # why a part was not joined to the map
        # Parts and maps that were compared with a map: its first frame and size, and theirs.
        self.compared: set[tuple[int, int, int, int]] = set()
        self.current = 0

    def begin(self, component: int) -> bool:
        """Start a map from the largest free part; False if there is no such part."""
        free = self.components < 0
        sizes = np.bincount(self.parts[free], minlength=1)
        if not free.any() or (component > 0 and sizes.max() < MIN_MAP_FRAMES):
            return False
        base = free & (self.parts == int(np.argmax(sizes)))
        self.components[base], self.met[base], self.current = component, True, component
        return True

    def grow(self) -> None:
        """Move all parts to the map that can be."""
        while self.by_images() or self.by_ties():
            pass

    def by_grown_maps(self) -> bool:
        """Move one map to where it overlaps a larger one that it was not compared with while it
        grew; False if none does."""
        maps = [np.flatnonzero(self.components == c) for c in range(self.components.max() + 1)]
        order = sorted(range(len(maps)), key=lambda c: -len(maps[c]))
        for larger, smaller in combinations(order, 2):
            rows, inside = maps[smaller], maps[larger]
            if not self._is_new(rows, inside):
                continue
            self.current = larger
            move = self._similarity(int(self.parts[rows[0]]), rows, inside)
            if move is not None:
                self._carry(rows, move)
                self.components[self.components > smaller] -= 1
                self.current = int(self.components[inside[0]])
                return True
        return False

    def _is_new(self, rows: np.ndarray, inside: np.ndarray) -> bool:
        """True the first time that frames outside a map are compared with it."""
        both = int(rows[0]), len(rows), int(inside[0]), len(inside)
        new = both not in self.compared
        self.compared.add(both)
        return new

    def by_images(self) -> bool:
        """Move one more part to where it overlaps the map; False if none does."""
        inside = np.flatnonzero(self.components == self.current)
        free = self.components < 0
        for part in np.unique(self.parts[free]).tolist():
            rows = np.flatnonzero(free & (self.parts == part))
            if not self._is_new(rows, inside):
                continue
            if len(rows) >= MIN_MAP_FRAMES and any(np.isfinite(self.known[f]).any() for f in rows):
                move = self._similarity(part, rows, inside)
                if move is not None:
                    self._carry(rows, move)
                    self.met[rows] = True
                    return True
                continue
            if self._register_each(rows, inside):
                return True
        return False

    def by_ties(self) -> bool:
        """Move one more part along with the map to which the trajectory or a step ties it."""
        for f in np.flatnonzero(self.ties).tolist():
            for inner, outer in ((f, f + 1), (f + 1, f)):
                if self.components[inner] == self.current and self.components[outer] < 0:
                    part = int(self.parts[outer])
                    rows = np.flatnonzero((self.parts == part) & (self.components < 0))
                    if self._is_refuted(part, rows, self.moves[inner]):
                        continue
                    self._carry(rows, self.moves[inner])
                    return True
        return False

    def _is_refuted(self, part: int, rows: np.ndarray, move: Sim3) -> bool:
        """True if images contradict the pose of a part by the trajectory."""
        if len(rows) < MIN_MAP_FRAMES:
            return False
        inside = np.flatnonzero(self.components == self.current)
        evidence = self.test.weigh(rows, inside, move)[0]
        if evidence.refuted:
            self.reasons[part] = f"images contradict its pose in the trajectory: {evidence}"
        return evidence.refuted

    def _carry(self, rows: np.ndarray, move: Sim3) -> None:
        self.poses[rows] = move.poses(self.poses[rows])
        for f in rows:
            self.known[f] = move.scale * self.known[f]
            self.moves[f] = move.after(self.moves[f])
        self.components[rows] = self.current

    def _candidates(self, rows: np.ndarray, inside: np.ndarray, looks: int) -> np.ndarray:
        """Pairs (P, 2) of a frame outside and one inside: similar descriptors, or next in time."""
        alike = self.looks[rows] @ self.looks[inside].T
        found = set()
        for n, f in enumerate(rows.tolist()):
            near = np.argsort(-alike[n])[:looks].tolist()
            after = int(np.searchsorted(inside, f))
            beside = [g for g in (after - 1, after) if 0 <= g < len(inside)]
            near += [g for g in beside if abs(int(inside[g]) - f) <= _BREAK_REACH_FRAMES]
            found |= {(f, int(inside[g])) for g in near}
        return np.array(sorted(found), np.int32).reshape(-1, 2)

    def _similarity(self, part: int, rows: np.ndarray, inside: np.ndarray) -> Sim3 | None:
        """The similarity that moves a part to where it overlaps the map; None = uncertain."""
        if len(inside) < self.min_testable and not self._is_held_by_trajectory(rows):
            self.reasons[part] = f"a map of {len(inside)} frames is too small to test a join"
            return None
        # Beside the first map there may be many: only what looks most like them is searched.
        first = self.current == 0 and self.components[rows[0]] < 0
        if not first:
            others = np.setdiff1d(np.arange(len(self.parts)), rows)
            nearest = np.argmax(self.looks[rows] @ self.looks[others].T, axis=1)
            if not np.isin(others[nearest], inside).any():
                return self._over_break(part, rows, inside)
        sampled = np.linspace(0, len(rows) - 1, 24).astype(int)
        sampled = rows[
            np.unique([*sampled, *range(_BREAK_REACH_FRAMES), *range(-_BREAK_REACH_FRAMES, 0)])
        ]
        chosen = self._candidates(sampled, inside, _NUM_CANDIDATES)
        meetings = self._meetings(self.context.of_strongest(), chosen)
        found = self._best(part, meetings, rows, inside)
        if meetings and found is None:  # perhaps too few: search around the best
            around = self._around(meetings, rows, inside, chosen)
            meetings += self._meetings(self.context.by_search(), around)
            found = self._best(part, meetings, rows, inside)
        return found or self._over_break(part, rows, inside)

    def _best(
        self, part: int, meetings: list[Meeting], rows: np.ndarray, inside: np.ndarray
    ) -> Sim3 | None:
        """The similarity that surroundings confirm, unless they confirm a rival too."""
        weighed: list[Judged] = []
        for proposal in propose(meetings, self.poses, self.depth, self.context.settings.seed):
            if self._is_held_by_trajectory(rows) and not self._plausible(proposal):
                continue
            judged = self.test.judge(proposal, rows, inside, weighed)
            if judged and self._is_level(rows, inside, judged.proposal.move):
                weighed.append(judged)
        if not weighed:
            self.reasons[part] = "no frame of it shares enough points with a frame of another map"
            return None
        accepted = [one for one in weighed if one.evidence.confirmed]
        if not accepted:  # of the likely ones, look-alikes are elsewhere or turned about at breaks
            on = self._breaks(rows, inside).continued_by
            accepted = [one for one in weighed if one.evidence.likely and on(one.proposal.move)]
        best = max(accepted or weighed, key=lambda one: one.evidence.margin())
        frames, why = best.proposal.frames, best.evidence
        logger.info("a part of %d frames overlaps the map at frames %s: %s", len(rows), frames, why)
        if accepted and not self.test.rivals(best, accepted):
            return self._at_pace(best, rows, inside).proposal.move
        self.reasons[part] = "it fits two places" if accepted else f"not certain: {why}"
        return None

    def _at_pace(self, found: Judged, rows: np.ndarray, inside: np.ndarray) -> Judged:
        """The proposal found, or one at the usual pace unless its surroundings speak against it."""
        breaks = self._breaks(rows, inside)
        held = self._is_held_by_trajectory(rows)  # which knows more than the pace
        if held or not breaks.steps or breaks.continued_by(found.proposal.move):
            return found
        meetings, usual = list[Meeting](), list[Judged]()
        for move in breaks.at_usual_pace(found.proposal.move):
            met = self.test.meetings(self.test.weigh(rows, inside, move)[1], rows)
            meetings += sorted(met, key=lambda one: -len(one.own))[:_NUM_MEETINGS]
        for proposal in propose(meetings, self.poses, self.depth, self.context.settings.seed):
            one = self.test.judge(proposal, rows, inside, usual)
            if (
                one
                and not one.evidence.doubted
                and breaks.continued_by(one.proposal.move)
                and self._is_level(rows, inside, one.proposal.move)
            ):
                usual.append(one)
        return max(usual, key=lambda one: one.evidence.margin(), default=found)

    def _breaks(self, rows: np.ndarray, inside: np.ndarray) -> Breaks:
        """Breaks between a part and the map without a pause."""
        steps = self._next_in_time(rows, inside, pairs.MAX_INTERVALS)
        return Breaks(steps, rows, inside, self.poses, self.times)

    def _next_in_time(
        self, rows: np.ndarray, inside: np.ndarray, max_intervals: float
    ) -> list[tuple[int, int]]:
        """Neighbours in time of one recording, one of a part and one of the map; frames between
        that are in no map, as dark ones, count as missing. Intervals are compared with those of the
        recording, as others may have been taken at another rate."""
        mapped = np.bincount(self.parts)[self.parts] >= MIN_MAP_FRAMES
        mapped[rows] = mapped[inside] = True
        near = np.zeros((0, 2), np.int64)
        for number in np.unique(self.recordings[rows]):
            shown = np.flatnonzero(mapped & (self.recordings == number))
            if len(shown) > 1:
                own = shown[pairs.without_pause(self.times[shown], max_intervals)]
                near = np.concatenate([near, own, own[:, ::-1]])
        near = near[np.isin(near[:, 0], rows) & np.isin(near[:, 1], inside)]
        return sorted(((int(f), int(g)) for f, g in near), key=min)

    def _over_break(self, part: int, rows: np.ndarray, inside: np.ndarray) -> Sim3 | None:
        """The similarity on which pairs of frames across a short break or pause agree, or None.

        A camera that walks on cannot have moved far in between, but a bay of a hall can be as near:
        what the surroundings do not confirm must continue the map at its pace.
        """
        for outer, inner in self._next_in_time(rows, inside, 6.0):  # median intervals
            earlier, later = (rows, inside) if outer < inner else (inside, rows)
            last = min(outer, inner)
            ends = (
                earlier[earlier <= last][-_BREAK_REACH_FRAMES:],
                later[later > last][:_BREAK_REACH_FRAMES],
            )
            chosen = np.array(
                [
                    (a, b)
                    for before, a in enumerate(ends[0][::-1], 1)
                    for after, b in enumerate(ends[1])
                    if before + after <= _BREAK_REACH_FRAMES
                ]
            )
            found = recovery.match_anywhere(self.context, chosen)
            given = found, self.context.keypoints, self.poses, self.known, rows
            proposals = crossing(*given), self.poses, self.depth
            best, by_two = agreed(*proposals), False
            if best is None and abs(outer - inner) == 1 and not self.missing[last]:
                best, by_two = agreed(*proposals, (outer, inner)), True
            if best is None or (self._is_held_by_trajectory(rows) and not self._plausible(best)):
                continue
            own, theirs = ends if outer < inner else ends[::-1]
            evidence = self.test.weigh(own, theirs, best.move)[0]
            logger.info(
                "a part of %d frames continues the map across a break: %s", len(rows), evidence
            )
            judged = self._at_pace(Judged(best, evidence), rows, inside)
            evidence, move = judged.evidence, judged.proposal.move
            here = Breaks([(outer, inner)], rows, inside, self.poses, self.times)
            likely = evidence.likely and not by_two
            if likely or (not evidence.doubted and here.continued_by(move)):
                return move
            self.reasons[part] = f"not certain: {evidence}"
        return None

    def _is_level(self, rows: np.ndarray, inside: np.ndarray, move: Sim3) -> bool:
        """True if a part stands upright on the map, within the spread of the frames' verticals."""
        own = inside[np.isin(self.recordings[inside], self.recordings[rows])]
        limit = _MAX_TILT_RAD if len(own) else _MAX_TILT_BETWEEN_RAD
        inside = own if len(own) else inside
        down, theirs = self.poses[rows, :3, 1] @ move.rotation.T, self.poses[inside, :3, 1]
        means = [unit(axes.mean(axis=0)) for axes in (down, theirs)]
        spreads = [
            np.sqrt(np.mean(angles_between(axes, mean) ** 2))
            for axes, mean in zip((down, theirs), means, strict=True)
        ]
        return bool(angles_between(means[0], means[1]) < limit + 3 * np.hypot(*spreads))

    def _meetings(self, context: MatchContext, chosen: np.ndarray) -> list[Meeting]:
        """Matched points that both frames of pairs (P, 2) know, one of them outside the map."""
        verified = recovery.match_anywhere(context, np.sort(chosen, axis=1), rivals=False)
        return self.test.meetings(verified.matches, chosen[:, 0])

    def _around(
        self, meetings: list[Meeting], rows: np.ndarray, inside: np.ndarray, chosen: np.ndarray
    ) -> np.ndarray:
        """Pairs (P, 2) not yet compared, beside the two meetings with the most points."""
        best = sorted(meetings, key=lambda meeting: -len(meeting.own))[:2]
        reach = range(-_BREAK_REACH_FRAMES + 1, _BREAK_REACH_FRAMES)
        found = {(m.f + i, m.g + j) for m in best for i in reach for j in reach}
        free, taken = set(rows.tolist()), set(inside.tolist())
        found = {(f, g) for f, g in found if f in free and g in taken}
        found -= {(int(f), int(g)) for f, g in chosen}
        return np.array(sorted(found), np.int32).reshape(-1, 2)

    def _is_held_by_trajectory(self, rows: np.ndarray) -> bool:
        """True if the trajectory ties a part to the map."""
        inside = self.components == self.current
        outside = np.zeros(len(self.parts), bool)
        outside[rows] = True
        return bool((self.held & ((inside[1:] & outside[:-1]) | (inside[:-1] & outside[1:]))).any())

    def _plausible(self, proposal: Proposal) -> bool:
        """True if a proposal needs no more drift than the trajectory can have."""
        (f, g), poses, settings = proposal.frames, self.poses, self.context.settings
        ends = {g: poses[g], f: proposal.move.poses(poses[f])}
        first, last = sorted(ends)
        step = inverse(ends[first]) @ ends[last]
        loop = Loop(first, last, step, proposal.support)
        even = abs(np.log(proposal.move.scale)) < np.log(
            TwoViewLimits.of(settings).max_length_ratio
        )
        return even and loops.within_drift(
            loop, poses, self.depth, self.held, self.context.far_drift
        )

    def _register_each(self, rows: np.ndarray, inside: np.ndarray) -> bool:
        """True if any frame gets a pose from points of the map; those next to it come first."""
        num, away = len(inside), np.abs(rows[:, None] - inside).min(axis=1)
        for f in rows[np.argsort(away, kind="stable")].tolist():
            # A picture that hangs in two places gives a single frame a pose in either. Between
            # frames of one recording time and path decide; between recordings, the test of joins.
            of_map = self.recordings[self.components == self.current] == self.recordings[f]
            if of_map.any() and self._register(f, inside):
                inside = np.sort(np.append(inside, f))
        return len(inside) > num

    def _register(self, f: int, inside: np.ndarray) -> bool:
        """True if a single frame gets an accepted pose from points of the map, and joins it."""
        chosen = self._candidates(np.array([f]), inside, 2 * _NUM_CANDIDATES)
        for strongest in (True, False):
            rows, points = self._sightings(f, chosen, strongest)
            found = self._resected(f, rows, points)
            if found is None:
                continue
            world_T_rig = self._resected_at_pace(f, inside, found.world_T_rig)
            if world_T_rig is not None and self._shows_map(f, inside, world_T_rig):
                seen = found.inliers
                unit = self._unit_of(f, rows[seen], points[seen] - world_T_rig[:3, 3])
                self.known[f] = unit * self.known[f]
                self.moves[f] = self._move_of(f, world_T_rig, unit if np.isfinite(unit) else 1.0)
                self.poses[f] = world_T_rig
                self.components[f] = self.current
                self.met[f] = self.alone[f] = True
                return True
        return False

    def _resected(self, f: int, rows: np.ndarray, points: np.ndarray) -> FoundPose | None:
        """Accepted pose of a frame whose keypoints (m,) may observe points (m, 3)."""
        if len(rows) == 0:
            return None
        settings, bearings = self.context.settings, self.context.keypoints.bearings_of(f)[rows]
        found = resect(bearings, points, TwoViewLimits.of(settings), settings.seed)
        return found if found and self._in_reach(f, found.world_T_rig) else None

    def _resected_at_pace(self, f: int, inside: np.ndarray, found: np.ndarray) -> np.ndarray | None:
        """The pose (4, 4) found, or one at the usual pace; None if wide steps leave both unsure."""
        rows, move = np.array([f]), self._move_of(f, found)
        breaks = self._breaks(rows, inside)
        if breaks.continued_by(move) or self._is_held_by_trajectory(rows):
            return found
        steps = [min(step) for step in breaks.steps] or [max(f - 1, 0), min(f, len(self.wide) - 1)]
        if not self.wide[steps].any():
            return found
        poses, best, most = self.poses.copy(), None, 0
        for moved in breaks.at_usual_pace(move):
            poses[f] = moved.poses(self.poses[rows])[0]
            near = np.argsort(np.linalg.norm(poses[inside, :3, 3] - poses[f, :3, 3], axis=1))
            near = inside[near[: 2 * _NUM_CANDIDATES]]
            chosen = np.column_stack([near, np.full(len(near), f)])
            gates = [Gate.around_points(GATE_RAD)] * len(chosen)
            matches = self.context.match(chosen, poses, gates, self.known, guided_only=True)
            other = self._resected(f, *_each_once(*self._points_seen(matches, 1), self.depth))
            if other is None or other.inliers.sum() <= most:
                continue
            if breaks.continued_by(self._move_of(f, other.world_T_rig)):
                best, most = other.world_T_rig, int(other.inliers.sum())
        return best

    def _unit_of(self, f: int, rows: np.ndarray, offsets: np.ndarray) -> float:
        """Length in the map of a unit of a frame's own points, by offsets (m, 3) to the map's
        points that its keypoints (m,) observe; NaN where few are points of its own."""
        ratios = np.linalg.norm(offsets, axis=1) / np.linalg.norm(self.known[f][rows], axis=1)
        ratios = ratios[np.isfinite(ratios)]
        return float(np.median(ratios)) if len(ratios) >= _MIN_UNIT_POINTS else np.nan

    def _move_of(self, f: int, world_T_rig: np.ndarray, scale: float = 1.0) -> Sim3:
        stretched = self.poses[f].copy()
        stretched[:3, 3] *= scale
        return Sim3.of(scale, world_T_rig @ inverse(stretched))

    def _shows_map(self, f: int, inside: np.ndarray, world_T_rig: np.ndarray) -> bool:
        """True unless a frame shows next to nothing of the map around, as at a look-alike poster.

        One that is not next to the map in time must show as much as a place of the map does.
        """
        poses = self.poses.copy()
        poses[f] = world_T_rig
        if self.usual_anywhere is None:
            places = Places(self.solved.world_T_rigs, self.own_known)
            usual = join_evidence.rates(self.context, places, self.parts, surfaces=False)
            self.usual_anywhere = usual
        groups, places = (np.array([f]), inside), Places(poses, self.known)
        given = self.context, places, groups, self.usual_anywhere, self.depth
        evidence = join_evidence.weigh(*given, surfaces=False)[0]
        beside = self._breaks(groups[0], inside).steps
        return not evidence.absent if beside else evidence.likely

    def _sightings(
        self, f: int, chosen: np.ndarray, strongest: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Keypoints (m,) of a frame and the map points (m, 3) that each may observe."""
        nowhere = np.tile(np.eye(4), (len(self.parts), 1, 1))
        gates = [Gate.anywhere()] * len(chosen)
        found = self.context.by_search().match(chosen, nowhere, gates, strongest=strongest)
        return _each_once(*self._points_seen(found, 0), self.depth)

    def _points_seen(self, matches: Matches, column: int) -> tuple[np.ndarray, np.ndarray]:
        """Keypoints (m,) of the frame in one column, and points (m, 3) that others observe."""
        rows, points = [np.zeros(0, np.int32)], [np.zeros((0, 3))]
        for p, pair in enumerate(matches.pairs.tolist()):
            matched, g = matches.of(p), pair[1 - column]
            known = self.known[g][matched[:, 1 - column]]
            seen = np.isfinite(known).all(axis=1)
            rows.append(matched[seen, column])
            points.append(known[seen] @ self.poses[g, :3, :3].T + self.poses[g, :3, 3])
        return np.concatenate(rows), np.concatenate(points)

    def _in_reach(self, f: int, world_T_rig: np.ndarray) -> bool:
        """True if a frame is within reach of its neighbours in time."""
        inside = np.flatnonzero(self.components == self.current)
        lengths = np.linalg.norm(np.diff(self.poses[inside, :3, 3], axis=0), axis=1)
        pace = typical_length(lengths / np.diff(self.times[inside]))
        after = int(np.searchsorted(inside, f))
        for n in (after - 1, after):
            if 0 <= n < len(inside):
                g = inside[n]
                off = np.linalg.norm(world_T_rig[:3, 3] - self.poses[g, :3, 3])
                if off > _MAX_PACES * pace * abs(self.times[f] - self.times[g]) + self.depth:
                    return False
        return True

    def result(self) -> Registered:
        """The map as it is, each in the world of its earliest part; lost frames beside the one
        before."""
        # Move each map back to the world that its earliest part had before parts were joined
        for component in range(int(self.components.max()) + 1):
            rows = np.flatnonzero(self.components == component)
            parts = rows[self.met[rows] & ~self.alone[rows]]
            back = self.moves[int(parts[0])].inverse()
            self.poses[rows] = back.poses(self.poses[rows])
            for f in rows:
                self.moves[f] = back.after(self.moves[f])
        lost, maps = self.components < 0, int(self.components.max()) + 1
        for n, f in enumerate(np.flatnonzero(lost).tolist()):
            placed = np.flatnonzero(~lost)
            nearest = int(placed[np.argmin(np.abs(placed - f))])
            self.components[f] = maps + n
            self.moves[f] = self.moves[nearest]
            self.poses[f] = self.moves[f].poses(self.poses[f])
        reasons = self._reasons(order := by_size(self.components))
        reach = pairs.MAX_BASELINE_DEPTHS * self.depth
        offsets = laid_out(self.poses[:, :3, 3], order, reach)
        poses = self.poses.copy()
        poses[:, :3, 3] += offsets
        scales = np.array([move.scale for move in self.moves])
        moves = np.array([move.new_T_old for move in self.moves])
        num, alone = int(self.parts.max()) + 1, len(np.unique(self.parts[lost]))
        dropped = {"frames alone": alone, "apart": maps - 1}
        kept = num - maps - alone
        return Registered(
            carried(self.solved, poses, scales, moves, offsets),
            order.astype(np.int32),
            scales,
            moves,
            offsets,
            self.met,
            self.alone,
            lost,
            Counts(num - 1, kept, "parts", dropped),
            reasons,
        )

    def _reasons(self, order: np.ndarray) -> tuple[str, ...]:
        """Why each map, by each frame's number (F,), was not joined to a larger one."""
        first = np.unique(order, return_index=True)[1]
        return tuple(
            "" if f == first[0] else self.reasons.get(int(self.parts[f]), "") for f in first
        )


def _each_once(rows: np.ndarray, points: np.ndarray, depth: float) -> tuple[np.ndarray, np.ndarray]:
    """Sightings, keypoints (m,) and points (m, 3), without those that occur twice."""
    once = np.round(points / max(1e-6 * depth, 1e-12))
    _, first = np.unique(np.column_stack([rows, once]), axis=0, return_index=True)
    return rows[first], points[first]
