"""A map: a solution, and what belongs to it."""

from dataclasses import dataclass, replace

import numpy as np

from factors.sphere_field import SphereField
from gsba.bundle import stitching
from gsba.bundle.camera_adjustment import CameraCovariances
from gsba.bundle.found_camera import FoundCamera
from gsba.bundle.readout import CameraEstimates
from gsba.bundle.stitching import Stitching
from gsba.camera.cameras import Cameras
from gsba.camera.rig import CubeRig
from gsba.splat.refinement import PoseMove
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
    cameras: tuple[FoundCamera, ...] = (FoundCamera(),)  # (C,)
    of_frame: tuple[int, ...] = ()  # (F,) camera of each frame, as in `Cameras`
    covariances: CameraCovariances | None = None  # with these unknown beside the poses
    moves: tuple[PoseMove, ...] = ()  # of the poses against a splat

    @classmethod
    def of(cls, solution: Solution, keypoints: Keypoints, frames: FrameSet) -> "Map":
        """A solution of keypoints as features found them, its cameras not looked for yet."""
        weights = np.ones(len(solution.world_T_rigs))
        cameras = (FoundCamera(),) * len(frames.formats)
        return cls(solution, keypoints, weights, cameras=cameras, of_frame=frames.camera_of_frame)

    def changed(self, camera: int, **changes: object) -> "Map":
        """The map with one camera changed."""
        cameras = list(self.cameras)
        cameras[camera] = replace(cameras[camera], **changes)  # type: ignore[arg-type]
        return replace(self, cameras=tuple(cameras))

    def with_cameras(self, found: CameraEstimates) -> "Map":
        """The same seen by other cameras."""
        pairs = zip(self.cameras, found.each, strict=True)
        return replace(self, cameras=tuple(one.with_estimate(own) for one, own in pairs))

    def estimates(self) -> CameraEstimates:
        """Estimate of each camera."""
        return CameraEstimates(tuple(one.estimate() for one in self.cameras), self.of_frame)

    @property
    def confirmed(self) -> np.ndarray:
        """Observations (N,) bool that patches have confirmed."""
        num = len(self.observed.faces)
        return np.zeros(num, bool) if self.aligned is None else self.aligned

    @property
    def normals(self) -> np.ndarray:
        """Normals (N, 3) float32 of the surfaces that observations show, 0 = unknown."""
        num, known = len(self.observed.faces), self.normals_rig
        return np.zeros((num, 3), np.float32) if known is None else known

    @property
    def field(self) -> SphereField:
        """What is known of what stitching bends."""
        return SphereField.none() if self.stitching is None else self.stitching.field

    @property
    def lenses(self) -> Cameras:
        """Lenses of all cameras."""
        return Cameras(tuple(one.lenses for one in self.cameras), self.of_frame)

    def keypoints(self, rig: CubeRig) -> Keypoints:
        """What it is made of: where it really points, and from where."""
        return self.rays(self.observed, rig)

    def rays(self, keypoints: Keypoints, rig: CubeRig) -> Keypoints:
        """Keypoints as observed, where they really point, and from where."""
        return self.lenses.seen(stitching.corrected(keypoints, self.field, rig))

    def straightened(self, frames: FrameSet) -> FrameSet:
        """The frames, read without what stitching bends, raw pairs by what their lenses are."""
        correction = tuple(self.field.coefficients.tolist())
        return frames.with_formats(
            [
                replace(kind, correction=correction, fisheyes=one.lenses.fisheyes or kind.fisheyes)
                for kind, one in zip(frames.formats, self.cameras, strict=True)
            ]
        )
