"""One camera of a map: all that was estimated of it."""

from dataclasses import dataclass, replace

import numpy as np

from gsba.bundle.lens_axes import LensAxes
from gsba.bundle.lens_centres import LensCentres, StitchRadius
from gsba.bundle.readout import CameraEstimate
from gsba.bundle.self_calibration import SelfCalibration
from gsba.camera.lens import Lenses


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """One camera of a map, as estimates have found it."""

    centres: LensCentres | None = None  # of the lenses; None = not looked for
    axes: LensAxes | None = None  # where these look; None = not looked for
    stitch_radius: StitchRadius | None = None  # of panoramas; None = not looked for
    calibrated: SelfCalibration | None = None  # of raw pairs; None = not looked for
    readout: CameraEstimate | None = None  # how lenses are read; None = not looked for

    @property
    def lenses(self) -> Lenses:
        """The camera's lenses; one centre where none were looked for."""
        return Lenses() if self.centres is None else self.centres.lenses

    def estimate(self) -> CameraEstimate:
        """The lenses, and how they are read."""
        if self.readout is None:
            return CameraEstimate(self.lenses, reason="not looked for")
        return replace(self.readout, lenses=self.lenses)

    def with_estimate(self, found: CameraEstimate) -> "FoundCamera":
        """The camera with other lenses, or read otherwise; one that was not looked for stays."""
        if self.centres is None:
            return self
        centres = replace(self.centres, lenses=found.lenses, found=found.lenses.centre)
        return replace(self, centres=centres, readout=found)

    def scaled(self, scale: float) -> "FoundCamera":
        """The camera in another unit of length: one map unit is `scale` of the new ones."""
        return replace(
            self,
            centres=self.centres and self.centres.scaled(scale),
            stitch_radius=self.stitch_radius and self.stitch_radius.scaled(scale),
            readout=self.readout and self.readout.scaled(scale),
        )

    def taken(self, rows: np.ndarray) -> "FoundCamera":
        """The camera of some frames (F',) only."""
        centres, readout = self.centres, self.readout
        return replace(
            self,
            centres=centres and replace(centres, lenses=centres.lenses.taken(rows)),
            readout=readout and replace(readout, lenses=readout.lenses.taken(rows)),
        )
