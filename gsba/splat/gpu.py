"""gsplat on CUDA, classic pinhole path, behind the interface of `gsba.splat.backend`.

Written after gsplat 1.5.3's documentation and not yet run on a GPU by its authors: compare a
rendering with that of the CPU before relying on it. Parameters travel to the device at every
call, which costs more than rendering does for splats of millions of Gaussians.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from gsba.log import GsbaError
from gsba.splat._project import DILATION
from gsba.splat.camera import FaceCamera
from gsba.splat.gaussians import Gaussians
from gsba.splat.rasterise import Gradients, Rendering

if TYPE_CHECKING:
    from gsba.splat.backend import Slope


class GsplatBackend:
    """Renders and differentiates by gsplat.

    Raises:
        GsbaError: torch or gsplat is not installed, or there is no CUDA device.
    """

    name = "gsplat"

    def __init__(self) -> None:
        try:
            import gsplat  # type: ignore[import-not-found]
            import torch  # type: ignore[import-not-found]
        except ImportError as error:
            raise GsbaError(
                f"the gsplat backend needs {error.name or 'gsplat'}: pip install 'gsba[splat]', "
                "or use --backend cpu"
            ) from None
        if not torch.cuda.is_available():
            raise GsbaError("the gsplat backend needs a CUDA device: use --backend cpu")
        self._torch, self._rasterize = torch, gsplat.rasterization

    def render(
        self, gaussians: Gaussians, camera: FaceCamera, sh_degree: int | None, near: float
    ) -> Rendering:
        """See `Backend`."""
        with self._torch.no_grad():
            parameters = self._upload(gaussians, requires_grad=False)
            image, alpha, _ = self._run(parameters, camera, sh_degree, near)
        image, alpha = image[0].cpu().numpy(), alpha[0, ..., 0].cpu().numpy()
        return Rendering(np.ascontiguousarray(image[..., :3]), image[..., 3].copy(), alpha)

    def gradients(
        self,
        gaussians: Gaussians,
        camera: FaceCamera,
        sh_degree: int | None,
        near: float,
        slope: "Slope",
    ) -> Gradients:
        """See `Backend`."""
        parameters = self._upload(gaussians, requires_grad=True)
        image, _, meta = self._run(parameters, camera, sh_degree, near)
        meta["means2d"].retain_grad()
        d_color = slope(image[0, ..., :3].detach().cpu().numpy())
        image[0, ..., :3].backward(self._torch.as_tensor(d_color, device=image.device))
        slopes = Gaussians(*(p.grad.cpu().numpy() for p in parameters))
        centres = meta["means2d"].grad[0].cpu().numpy()
        seen = (meta["radii"][0] > 0).reshape(len(gaussians), -1).all(dim=1).cpu().numpy()
        return Gradients(slopes, centres, seen)

    def _upload(self, gaussians: Gaussians, requires_grad: bool) -> list[Any]:
        return [
            self._torch.tensor(array, device="cuda", requires_grad=requires_grad)
            for array in gaussians.arrays()
        ]

    def _run(
        self, parameters: list[Any], camera: FaceCamera, sh_degree: int | None, near: float
    ) -> tuple[Any, Any, dict[str, Any]]:
        """Colour and expected depth (1, H, W, 4), alpha (1, H, W, 1), and gsplat's notes."""
        means, log_scales, quaternions, logits, sh = parameters
        face_T_world = np.eye(4)
        face_T_world[:3, :3] = camera.world_R_face.T
        face_T_world[:3, 3] = -camera.world_R_face.T @ camera.face_in_world
        middle = 0.5 * camera.size
        intrinsics = np.array([[camera.focal, 0, middle], [0, camera.focal, middle], [0, 0, 1]])
        torch = self._torch
        available = round(sh.shape[1] ** 0.5) - 1
        return self._rasterize(
            means=means,
            quats=quaternions,
            scales=torch.exp(log_scales),
            opacities=torch.sigmoid(logits),
            colors=sh,
            viewmats=torch.tensor(face_T_world[None], dtype=torch.float32, device="cuda"),
            Ks=torch.tensor(intrinsics[None], dtype=torch.float32, device="cuda"),
            width=camera.size,
            height=camera.size,
            near_plane=near,
            eps2d=DILATION,
            sh_degree=available if sh_degree is None else min(sh_degree, available),
            packed=False,
            render_mode="RGB+ED",
            rasterize_mode="classic",
        )
