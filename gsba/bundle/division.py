"""Adjustments that may be cut into parts: what a division takes, without the arrays of its blocks.

`gsba.parts` implements it. Here is only the interface, as adjustments stand below it.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import gtsam
import numpy as np

from factors import RobustLoss, Term
from gsba.bundle.optimizer import OptimizeResult
from gsba.bundle.tracks import runs
from gsba.config import SolverSettings
from gsba.memory import release_mapped_files
from gsba.types import JointErrors, Landmarks

_CHUNK = 1 << 17  # observations whose residuals are made at a time: 20 MB


@dataclass(frozen=True, slots=True)
class DivisibleMap:
    """A map to be adjusted, whose residuals of landmarks are made a few at a time."""

    landmarks: Landmarks
    terms_of: Callable[[Landmarks], Sequence[Term]]  # terms of `factors` of some of the landmarks
    graph: gtsam.NonlinearFactorGraph  # of families
    values: gtsam.Values  # to start from: poses, and variables of families
    num_frames: int
    loss: RobustLoss  # of the observations

    @property
    def num_observations(self) -> int:
        """Number of observations."""
        return len(self.landmarks.tracks)

    def chunks(self) -> Iterator[tuple[np.ndarray, Sequence[Term]]]:
        """Landmarks (J, 3) and their terms, a few of them at a time."""
        landmarks = self.landmarks
        for points, _, own in runs(landmarks.tracks, _CHUNK):
            some = Landmarks(landmarks.points_world[points], own, landmarks.counts)
            yield some.points_world, self.terms_of(some)
            release_mapped_files()


class Division(Protocol):
    """Adjusts maps in parts."""

    def minimized(self, map_: DivisibleMap, settings: SolverSettings) -> OptimizeResult | None:
        """The result of `gsba.bundle.optimizer.optimize`; None = the map is not to be divided."""
        ...

    def covariances(
        self, map_: DivisibleMap, num_draws: int, seed: int
    ) -> tuple[np.ndarray, JointErrors] | None:
        """The result of `gsba.bundle.optimizer.marginal_covariances` for all poses; None = the map
        is not to be divided."""
        ...
