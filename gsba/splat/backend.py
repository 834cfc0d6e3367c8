"""The two renderers behind one interface: `cpu`, ours, and `gsplat` on CUDA."""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from gsba.log import GsbaError
from gsba.splat.camera import FaceCamera
from gsba.splat.gaussians import Gaussians
from gsba.splat.rasterise import Gradients, Rendering, differentiate, render

Slope = Callable[[np.ndarray], np.ndarray]  # colours (H, W, 3) -> the loss's derivative by them


class Backend(Protocol):
    """Renders splats, and differentiates losses on their colours."""

    name: str

    def render(
        self, gaussians: Gaussians, camera: FaceCamera, sh_degree: int | None, near: float
    ) -> Rendering:
        """An image; see `gsba.splat.rasterise.render`."""
        ...

    def gradients(
        self,
        gaussians: Gaussians,
        camera: FaceCamera,
        sh_degree: int | None,
        near: float,
        slope: Slope,
    ) -> Gradients:
        """Gradients of a loss whose derivative by the rendered colours is `slope(colours)`."""
        ...


class CpuBackend:
    """The rasteriser of `gsba.splat.rasterise`: deterministic, any machine."""

    name = "cpu"

    def __init__(self, num_threads: int | None = None) -> None:
        self.num_threads = num_threads

    def render(
        self, gaussians: Gaussians, camera: FaceCamera, sh_degree: int | None, near: float
    ) -> Rendering:
        """See `Backend`."""
        return render(gaussians, camera, sh_degree, near, self.num_threads)[0]

    def gradients(
        self,
        gaussians: Gaussians,
        camera: FaceCamera,
        sh_degree: int | None,
        near: float,
        slope: Slope,
    ) -> Gradients:
        """See `Backend`."""
        image, tape = render(gaussians, camera, sh_degree, near, self.num_threads)
        return differentiate(tape, slope(image.color), num_threads=self.num_threads)


def choose_backend(name: str, num_threads: int | None = None) -> Backend:
    """The renderer of a name.

    Args:
        name: "cpu", "gsplat", or "auto": gsplat where it and a CUDA device are there.
        num_threads: of the CPU renderer; None = all cores.

    Raises:
        GsbaError: gsplat is asked for and cannot be used.
    """
    if name == "cpu":
        return CpuBackend(num_threads)
    from gsba.splat.gpu import GsplatBackend

    try:
        return GsplatBackend()
    except GsbaError:
        if name == "auto":
            return CpuBackend(num_threads)
        raise
