"""The cameras of a sequence, as estimated so far: one estimate for each."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsba.bundle.readout import CameraEstimate
from gsba.camera.cameras import Cameras
from gsba.camera.lens import Lenses
from gsba.types import Tracks


@dataclass(frozen=True, slots=True)
class CameraEstimates:
    """Estimate of each camera, and the camera of each frame."""

    each: tuple[CameraEstimate, ...]  # (C,)
    of_frame: tuple[int, ...] = ()  # (F,) as in `Cameras`

    @classmethod
    def of(cls, cameras: Cameras) -> "CameraEstimates":
        """Cameras of which lenses alone are known."""
        return cls(tuple(CameraEstimate(lenses) for lenses in cameras.lenses), cameras.of_frame)

    @property
    def cameras(self) -> Cameras:
        """The lenses of each camera."""
        return Cameras(tuple(one.lenses for one in self.each), self.of_frame)

    @property
    def only(self) -> CameraEstimate:
        """The estimate of a single camera.

        Raises:
            ValueError: there are several cameras.
        """
        (found,) = self.each
        return found

    def with_each(self, each: Sequence[CameraEstimate]) -> "CameraEstimates":
        """Other estimates (C,) of the cameras that took these frames."""
        if len(each) != len(self.each):
            raise ValueError(f"estimates of {len(each)} cameras instead of {len(self.each)}")
        return replace(self, each=tuple(each))

    def with_lenses(self, lenses: Sequence[Lenses]) -> "CameraEstimates":
        """The estimates with other lenses (C,)."""
        pairs = zip(self.each, lenses, strict=True)
        return self.with_each([replace(one, lenses=own) for one, own in pairs])

    def changed(
        self, camera: int, change: Callable[[CameraEstimate], CameraEstimate]
    ) -> "CameraEstimates":
        """The estimates with that of one camera changed."""
        each = list(self.each)
        each[camera] = change(each[camera])
        return self.with_each(each)

    def frames_of(self, camera: int, num_frames: int) -> np.ndarray:
        """Frames (F',) int64 that a camera took, of `num_frames`."""
        return self.cameras.frames_of(camera, num_frames)


def tracks_of_camera(tracks: Tracks, of_frame: Sequence[int], camera: int) -> Tracks:
    """Tracks of what one camera observes: points that it sees twice or more.

    Args:
        of_frame: (F,) camera of each frame; () = there is one.
    """
    if not of_frame:
        return tracks
    own = np.array(of_frame)[tracks.frames] == camera
    return tracks.of_observations(tracks.seen_twice(own))
