"""The stages of a run that match its frames: each stored under what it depends on, and counted."""

import os
import uuid
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import TypeVar

import gtsam
import numpy as np

from gsba import learned
from gsba.bundle import prior_factors
from gsba.bundle.map_strength import MapStrength
from gsba.bundle.stitching import Stitching
from gsba.config import PriorSettings, RefineSettings
from gsba.features import detection, extraction
from gsba.frames import cubemap, panorama
from gsba.log import GsbaError
from gsba.loop_closure import connectivity, loops
from gsba.loop_closure.loops import Closed, connected
from gsba.loop_closure.merged_map import Registered, side_by_side
from gsba.matching import correspondences, recovery
from gsba.matching.guided_search import MatchContext, SearchableFrames
from gsba.matching.recovery import Recovered
from gsba.photometric import direct
from gsba.splat.refinement import Move
from gsba.store.store import PerFrame, RunStore, fingerprint
from gsba.trajectory.clock import ClockEstimate
from gsba.trajectory.joining import Joint
from gsba.trajectory.judgement import Trust
from gsba.types import (
    CoarsePoses,
    Counts,
    Features,
    FrameSet,
    Keypoints,
    Matches,
    PoseSource,
    Solution,
    VerifiedPairs,
)

ExtraFactors = Callable[[CoarsePoses], Iterable[gtsam.NonlinearFactor]]
T = TypeVar("T")

_DARK = 32  # of 255


