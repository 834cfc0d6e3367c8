"""The two renderers behind one interface: `cpu`, of this package, and `gsplat` on CUDA."""

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from gsba.log import GsbaError
from gsba.memory import total_memory_bytes
from gsba.splat import adam
from gsba.splat.camera import FaceCamera
from gsba.splat.density import Pull
from gsba.splat.gaussians import Gaussians
from gsba.splat.metrics import training_loss
from gsba.splat.rasterise import Gradients, Rendering, differentiate, render


@dataclass(frozen=True, slots=True)
class Lesson:
    """A view to train on, and the learning rates of its step."""

    camera: FaceCamera
    truth: np.ndarray  # (H, W, 3) uint8, RGB
    use: np.ndarray | None  # (H, W) bool, pixels of the loss; None = all
    sh_degree: int  # highest degree of the harmonics
    rates: adam.LearningRates
    number: int  # of the step, from 1


if TYPE_CHECKING:
    from gsba.splat.gpu import GsplatBackend

logger = logging.getLogger(__name__)

Backend: TypeAlias = "CpuBackend | GsplatBackend"  # renders splats, and trains them on images


class CpuBackend:
    """The rasteriser of `gsba.splat.rasterise`: deterministic, on any machine."""

    name = "cpu"
    stretch = 1  # steps that are most efficient in one call of `descend`
    memory_bytes: int  # of the device, all of it

    def __init__(self, num_threads: int | None = None) -> None:
        self.num_threads = num_threads
        self.memory_bytes = total_memory_bytes()

    def render(
        self,
        gaussians: Gaussians,
        cameras: Sequence[FaceCamera],
        sh_degree: int | None,
        near: float,
    ) -> list[Rendering]:
        """An image for each camera; see `gsba.splat.rasterise.render`."""
        return [render(gaussians, c, sh_degree, near, self.num_threads)[0] for c in cameras]

    def descend(
        self,
        gaussians: Gaussians,
        moments: adam.Moments,
        pull: Pull | None,
        lessons: Iterable[Lesson],
        near: float,
        ssim_weight: float,
    ) -> None:
        """Take a step of Adam for each lesson, in this order, down
        `gsba.splat.metrics.training_loss` times the view's share of a face, so that pixels of all
        views weigh equally. Gaussians, moments and pull (None = not recorded), to which each view
        is added, change in place; near: least z of a Gaussian, map units."""
        for lesson in lessons:
            found = self.gradients(gaussians, lesson, near, ssim_weight)
            adam.step(gaussians, found.gaussians, moments, lesson.rates, lesson.number)
            if pull is not None:
                pull.add(found.centres, found.seen, lesson.camera.focal)

    def gradients(
        self, gaussians: Gaussians, lesson: Lesson, near: float, ssim_weight: float
    ) -> Gradients:
        """Gradients of the training loss of one lesson, times the share of its view."""
        image, tape = render(gaussians, lesson.camera, lesson.sh_degree, near, self.num_threads)
        truth = lesson.truth.astype(np.float32) / 255
        slope = training_loss(image.color, truth, lesson.use, ssim_weight)[1]
        return differentiate(tape, lesson.camera.share * slope, num_threads=self.num_threads)


def choose_backend(name: str, num_threads: int | None = None) -> Backend:
    """The renderer "cpu", "gsplat", or "auto": gsplat if it and a CUDA device are available;
    num_threads: of the CPU, None = all cores. GsbaError: gsplat is requested and cannot be used."""
    if name == "cpu":
        return CpuBackend(num_threads)
    from gsba.splat.gpu import GsplatBackend

    try:
        return GsplatBackend()
    except GsbaError as error:
        if name != "auto":
            raise
        logger.info("splats on the CPU: %s", error)
        return CpuBackend(num_threads)
