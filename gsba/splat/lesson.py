"""The view and learning rates of one training step."""

from dataclasses import dataclass

import numpy as np

from gsba.splat import adam
from gsba.splat.camera import FaceCamera


@dataclass(frozen=True, slots=True)
class Lesson:
    """A view to train on, and the learning rates of its step."""

    camera: FaceCamera
    truth: np.ndarray  # (H, W, 3) uint8, RGB
    use: np.ndarray | None  # (H, W) bool, pixels of the loss; None = all
    sh_degree: int  # highest degree of the harmonics
    rates: adam.Rates
    number: int  # of the step, from 1
