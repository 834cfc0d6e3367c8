"""Frames against a splat: the block that aligns rig poses to what the splat renders."""

import numpy as np

from factors import FaceCameras, RobustLoss
from factors.splat import RenderedView, SplatBlock
from gsba import cubemap, graph
from gsba.log import track
from gsba.rig import RIG_R_FACE, CubeRig
from gsba.splat.backend import Backend
from gsba.splat.camera import face_camera
from gsba.splat.gaussians import Gaussians
from gsba.types import FACES, FrameSet

MIN_ALPHA = 0.95  # of a rendered pixel that is believed
MAX_STEP = 0.1  # of the depth, between neighbouring pixels: more is an edge
_LUMA = np.array([0.299, 0.587, 0.114])
_MARGIN_HFOV_DEG = 100.0  # of captured faces, so that samples beyond an edge find pixels


def splat_block(
    gaussians: Gaussians,
    frames: FrameSet,
    which: np.ndarray,
    size: int,
    near: float,
    backend: Backend,
    loss: RobustLoss | None = None,
) -> SplatBlock:
    """The block of some frames against a fixed splat.

    Args:
        gaussians: the splat; its world is the poses'.
        frames: captured frames.
        which: frame indices; keys are graph.X(frame).
        size: pixels of a rendered face; captured ones are sampled as densely. Coarse to fine is
            one block after another.
        near: least z of a Gaussian, map units.
        backend: the renderer.
        loss: see `factors.splat.SplatBlock`.
    """
    rendered = CubeRig(size, np.pi / 2)
    captured = _captured_rig(frames, size)
    images, use = [], []
    for f in track(which, "cutting faces", total=len(which)):
        faces, mask = cubemap.load(frames, int(f), captured)
        images.append((faces @ _LUMA / 255).astype(np.float32))
        use.append(mask)
    num = len(FACES)
    cameras = FaceCameras(
        RIG_R_FACE, np.full(num, captured.focal), np.full((num, 2), captured.principal)
    )

    def render(_row: int, world_T_rig: np.ndarray) -> RenderedView:
        return render_view(gaussians, world_T_rig, rendered, near, backend)

    return SplatBlock([graph.X(int(f)) for f in which], images, use, cameras, render, loss)


def render_view(
    gaussians: Gaussians, world_T_rig: np.ndarray, rig: CubeRig, near: float, backend: Backend
) -> RenderedView:
    """Pixels of all faces that the splat is sure of, as points with grey values.

    Args:
        world_T_rig: (4, 4), where to render from.
        rig: faces to render.
    """
    centres = np.arange(rig.size) + 0.5
    grid = np.stack(np.meshgrid(centres, centres), axis=-1)
    points, greys = [], []
    for face in range(len(FACES)):
        camera = face_camera(world_T_rig, face, rig)
        image = backend.render(gaussians, camera, None, near)
        sure = (image.alpha > MIN_ALPHA) & ~_edges(image.depth)
        depth = image.depth[sure].astype(np.float64)
        offsets = (grid[sure] - rig.principal) / rig.focal
        local = np.column_stack([offsets, np.ones(len(offsets))]) * depth[:, None]
        points.append(local @ camera.world_R_face.T + camera.face_in_world)
        # What lies behind a pixel that is not quite opaque is unknown: leave its share out.
        greys.append((image.color[sure] @ _LUMA) / image.alpha[sure])
    return RenderedView(np.concatenate(points), np.concatenate(greys))


def _edges(depth: np.ndarray) -> np.ndarray:
    """Pixels (H, W) bool at a jump of the depth, where an expected depth is nobody's."""
    low, high = depth.copy(), depth.copy()
    for axis in (0, 1):
        for shift in (1, -1):
            other = np.roll(depth, shift, axis)
            low, high = np.minimum(low, other), np.maximum(high, other)
    return high - low > MAX_STEP * np.maximum(depth, 1e-9)


def _captured_rig(frames: FrameSet, size: int) -> CubeRig:
    """Faces as dense as rendered ones and a little wider; those of cube frames are as they are."""
    if frames.layout == "cube":
        return CubeRig(frames.width, np.pi / 2)
    hfov = np.deg2rad(_MARGIN_HFOV_DEG)
    return CubeRig(round(size * np.tan(hfov / 2)), hfov)
