"""The stages of one run: each stored under what it depends on, and counted for the report."""

import os
import uuid
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import TypeVar

import gtsam
import numpy as np

from gsba import (
    adjust,
    align,
    components,
    cubemap,
    extraction,
    features,
    frontend,
    graph,
    panorama,
    parts,
    photometric,
    places,
    recovery,
    tracks,
)
from gsba.adjust import Adjustment
from gsba.config import RefineSettings
from gsba.log import GsbaError
from gsba.matching import MatchContext, SearchableFrames
from gsba.motion import Trust
from gsba.photometric import PhotometricResult
from gsba.places import Closed, connected
from gsba.reconstruction import assemble
from gsba.recovery import Recovered
from gsba.registered import Registered, follow, side_by_side
from gsba.segments import Joint
from gsba.store import RunStore, fingerprint
from gsba.types import (
    CoarsePoses,
    Counts,
    Features,
    FrameSet,
    Keypoints,
    Matches,
    PoseSource,
    Reconstruction,
    Sighted,
    VerifiedPairs,
)

ExtraFactors = Callable[[CoarsePoses], Iterable[gtsam.NonlinearFactor]]
T = TypeVar("T")


class Line:
    """One run's inputs, its features, and a method for each stage after them."""

    def __init__(
        self,
        store: RunStore,
        frames: FrameSet,
        coarse: CoarsePoses,
        settings: RefineSettings,
        extra_factors: ExtraFactors | None,
    ) -> None:
        self.store, self.frames, self.coarse, self.settings = store, frames, coarse, settings
        self.num_threads = settings.solver.num_threads or os.cpu_count() or 1
        photometric.check(frames, settings)
        self.rig = cubemap.rig_for(frames, settings.cubemap)
        self.custom = None if extra_factors is None else uuid.uuid4().hex  # resumes nothing
        self.extra = list(extra_factors(coarse)) if extra_factors is not None else []
        self.trust: Trust | None = None
        self.joints: tuple[Joint, ...] = ()  # of pieces of the trajectory
        self.parts: np.ndarray | None = None  # (F,) that nothing ties together yet
        self.registered: Registered | None = None
        self._set_priors()
        self.counts: dict[str, list[Counts]] = {}
        self.solutions: dict[str, Adjustment] = {}
        self.undone: list[str] = []  # solutions that were not taken
        self.frame_weights = np.ones(len(frames))  # of each frame's pixels
        self.latest = "keypoints"  # the stage that the next one builds on
        paths = [*(path for group in frames.paths for path in group), *frames.mask_paths]
        start = coarse.world_T_rigs.tolist(), settings.read
        inputs = [fingerprint(paths), frames.timestamps.tolist(), *start]
        store.stage("frames", inputs, lambda: frames, FrameSet)
        found = extraction.run(store, frames, self.rig, settings, self.num_threads)

        def load(frame: int) -> Features:
            return found[frames.names[frame]]

        def gather() -> Keypoints:
            return features.gather(map(load, range(len(frames))))

        before = ["frames", "features"]
        self.keypoints = store.stage("keypoints", None, gather, Keypoints, before)
        self.observed = self.keypoints  # those that the latest solution is made of
        self.aligned: np.ndarray | None = None  # which of them patches have confirmed
        self.greys = panorama.Greys(frames, settings.align.max_width)
        self.context = MatchContext(
            SearchableFrames(load),
            SearchableFrames(load, settings.pairs.strongest_per_face),
            self.keypoints,
            settings,
            self.num_threads,
        )

    def _set_priors(self) -> None:
        """What the trajectory says, as far as it is trusted, and the caller's own factors."""
        coarse, priors, trust = self.coarse.world_T_rigs, self.settings.priors, self.trust
        if trust is None:
            self.priors = graph.build(coarse, priors)
        else:
            start = trust.world_T_rigs
            believed = start if trust.false_steps.all() else side_by_side(coarse, self.registered)
            false = trust.false_steps, trust.false_frames
            self.priors = graph.build(believed, priors, *false, start[0])
        for factor in self.extra:
            self.priors.add(factor)

    def start(self) -> Adjustment:
        """The coarse trajectory, chained past its false steps, as a solution without points."""
        trusted = self.coarse if self.trust is None else self.trust
        return adjust.start(trusted.world_T_rigs)

    def match_neighbours(self) -> VerifiedPairs:
        """Verified matches of frames next to one another in time."""
        if (self.coarse.sources == PoseSource.NONE).all():
            return recovery.nothing_verified()
        pairs = self._stage(
            "neighbours",
            self._matching(),
            lambda: frontend.match_neighbours(self.context, self.start()),
            VerifiedPairs,
        )
        self.counts["neighbours"] = [pairs.counts]
        return pairs

    def judge(self, guided: VerifiedPairs) -> VerifiedPairs:
        """Neighbours once more where the trajectory misled, which then loses those priors."""
        recovered = self._stage(
            "steps",
            [self._matching(), self.settings.priors],
            lambda: recovery.run(self.context, guided, self.coarse, self.frames.timestamps),
            Recovered,
        )
        pairs = recovered.neighbours
        self.counts["steps"] = [pairs.counts]
        if len(pairs.matches.pairs) == 0:
            raise GsbaError(
                f"no two neighbouring frames match ({pairs.counts.received} pairs, with and "
                "without the trajectory): frames must follow one another closely and show texture"
            )
        self.trust, self.coarse, self.joints = recovered.trust, recovered.coarse, recovered.joints
        self.parts = components.parted(pairs.matches.pairs, self.trust.held_steps)
        if (self.coarse.sources == PoseSource.NONE).all():
            self.coarse = replace(self.coarse, world_T_rigs=self.trust.world_T_rigs)
        self._set_priors()
        return pairs

    def match_loops(self, solved: Adjustment, name: str = "loops") -> VerifiedPairs:
        """Verified matches of frames that met the same place again."""
        pairs = self._stage(
            name,
            self._matching(),
            lambda: frontend.match_loops(self.context, solved),
            VerifiedPairs,
        )
        self.counts[name] = [pairs.counts]
        return pairs

    def close_loops(self, solved: Adjustment) -> tuple[VerifiedPairs, Adjustment]:
        """Matches of places met again, and the map, bent first where drift had hidden them."""
        loops = self.match_loops(solved)
        bent = self._meet_places(solved, loops)
        return (loops, solved) if bent is solved else (self.match_loops(bent, "loops2"), bent)

    def _meet_places(self, solved: Adjustment, loops: VerifiedPairs) -> Adjustment:
        """The map bent so that places met again meet, where guided search could not reach them."""
        unseen, trust = np.zeros(len(self.frames) - 1, bool), self.trust
        unseen = trust.unseen_steps if trust and self.registered is None else unseen
        if connected(unseen, loops.matches.pairs) and len(loops.matches.pairs):
            return solved
        closed = self._stage(
            "places",
            self._matching(),
            lambda: places.run(self.context, solved, unseen),
            Closed,
        )
        self.counts["places"] = [closed.counts]
        if len(closed.pairs) == 0:
            return solved
        if self.trust is not None:  # places met again know better than a step no image shows
            false = self.trust.false_steps | unseen
            self.trust = replace(self.trust, false_steps=false)
            self._set_priors()
        return closed.solved

    def register(
        self, neighbours: VerifiedPairs, solved: Adjustment, matches: list[Matches]
    ) -> tuple[Adjustment, list[Matches]]:
        """Parts of the map joined where they meet, frames in none of them registered."""
        least, trust = self.settings.rounds.min_observations, self.trust
        if trust is None:
            return solved, matches
        nothing, scarce = np.zeros_like(trust.held_steps), components.starving(solved, least)
        tied = components.parted(neighbours.matches.pairs, nothing, scarce)
        if tied is None:
            return solved, matches
        given = self.context, solved, tied, trust.held_steps, ~trust.unseen_steps
        compute = partial(parts.run, *given, self.frames.timestamps)
        found = self._stage("registered", self._matching(), compute, Registered)
        self.counts["registered"] = [found.counts]
        self.registered, self.parts = found, components.several(found.components)
        self.coarse, self.trust, self.joints = follow(found, self.coarse, trust, self.joints)
        self._set_priors()
        adjacent = self.match_along_epipolars(found.solved, "adjacent2")
        return found.solved, [adjacent, *(components.within(m, tied) for m in matches[1:])]

    def match_along_epipolars(self, solved: Adjustment, name: str = "adjacent") -> Matches:
        """Matches of neighbours in time along their solved epipolar lines."""
        compute = partial(frontend.match_along_epipolars, self.context, solved)
        return self._stage(name, self._matching(), compute, Matches)

    def match_known_points(self, name: str, solved: Adjustment, loops_closed: bool) -> Matches:
        """Matches of solved points in frames further apart."""
        return self._stage(
            name,
            self._matching(),
            lambda: frontend.match_known_points(self.context, solved, loops_closed),
            Matches,
        )

    def solve(
        self,
        name: str,
        matches: Sequence[Matches],
        start: Adjustment,
        gates: Sequence[float],
        final: bool = False,
    ) -> Adjustment:
        """Bundle adjustment in rounds over the tracks that matches make."""

        def compute() -> Adjustment:
            tied = [components.within(some, self.parts) for some in matches]
            chained = tracks.run(tied, np.diff(self.keypoints.starts))
            return adjust.run(
                chained,
                self.keypoints,
                start,
                self.priors,
                self.rig,
                gates,
                self.settings,
                self.num_threads,
                final,
            )

        solved = self._stage(name, [self._solving(), gates, final], compute, Adjustment)
        self.counts[name] = [solved.landmarks.counts]
        self.solutions[name] = solved
        return solved

    def align(self, number: int, solved: Adjustment) -> Sighted:
        """Points observed anew by aligning patches."""
        name = f"align{number}"

        def compute() -> Sighted:
            return align.run(
                solved.landmarks,
                solved.world_T_rigs,
                self.observed,
                solved.noise,
                self.greys,
                self.rig,
                name,
                self.aligned,
                self.settings.align,
                self.num_threads,
            )

        key = self.settings.align.model_dump(exclude={"rounds"})
        sighted = self._stage(name, key, compute, Sighted)
        self.counts[name] = [sighted.counts]
        return sighted

    def solve_aligned(self, number: int, sighted: Sighted, before: Adjustment) -> Adjustment:
        """Bundle adjustment of aligned observations; undone where that explains less."""
        name, gates = f"aligned{number}", self.settings.rounds.aligned

        def compute() -> tuple[Adjustment, Keypoints]:
            return adjust.run_sighted(
                sighted, before, self.priors, self.rig, gates, self.settings, self.num_threads
            )

        key = [self._solving(), gates]
        solved, keypoints = self._stage(name, key, compute, tuple[Adjustment, Keypoints])
        self.counts[name] = [solved.landmarks.counts]
        self.solutions[name] = solved
        if not adjust.carries(solved, before, self.settings.rounds.min_observations):
            self.undone.append(name)
            return before
        self.observed, self.aligned = keypoints, sighted.aligned
        return solved

    def solve_photometric(self, solved: Adjustment) -> Adjustment:
        """Joint refinement by the observations so far and the grey values of patches."""
        name, settings = "photometric", self.settings

        def compute() -> PhotometricResult:
            given = self.frames, self.observed, solved, self.priors, self.rig
            return photometric.run(*given, settings, self.num_threads)

        key = [self._solving(), settings.photometric]
        result = self._stage(name, key, compute, PhotometricResult)
        self.counts[name], self.solutions[name] = list(result.counts), result.adjustment
        self.frame_weights = result.frame_weights
        return result.adjustment

    def reconstruct(self, solved: Adjustment) -> Reconstruction:
        """Covariances, and everything back in the trajectory's world."""

        def compute() -> Reconstruction:
            given = self.priors, self.observed, self.rig, self.settings, self.num_threads
            covariances = adjust.pose_covariances(solved, *given, self.parts)
            least = self.settings.rounds.min_observations
            false = None if self.trust is None else self.trust.false_frames
            given = self.observed, self.coarse, least, false, self.parts
            return assemble(solved, covariances, *given)

        return self._stage("reconstruction", self._solving(), compute, Reconstruction)

    def _matching(self) -> list[object]:
        settings = self.settings
        return [settings.pairs, settings.matching, settings.verify, settings.seed]

    def _solving(self) -> list[object]:
        settings = self.settings
        relevant = [settings.triangulate, settings.rounds, settings.priors, settings.solver]
        return [*relevant, [f for f in settings.factors if f != "photometric"], self.custom]

    def _stage(self, name: str, key: object, compute: Callable[[], T], returns: type[T]) -> T:
        """A stage that builds on the one before it."""
        result = self.store.stage(name, key, compute, returns, [self.latest])
        self.latest = name
        return result
