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
from gsba.config import SolverSettings
from gsba.types import JointErrors, Landmarks, Tracks

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
        tracks, points = self.landmarks.tracks, self.landmarks.points_world
        starts = np.searchsorted(tracks.points, np.arange(tracks.num_points + 1))
        first = 0
        while first < len(points):
            last = int(np.searchsorted(starts, starts[first] + _CHUNK, side="right")) - 1
            last = min(max(last, first + 1), len(points))
            rows = slice(starts[first], starts[last])
            own = Tracks(
                tracks.points[rows] - np.int32(first),
                tracks.frames[rows],
                tracks.keypoints[rows],
                last - first,
            )
            some = Landmarks(points[first:last], own, self.landmarks.counts)
            yield some.points_world, self.terms_of(some)
            first = last


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
