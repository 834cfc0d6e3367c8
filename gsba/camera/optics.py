"""The optics of a sequence, for rendering: its lenses, and the depths around each frame."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from gsba.camera.cameras import Cameras
from gsba.camera.lens import Lenses
from gsba.camera.rig import CubeRig
from gsba.camera.views import View, ViewCutter, lens_views, rig_views, scenes_of, turned_rigs
from gsba.types import Reconstruction


@dataclass(frozen=True, slots=True)
class Optics:
    """Lenses, and depths of the scene around them. One centre by default."""

    lenses: Lenses = field(default_factory=Lenses)  # in the unit of the poses
    scenes: Callable[[int], np.ndarray] | None = None  # points (N, 3) around a frame, rig frame, by
    # its index; None = everything is far

    def __bool__(self) -> bool:
        return bool(self.lenses)

    @classmethod
    def of(cls, cameras: Cameras, reconstruction: Reconstruction) -> "Optics":
        """Lenses of the frames that a reconstruction was made from.

        Of more than two lenses there are no faces of one lens each, and of several cameras none
        that all frames share: they count as one centre.
        """
        if len(cameras.lenses) > 1 or cameras.only.num_lenses > 2:
            return ONE_EYE
        return cls(cameras.only, scenes_of(reconstruction))

    def views(self, size: int) -> tuple[View, ...]:
        """Six faces of `size` pixels and 90 degrees, or as dense faces of one lens each."""
        return lens_views(self.lenses, size) if self else rig_views(CubeRig(size, np.pi / 2))

    def cutter(self, views: tuple[View, ...], frame: int) -> ViewCutter:
        """The cutter of views out of the pictures of a frame."""
        return ViewCutter(views, self.lenses, frame, self.scenes and self.scenes(frame))

    def own(self, world_T_rigs: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Poses (W, 4, 4) of rigs that have the lenses' axes, from those of frames (W,)."""
        axes = self.lenses.axes
        return world_T_rigs if axes is None else turned_rigs(world_T_rigs, axes[frames])


ONE_EYE = Optics()
