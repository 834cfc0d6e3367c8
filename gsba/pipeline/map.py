"""A map: a solution, and what belongs to it."""

from dataclasses import dataclass, replace

import numpy as np

from factors.sphere_field import SphereField
from gsba.bundle import stitching
from gsba.bundle.stitching import Stitching
from gsba.camera.rig import CubeRig
from gsba.splat.refinement import Move
from gsba.types import FrameSet, Keypoints, Solution


@dataclass(frozen=True, slots=True)
class Map:
    """Poses, points and what they are made of; optional stages give another one."""

    solution: Solution
    observed: Keypoints  # what it is made of, as observed
    frame_weights: np.ndarray  # (F,) float64, of each frame's pixels; below 1 they are doubted
    aligned: np.ndarray | None = None  # (N,) bool, observations that patches have confirmed
    stitching: Stitching | None = None  # with the field that corrects them; None = not looked for
    moves: tuple[Move, ...] = ()  # of the poses against a splat

    @classmethod
    def of(cls, solution: Solution, keypoints: Keypoints) -> "Map":
        """A solution of keypoints as features found them."""
        return cls(solution, keypoints, np.ones(len(solution.world_T_rigs)))

    @property
    def field(self) -> SphereField:
        """What is known of what stitching bends."""
        return SphereField.none() if self.stitching is None else self.stitching.field

    def keypoints(self, rig: CubeRig) -> Keypoints:
        """What it is made of, where it really points."""
        return stitching.corrected(self.observed, self.field, rig)

    def straightened(self, frames: FrameSet) -> FrameSet:
        """The frames, read without what stitching bends."""
        return replace(frames, correction=tuple(self.field.coefficients.tolist()))
