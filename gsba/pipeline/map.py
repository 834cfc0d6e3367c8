"""A map: a solution, and what belongs to it."""

from dataclasses import dataclass, replace

import numpy as np

from factors.sphere_field import SphereField
from gsba.bundle import stitching
from gsba.bundle.camera_system import CameraCovariances
from gsba.bundle.lens_axes import LensAxes
from gsba.bundle.lens_centres import LensCentres, StitchRadius
from gsba.bundle.readout import CameraEstimate
from gsba.bundle.self_calibration import SelfCalibration
from gsba.bundle.stitching import Stitching
from gsba.camera.lens import Lenses
from gsba.camera.rig import CubeRig
from gsba.splat.refinement import Move
from gsba.types import FrameSet, Keypoints, Solution


@dataclass(frozen=True, slots=True)
class Map:
    """Poses, points, their observations and the camera; optional stages replace it."""

    solution: Solution
    observed: Keypoints  # keypoints that it is made of, as pictures show them
    frame_weights: np.ndarray  # (F,) float64, of each frame's pixels; below 1 they are doubted
    aligned: np.ndarray | None = None  # (N,) bool, observations that patches have confirmed
    normals_rig: np.ndarray | None = None  # (N, 3) of the surfaces they show, 0 = unknown
    stitching: Stitching | None = None  # with the field that corrects them; None = not looked for
    centres: LensCentres | None = None  # of the lenses that see them; None = not looked for
    axes: LensAxes | None = None  # where these look; None = not looked for
    radius: StitchRadius | None = None  # what panoramas are stitched for; None = not looked for
    calibrated: SelfCalibration | None = None  # of raw pairs; None = not looked for
    readout: CameraEstimate | None = None  # how lenses are read; None = not looked for
    covariances: CameraCovariances | None = None  # with these unknown beside the poses
    moves: tuple[Move, ...] = ()  # of the poses against a splat

    @classmethod
    def of(
        cls,
        solution: Solution,
        keypoints: Keypoints,
        centres: LensCentres | None = None,
    ) -> "Map":
        """A solution of keypoints as features found them, and the lenses it was solved with."""
        weights = np.ones(len(solution.world_T_rigs))
        return cls(solution, keypoints, weights, centres=centres)

    def with_camera(self, readout: CameraEstimate) -> "Map":
        """The same seen by another camera."""
        if self.centres is None:
            return self
        lenses = readout.lenses
        centres = replace(self.centres, lenses=lenses, found=lenses.centre)
        return replace(self, centres=centres, readout=readout)

    @property
    def field(self) -> SphereField:
        """What is known of what stitching bends."""
        return SphereField.none() if self.stitching is None else self.stitching.field

    @property
    def lenses(self) -> Lenses:
        """What sees the observations."""
        return Lenses() if self.centres is None else self.centres.lenses

    def camera(self) -> CameraEstimate:
        """The camera."""
        if self.readout is None:
            return CameraEstimate(self.lenses, reason="not looked for")
        return replace(self.readout, lenses=self.lenses)

    def keypoints(self, rig: CubeRig) -> Keypoints:
        """What it is made of: where it really points, and from where."""
        return self.rays(self.observed, rig)

    def rays(self, keypoints: Keypoints, rig: CubeRig) -> Keypoints:
        """Keypoints as observed, where they really point, and from where."""
        return self.lenses.seen(stitching.corrected(keypoints, self.field, rig))

    def straightened(self, frames: FrameSet) -> FrameSet:
        """The frames, read without what stitching bends, raw pairs by what their lenses are."""
        if len(frames.formats) > 1:
            return frames
        fisheyes = self.lenses.fisheyes or frames.format.fisheyes
        correction = tuple(self.field.coefficients.tolist())
        return frames.with_formats(
            [replace(frames.format, correction=correction, fisheyes=fisheyes)]
        )
