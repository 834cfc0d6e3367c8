"""gsplat on CUDA, classic pinhole path, behind the interface of `gsba.splat.backend`.

A stretch of training stays on the device: parameters and moments are copied to it and back once.
tests/splat/test_gsplat.py compares it with the CPU renderer: with gsplat's kernels where there is a
CUDA device (gsplat 1.5.3 on an NVIDIA H200), else with its own PyTorch versions of them.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from gsba.log import GsbaError
from gsba.memory import total_memory_bytes
from gsba.splat import metrics
from gsba.splat._project import DILATION
from gsba.splat.adam import BETA1, BETA2, EPS, LearningRates, Moments
from gsba.splat.camera import FaceCamera
from gsba.splat.density import Pull
from gsba.splat.gaussians import Gaussians
from gsba.splat.rasterise import Rendering

if TYPE_CHECKING:
    from gsba.splat.backend import Lesson


class GsplatBackend:
    """Renders and trains by gsplat and PyTorch on a device. GsbaError: torch or gsplat is not
    installed, or there is no CUDA device, or its kernels are missing."""

    name, stretch = "gsplat", 100

    def __init__(self, device: str = "cuda") -> None:
        try:
            import gsplat  # type: ignore[import-not-found]
            import torch  # type: ignore[import-not-found]
        except ImportError as error:
            raise GsbaError(
                f"the gsplat backend needs {error.name or 'gsplat'}: pip install 'gsba[splat]', "
                "or use --backend cpu"
            ) from None
        if device == "cuda":
            _require_kernels(torch)
        self._torch, self._rasterize, self._device = torch, gsplat.rasterization, device
        self.memory_bytes = (
            torch.cuda.get_device_properties(device).total_memory
            if device == "cuda"
            else total_memory_bytes()
        )
        self._window = metrics.window().tolist()

    def render(
        self,
        gaussians: Gaussians,
        cameras: Sequence[FaceCamera],
        sh_degree: int | None,
        near: float,
    ) -> list[Rendering]:
        """See `gsba.splat.backend.CpuBackend`; all cameras of one size are one batch."""
        degree, renderings = gaussians.usable_degree(sh_degree), {}
        with self._within_memory(gaussians), self._torch.no_grad():
            parameters = self._upload(gaussians)
            for size in dict.fromkeys((camera.width, camera.height) for camera in cameras):
                rows = [c for c, one in enumerate(cameras) if (one.width, one.height) == size]
                batch = [cameras[c] for c in rows]
                found = self._run(parameters, batch, degree, near, "RGB+ED")
                images, alphas = (part.cpu().numpy() for part in found[:2])
                for c, image, alpha in zip(rows, images, alphas, strict=True):
                    parts = image[..., :3], image[..., 3], alpha[..., 0]
                    renderings[c] = Rendering(*(part.copy() for part in parts))
        return [renderings[c] for c in range(len(cameras))]

    def descend(
        self,
        gaussians: Gaussians,
        moments: Moments,
        pull: Pull | None,
        lessons: Iterable["Lesson"],
        near: float,
        ssim_weight: float,
    ) -> None:
        """See `gsba.splat.backend.CpuBackend`."""
        torch = self._torch
        with self._within_memory(gaussians):
            values, first, second = (
                self._upload(part) for part in (gaussians, moments.first, moments.second)
            )
            sums, counts = torch.zeros((2, len(gaussians)), device=self._device)
            for lesson in lessons:
                for value in values:
                    value.requires_grad_(True).grad = None
                degree = gaussians.usable_degree(lesson.sh_degree)
                image, _, notes = self._run(values, [lesson.camera], degree, near, "RGB")
                notes["means2d"].retain_grad()
                slope = self._slope(image[0].detach(), lesson, ssim_weight)
                image[0].backward(lesson.camera.share * slope)
                with torch.no_grad():
                    self._move(values, first, second, lesson.rates, lesson.number)
                    slopes = notes["means2d"].grad[0]
                    sums += lesson.camera.focal * torch.hypot(slopes[:, 0], slopes[:, 1])
                    counts += (notes["radii"][0] > 0).reshape(len(gaussians), -1).all(dim=1)
        parts = (gaussians, moments.first, moments.second)
        for part, tensors in zip(parts, (values, first, second), strict=True):
            for array, tensor in zip(part.arrays(), tensors, strict=True):
                array[...] = tensor.detach().cpu().numpy()
        if pull is not None:
            pull.sums[:] += sums.cpu().numpy()
            pull.counts[:] += counts.cpu().numpy()

    @contextmanager
    def _within_memory(self, gaussians: Gaussians) -> Iterator[None]:
        try:
            yield
        except self._torch.cuda.OutOfMemoryError:
            raise GsbaError(
                f"the GPU's memory is too small for {len(gaussians)} Gaussians at this size: "
                "lower --face-size, allow fewer (max_gaussians), or use --backend cpu"
            ) from None

    def _upload(self, gaussians: Gaussians) -> list[Any]:
        return [self._torch.tensor(array, device=self._device) for array in gaussians.arrays()]

    def _run(
        self,
        parameters: list[Any],
        cameras: Sequence[FaceCamera],
        sh_degree: int,
        near: float,
        mode: Literal["RGB", "RGB+ED"],
    ) -> tuple[Any, Any, dict[str, Any]]:
        """Images (C, H, W, 3 or 4) of one size, alphas (C, H, W, 1), and gsplat's notes."""
        means, log_scales, quaternions, logits, sh = parameters
        num = len(cameras)
        faces_T_world, intrinsics = np.tile(np.eye(4), (num, 1, 1)), np.zeros((num, 3, 3))
        for c, camera in enumerate(cameras):
            faces_T_world[c, :3, :3] = camera.world_R_face.T
            faces_T_world[c, :3, 3] = -camera.world_R_face.T @ camera.face_in_world
            intrinsics[c] = np.diag([camera.focal, camera.focal, 1])
            intrinsics[c, :2, 2] = camera.principal
        torch = self._torch
        viewmats, Ks = (
            torch.tensor(array, dtype=torch.float32, device=self._device)
            for array in (faces_T_world, intrinsics)
        )
        return self._rasterize(
            means=means,
            quats=quaternions,
            scales=torch.exp(log_scales),
            opacities=torch.sigmoid(logits),
            colors=sh,
            viewmats=viewmats,
            Ks=Ks,
            width=cameras[0].width,
            height=cameras[0].height,
            near_plane=near,
            eps2d=DILATION,
            sh_degree=sh_degree,
            packed=False,
            render_mode=mode,
            rasterize_mode="classic",
        )

    def _slope(self, image: Any, lesson: "Lesson", ssim_weight: float) -> Any:
        """Derivative of `gsba.splat.metrics.training_loss` by an image (H, W, 3)."""
        truth = self._torch.tensor(lesson.truth, device=self._device).float() / 255
        use: Any = 1.0
        if lesson.use is not None:
            use = self._torch.tensor(lesson.use, device=self._device)[..., None]
        x, y = image * use, truth * use
        slope = metrics.similarity(x, y, self._blur)[1]
        return use * ((1 - ssim_weight) * (x - y).sign() - ssim_weight * slope) / image.numel()

    def _blur(self, image: Any) -> Any:
        """Convolve (H, W, C) with SSIM's window, black around it; PyTorch's convolution is TF32."""
        half = len(self._window) // 2
        for axis, edges in enumerate([(0, 0, 0, 0, half, half), (0, 0, half, half)]):
            wide = self._torch.nn.functional.pad(image, edges)
            length = image.shape[axis]
            image = sum(w * wide.narrow(axis, k, length) for k, w in enumerate(self._window))
        return image

    def _move(
        self,
        values: list[Any],
        first: list[Any],
        second: list[Any],
        rates: LearningRates,
        number: int,
    ) -> None:
        """`gsba.splat.adam.step` on the device."""
        correction1, correction2 = 1 - BETA1**number, (1 - BETA2**number) ** 0.5
        for entry, value, m, v in zip(fields(Gaussians), values, first, second, strict=True):
            rate = self._torch.full_like(value[:1], getattr(rates, entry.name) / correction1)
            if entry.name == "sh":
                rate[:, 1:] = rates.sh_rest / correction1
            m.lerp_(value.grad, 1 - BETA1)
            v.lerp_(value.grad**2, 1 - BETA2)
            value -= rate * m / (v.sqrt() / correction2 + EPS)


def _require_kernels(torch: Any) -> None:
    """Load gsplat's CUDA kernels, which it builds when they are first used."""
    if not torch.cuda.is_available():
        raise GsbaError("the gsplat backend needs a CUDA device: use --backend cpu")
    try:
        from gsplat.cuda._backend import _C as kernels  # type: ignore[import-not-found]
    except (ImportError, OSError, RuntimeError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise GsbaError(f"gsplat cannot build its kernels ({reason}): use --backend cpu") from None
    if kernels is None:
        raise GsbaError(
            "gsplat has no kernels and finds no CUDA toolkit to build them with: install the "
            "toolkit or a gsplat wheel made for this PyTorch and CUDA, or use --backend cpu"
        )