class MatchingStages:
    """One run's inputs, its features, and a method for each stage that matches them."""

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
        direct.check(frames, settings)
        self.rig = cubemap.rig_for(frames, settings.cubemap)
        self.custom = None if extra_factors is None else uuid.uuid4().hex  # resumes nothing
        self.trust: Trust | None = None
        self.joints: tuple[Joint, ...] = ()  # of pieces of the trajectory
        self.parts: np.ndarray | None = None  # (F,) that nothing ties together yet
        self.registered: Registered | None = None
        self.clock: ClockEstimate | None = None
        self.strength: MapStrength | None = None  # of the map, by images alone
        self._make_extra = extra_factors or (lambda _: ())
        self.follow(coarse)
        self.counts: dict[str, list[Counts]] = {}
        self.solutions: dict[str, Solution] = {}
        self.undone: list[str] = []  # solutions that were not taken
        self.frame_weights = np.ones(len(frames))  # of each frame's pixels
        self.moves: tuple[Move, ...] = ()  # of the poses against a splat
        paths = [*(path for group in frames.paths for path in group), *frames.mask_paths]
        start = coarse.world_T_rigs.tolist(), settings.read
        inputs = [fingerprint(paths), frames.timestamps.tolist(), frames.timed, *start]
        store.stage("frames", inputs, lambda: frames, FrameSet)
        self._weights = learned.find_weights(settings)
        self._features = extraction.extract(
            store, frames, self.rig, settings, self.num_threads, *self._extractor(settings)
        )
        self._see("keypoints", [self._features] * len(frames), ["frames", "features"])
        self.stitching: Stitching | None = None  # with the field that corrects them, if any
        self.aligned: np.ndarray | None = None  # which of them patches have confirmed
        self.greys = panorama.Greys(frames, settings.align.max_width)
        matchers = (path for stage, path in self._weights.items() if stage == "matching")
        self.compared = fingerprint(matchers)

    def _see(self, name: str, found: list[PerFrame[Features]], before: list[str]) -> None:
        """Match the features of these stages, one a frame, from now on; `before`: their names."""
        frames, settings = self.frames, self.settings

        def load(frame: int) -> Features:
            return found[frame][frames.names[frame]]

        def gather() -> Keypoints:
            return detection.gather(map(load, range(len(frames))))

        self.keypoints = self.store.stage(name, None, gather, Keypoints, before)
        self.latest = name
        self.observed = self.keypoints  # those that the latest solution is made of, as observed
        self.context = MatchContext(
            SearchableFrames(load),
            SearchableFrames(load, settings.pairs.strongest_per_face),
            self.keypoints,
            settings,
            self.num_threads,
            learned.make_matcher(settings, self._weights, self.rig.size),
        )

    def _extractor(self, settings: RefineSettings):
        files = [path for stage, path in self._weights.items() if stage == "features"]
        return learned.make_extractor(settings.features, self._weights), files

    def extract_more(self, weak: np.ndarray) -> None:
        """More keypoints at some frames (F,) bool, and those of the others as they were."""
        closer, name = self.settings.closer, "features_closer"
        more = closer.model_dump(include={"max_per_face", "contrast_threshold"})
        enlarged = self.settings.features.model_copy(update=more)
        settings = self.settings.model_copy(update={"features": enlarged})
        given = self.store, self.frames, self.rig, settings, self.num_threads
        found = extraction.extract(*given, *self._extractor(settings), name, weak)
        sources = [found if more else self._features for more in weak]
        self._see("keypoints_closer", sources, [self.latest, name])

    def follow(self, coarse: CoarsePoses) -> None:
        """Start from these poses, and hold to them."""
        self.coarse, self.extra = coarse, list(self._make_extra(coarse))
        self._set_priors()

    def _hindrance(self) -> str:
        """What keeps frames from matching, as far as their pixels tell."""
        level = panorama.bright_level(self.greys)
        if level < _DARK:
            return (
                f"they are very dark (99 % of their pixels at or below {level} of 255): make them "
                "brighter; 12 bits in a 16-bit PNG must be scaled up to 16"
            )
        return "frames must follow one another closely and show texture"

    def _set_priors(self) -> None:
        """What the trajectory says, as far as it is trusted, and the caller's own factors."""
        self.priors = self._priors(self.settings.priors)

    def _priors(self, settings: PriorSettings) -> gtsam.NonlinearFactorGraph:
        """See `_set_priors`; with this noise of the trajectory, unless images told it."""
        coarse, trust, strength = self.coarse.world_T_rigs, self.trust, self.strength
        if trust is None:
            priors = prior_factors.build(coarse, settings)
        else:
            start = trust.world_T_rigs
            believed = start if trust.false_steps.all() else side_by_side(coarse, self.registered)
            false = (
                trust.false_steps if strength is None else trust.false_steps | strength.held_steps
            )
            noise = None if strength is None else strength.noise
            priors = prior_factors.build(
                believed, settings, false, trust.false_frames, start[0], noise
            )
        for factor in self.extra:
            priors.add(factor)
        return priors

    @property
    def turns_only(self) -> bool:
        """Whether the camera stayed in one place, as its images say."""
        return self.trust is not None and self.trust.turning_only

    def start(self) -> Solution:
        """The coarse trajectory, chained past its false steps, as a solution without points."""
        trusted = self.coarse if self.trust is None else self.trust
        return Solution.without_points(trusted.world_T_rigs)

    def match_neighbours(self, name: str = "neighbours") -> VerifiedPairs:
        """Verified matches of frames next to one another in time."""
        if (self.coarse.sources == PoseSource.NONE).all():
            return VerifiedPairs.none()
        pairs = self._stage(
            name,
            self._matching(),
            lambda: correspondences.match_neighbours(self.context, self.start()),
            VerifiedPairs,
        )
        self.counts[name] = [pairs.counts]
        return pairs

    def judge(self, guided: VerifiedPairs) -> VerifiedPairs:
        """Neighbours once more where the trajectory misled, which then loses those priors."""
        recovered = self._stage(
            "steps",
            [self._matching(), self.settings.priors],
            lambda: recovery.recover(self.context, guided, self.coarse, self.frames.timestamps),
            Recovered,
        )
        pairs = recovered.neighbours
        self.counts["steps"] = [pairs.counts]
        if len(pairs.matches.pairs) == 0:
            raise GsbaError(
                f"no two neighbouring frames match ({pairs.counts.received} pairs, with and "
                f"without the trajectory): {self._hindrance()}"
            )
        self.trust, self.coarse, self.joints = recovered.trust, recovered.coarse, recovered.joints
        self.parts = connectivity.parted(pairs.matches.pairs, self.trust.held_steps)
        if (self.coarse.sources == PoseSource.NONE).all():
            self.coarse = replace(self.coarse, world_T_rigs=self.trust.world_T_rigs)
        self._set_priors()
        return pairs

    def match_loops(self, solved: Solution, name: str = "loops") -> VerifiedPairs:
        """Verified matches of frames that met the same place again."""
        pairs = self._stage(
            name,
            self._matching(),
            lambda: correspondences.match_loops(self.context, solved),
            VerifiedPairs,
        )
        self.counts[name] = [pairs.counts]
        return pairs

    def close_loops(self, solved: Solution) -> tuple[VerifiedPairs, Solution]:
        """Matches of places met again, and the map, bent first where drift had hidden them."""
        loops = self.match_loops(solved)
        bent = self._meet_places(solved, loops)
        return (loops, solved) if bent is solved else (self.match_loops(bent, "loops2"), bent)

    def _meet_places(self, solved: Solution, near: VerifiedPairs) -> Solution:
        """The map bent so that places met again meet, where guided search could not reach them."""
        unseen, trust = np.zeros(len(self.frames) - 1, bool), self.trust
        unseen = trust.unseen_steps if trust and self.registered is None else unseen
        if connected(unseen, near.matches.pairs) and len(near.matches.pairs):
            return solved
        closed = self._stage(
            "places",
            self._matching(),
            lambda: loops.close(self.context, solved, unseen),
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

    def match_along_epipolars(self, solved: Solution, name: str = "adjacent") -> Matches:
        """Matches of neighbours in time along their solved epipolar lines."""
        compute = partial(correspondences.match_along_epipolars, self.context, solved)
        return self._stage(name, self._matching(), compute, Matches)

    def match_known_points(self, name: str, solved: Solution, loops_closed: bool) -> Matches:
        """Matches of solved points in frames further apart."""
        return self._stage(
            name,
            self._matching(),
            lambda: correspondences.match_known_points(self.context, solved, loops_closed),
            Matches,
        )

    def _matching(self) -> list[object]:
        settings = self.settings
        how = settings.matching.model_dump(exclude={"weights"}), self.compared
        return [settings.pairs, how, settings.verify, settings.seed]

    def _stage(self, name: str, key: object, compute: Callable[[], T], returns: type[T]) -> T:
        """A stage that builds on the one before it."""
        result = self.store.stage(name, key, compute, returns, [self.latest])
        self.latest = name
        return result
