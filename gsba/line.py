"""The stages of one run: each stored under what it depends on, and counted for the report."""

import os
import uuid
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import TypeVar

import gtsam
import numpy as np

from gsba import adjust, cubemap, features, frontend, graph, tracks
from gsba.adjust import Adjustment
from gsba.config import RefineSettings
from gsba.log import GsbaError
from gsba.matching import SearchableFrames
from gsba.reconstruction import assemble
from gsba.store import PerFrame, RunStore, fingerprint
from gsba.types import (
    CoarsePoses,
    Counts,
    Features,
    FrameSet,
    Keypoints,
    Matches,
    Reconstruction,
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
        self.rig = cubemap.rig_for(frames, settings.cubemap)
        self.priors = graph.build(coarse.world_T_rigs, settings.priors)
        self.custom = None if extra_factors is None else uuid.uuid4().hex  # resumes nothing
        if extra_factors is not None:
            for factor in extra_factors(coarse):
                self.priors.add(factor)
        self.counts: dict[str, list[Counts]] = {}
        self.solutions: dict[str, Adjustment] = {}
        self.latest = "keypoints"  # the stage that the next one builds on
        paths = [path for group in frames.paths for path in group]
        inputs = [fingerprint(paths), fingerprint(frames.mask_paths), frames.timestamps.tolist()]
        start = [coarse.world_T_rigs.tolist(), settings.read]
        store.stage("frames", [inputs, start], lambda: frames, FrameSet)
        found = self._extract()
        self.keypoints = store.stage(
            "keypoints",
            None,
            lambda: features.gather(found[name] for name in frames.names),
            Keypoints,
            ["frames", "features"],
        )

        def load(frame: int) -> Features:
            return found[frames.names[frame]]

        self.searchable = SearchableFrames(load)
        self.strongest = SearchableFrames(load, settings.pairs.strongest_per_face)

    def _extract(self) -> PerFrame[Features]:
        """Features of every frame: image and mask are read, cut and released one at a time."""
        frames, settings = self.frames, self.settings
        features.keep_freed_memory()
        index = {name: f for f, name in enumerate(frames.names)}

        chosen, weights = settings.features, settings.features.weights
        if chosen.extractor == "sift":
            make_extractor, inputs = partial(features.SiftExtractor, chosen), None
        else:
            from gsba.learned import LearnedExtractor, check_weights

            check_weights(chosen)
            make_extractor = partial(LearnedExtractor, chosen)
            inputs = fingerprint([Path(weights or "")])

        def compute(name: str) -> Features:
            images, masks = cubemap.load(frames, index[name], self.rig)
            return features.extract(images, masks, self.rig, make_extractor())

        return self.store.per_frame(
            "features",
            [settings.cubemap, settings.features, inputs],
            {
                name: fingerprint([*frames.paths[f], frames.mask_paths[f]])
                for name, f in index.items()
            },
            compute,
            Features,
            num_threads=self.num_threads,
        )

    def start(self) -> Adjustment:
        """The coarse trajectory as a solution without points."""
        return adjust.start(self.coarse.world_T_rigs)

    def match_neighbours(self) -> VerifiedPairs:
        """Verified matches of frames next to one another in time."""
        pairs = self._stage(
            "neighbours",
            self._matching(),
            lambda: frontend.match_neighbours(
                self.searchable,
                self.strongest,
                self.keypoints,
                self.start(),
                self.settings,
                self.num_threads,
            ),
            VerifiedPairs,
        )
        self.counts["neighbours"] = [pairs.counts]
        if pairs.counts.kept == 0:
            reasons = ", ".join(f"{n} {why}" for why, n in pairs.counts.dropped.items() if n)
            raise GsbaError(
                f"no two neighbouring frames match ({pairs.counts.received} pairs: {reasons}): "
                "check that frames and trajectory are of the same recording and on one clock"
            )
        return pairs

    def match_loops(self, solved: Adjustment) -> VerifiedPairs:
        """Verified matches of frames that met the same place again."""
        pairs = self._stage(
            "loops",
            self._matching(),
            lambda: frontend.match_loops(
                self.searchable, self.keypoints, solved, self.settings, self.num_threads
            ),
            VerifiedPairs,
        )
        self.counts["loops"] = [pairs.counts]
        return pairs

    def match_along_epipolars(self, solved: Adjustment) -> Matches:
        """Matches of neighbours in time along their solved epipolar lines."""
        return self._stage(
            "adjacent",
            self._matching(),
            lambda: frontend.match_along_epipolars(
                self.searchable, solved, self.settings, self.num_threads
            ),
            Matches,
        )

    def match_known_points(self, name: str, solved: Adjustment, loops_closed: bool) -> Matches:
        """Matches of solved points in frames further apart."""
        return self._stage(
            name,
            self._matching(),
            lambda: frontend.match_known_points(
                self.searchable,
                self.keypoints,
                solved,
                self.settings,
                self.num_threads,
                loops_closed,
            ),
            Matches,
        )

    def solve(
        self, name: str, matches: Sequence[Matches], start: Adjustment, gates: Sequence[float]
    ) -> Adjustment:
        """Bundle adjustment in rounds over the tracks that matches make."""

        def compute() -> Adjustment:
            chained = tracks.run(matches, np.diff(self.keypoints.starts))
            return adjust.run(
                chained,
                self.keypoints,
                start,
                self.priors,
                self.rig,
                gates,
                self.settings,
                self.num_threads,
            )

        solved = self._stage(name, [self._solving(), gates], compute, Adjustment)
        self.counts[name] = [solved.landmarks.counts]
        self.solutions[name] = solved
        return solved

    def reconstruct(self, solved: Adjustment) -> Reconstruction:
        """Covariances, and everything back in the trajectory's world."""

        def compute() -> Reconstruction:
            covariances = adjust.pose_covariances(
                solved, self.priors, self.keypoints, self.rig, self.settings, self.num_threads
            )
            least = self.settings.rounds.min_observations
            return assemble(solved, covariances, self.keypoints, self.coarse, least)

        return self._stage("reconstruction", self._solving(), compute, Reconstruction)

    def _matching(self) -> list[object]:
        settings = self.settings
        return [settings.pairs, settings.matching, settings.verify, settings.seed]

    def _solving(self) -> list[object]:
        settings = self.settings
        relevant = [settings.triangulate, settings.rounds, settings.priors, settings.solver]
        return [*relevant, settings.factors, self.custom]

    def _stage(self, name: str, key: object, compute: Callable[[], T], returns: type[T]) -> T:
        """A stage that builds on the one before it."""
        result = self.store.stage(name, key, compute, returns, [self.latest])
        self.latest = name
        return result
