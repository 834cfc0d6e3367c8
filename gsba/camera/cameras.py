"""The cameras of a sequence: each frame's rays go through the lenses of the camera that took it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from factors.threads import rows_in_threads
from gsba.camera.lens import ONE_CENTRE, Lenses
from gsba.types import FrameSet, Keypoints, Tracks, cameras_of
from gsba.types.records import slices

_AT_ONCE = 1 << 16  # observations of one thread


@dataclass(frozen=True, slots=True)
class Cameras:
    """Lenses of each camera, and the camera of each frame. One centre by default.

    Arrays of lenses that have a row for each frame have one for every frame of the sequence,
    whichever camera took it.
    """

    lenses: tuple[Lenses, ...] = (ONE_CENTRE,)  # (C,)
    of_frame: tuple[int, ...] = ()  # (F,) index of each frame's camera; () = there is one camera

    @classmethod
    def plain(cls, frames: FrameSet) -> "Cameras":
        """One centre for each camera of some frames."""
        return cls((ONE_CENTRE,) * len(frames.formats), frames.camera_of_frame)

    @classmethod
    def of(cls, lenses: "Lenses | Cameras", frames: FrameSet) -> "Cameras":
        """The cameras of some frames, given as such or as lenses through which all were taken."""
        if isinstance(lenses, Cameras) and lenses.of_frame == frames.camera_of_frame:
            return lenses
        if isinstance(lenses, Lenses) and (not lenses or len(frames.formats) == 1):
            return cls((lenses,) * len(frames.formats), frames.camera_of_frame)
        raise ValueError("the lenses are not those of the frames' cameras")

    def __bool__(self) -> bool:
        return any(map(bool, self.lenses))

    @property
    def only(self) -> Lenses:
        """The lenses of a single camera. ValueError: there are several cameras."""
        (lenses,) = self.lenses
        return lenses

    @property
    def baseline(self) -> float:
        """Largest distance between the first two lenses of a camera, map units."""
        return max(lenses.baseline if lenses else 0.0 for lenses in self.lenses)

    @property
    def parts(self) -> tuple[tuple[bool, ...], ...]:
        """Parts that each camera has, see `Lenses.parts`."""
        return tuple(lenses.parts for lenses in self.lenses)

    def at(self, frame: int) -> Lenses:
        """Lenses that took a frame."""
        return self.lenses[self.of_frame[frame] if self.of_frame else 0]

    def frames_of(self, camera: int, num_frames: int) -> np.ndarray:
        """Frames (F',) int64 that a camera took, of `num_frames`."""
        if not self.of_frame:
            return np.arange(num_frames)
        return np.flatnonzero(np.array(self.of_frame) == camera)

    def with_lenses(self, lenses: Sequence[Lenses]) -> "Cameras":
        """Cameras of these frames with other lenses (C,)."""
        if len(lenses) != len(self.lenses):
            raise ValueError(f"lenses of {len(lenses)} cameras instead of {len(self.lenses)}")
        return replace(self, lenses=tuple(lenses))

    def each(self, change: Callable[[Lenses], Lenses]) -> "Cameras":
        """The cameras with changed lenses."""
        return self.with_lenses([change(lenses) for lenses in self.lenses])

    def taken(self, rows: np.ndarray) -> "Cameras":
        """The cameras of some frames (F',) only: those that took none are left out."""
        used, of_frame = cameras_of(self.of_frame, rows)
        return Cameras(tuple(self.lenses[c].taken(rows) for c in used) or (ONE_CENTRE,), of_frame)

    def scaled(self, scale: float) -> "Cameras":
        """The cameras in another unit of length: one map unit is `scale` of the new ones."""
        return self.each(lambda lenses: lenses.scaled(scale))

    def cut_anew(self) -> "Cameras":
        """The cameras for panoramas cut anew, see `Lenses.cut_anew`."""
        return self.each(Lenses.cut_anew)

    def rays(self, directions: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Directions and origins (N, 3) of rays, see `Lenses.rays`."""
        seen, origins = self._by_camera(directions, frames, Lenses.rays)
        return seen, origins

    def views(self, directions: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Transforms (N, 4, 4) of local views, see `Lenses.views`."""
        return self._by_camera(directions, frames, lambda one, *seen: (one.views(*seen),))[0]

    def seeing(self, points_rig: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Vectors (N, 3) along the directions in which pictures show points, see
        `Lenses.seeing`."""
        return self._by_camera(points_rig, frames, lambda one, *seen: (one.seeing(*seen),))[0]

    def blended(self, directions: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """True (N,) where two lenses' pictures are blended, see `Lenses.blended`."""
        return self._by_camera(directions, frames, lambda one, *seen: (one.blended(*seen),))[0]

    def seen(self, keypoints: Keypoints) -> Keypoints:
        """Keypoints as rays that start at their lens, at the pose of the frame's middle."""
        if not self:
            return keypoints
        directions, origins = self.rays(keypoints.bearings_rig, keypoints.frames())
        return replace(keypoints, bearings_rig=directions, origins_rig=origins)

    def clear(self, tracks: Tracks, keypoints: Keypoints, num_threads: int = 1) -> Tracks:
        """Tracks without observations in blended bands, nor the points observed only there."""
        if not any(lenses.band_rad for lenses in self.lenses):
            return tracks

        def blended(some: slice) -> Sequence[np.ndarray]:
            frames = tracks.frames[some]
            rows = keypoints.starts[frames] + tracks.keypoints[some]
            return [self.blended(keypoints.bearings_rig[rows], frames)]

        (hidden,) = rows_in_threads(blended, slices(len(tracks), _AT_ONCE), num_threads)
        return tracks.of_observations(~hidden)

    def _by_camera(
        self,
        vectors: np.ndarray,
        frames: np.ndarray,
        look: Callable[[Lenses, np.ndarray, np.ndarray], Sequence[np.ndarray]],
    ) -> Sequence[np.ndarray]:
        """Arrays (N, ...) made of vectors (N, 3) in frames (N,) by each camera's lenses."""
        if not self.of_frame:
            return look(self.lenses[0], vectors, frames)
        cameras, wholes = np.array(self.of_frame)[frames], list[np.ndarray]()
        for number, lenses in enumerate(self.lenses):
            rows = np.flatnonzero(cameras == number)
            parts = look(lenses, vectors[rows], frames[rows])
            if not wholes:
                wholes = [np.empty((len(frames), *part.shape[1:]), part.dtype) for part in parts]
            for whole, part in zip(wholes, parts, strict=True):
                whole[rows] = part
        return wholes


ONE_CAMERA = Cameras()
