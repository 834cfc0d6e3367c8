"""What one step of training shows a splat."""

from dataclasses import dataclass

import numpy as np

from gsba.splat import adam
from gsba.splat.camera import FaceCamera


@dataclass(frozen=True, slots=True)
class Lesson:
    """One view, and how far to go to look like it."""

    camera: FaceCamera
    truth: np.ndarray  # (H, W, 3) uint8, RGB
    use: np.ndarray | None  # (H, W) bool, pixels that count; None = all
    sh_degree: int  # of the harmonics, at most
    rates: adam.Rates
    number: int  # of the step, from 1
