"""Alignment of frames to a splat: the block that compares rig poses with its renderings."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from factors import Block, FaceCameras
from factors.splat import RenderedView, SplatBlock
from gsba.bundle import pose_variables
from gsba.bundle.families import Family, MapSnapshot
from gsba.camera.fisheye import facing
from gsba.camera.lens import seam_sines
from gsba.camera.rig import CubeRig
from gsba.camera.views import ONE_EYE, Optics, View, nearest_lens, rig_views, turned_rigs
from gsba.frames import cubemap
from gsba.frames.masks import load_weights
from gsba.log import track
from gsba.splat.backend import Backend
from gsba.splat.camera import rig_cameras
from gsba.splat.gaussians import Gaussians
from gsba.splat.scene import cut_faces, cut_lens_faces
from gsba.types import FrameSet

MIN_ALPHA = 0.95  # least alpha of a rendered pixel that is used
_LUMA = np.array([0.299, 0.587, 0.114])


@dataclass(frozen=True, slots=True)
class Captured:
    """Grey faces of frames, to align with renderings of one size."""

    which: np.ndarray  # (W,) int, frame indices
    rendered: tuple[View, ...]  # views that are compared with the captured faces
    views: tuple[View, ...]  # (K,) the captured faces
    images: tuple[np.ndarray, ...]  # (W,) of (K, S, S) float32, 0..1
    weights: tuple[np.ndarray | None, ...]  # (W,) of (K, S, S) float32, 0..1; None = all one
    turns: np.ndarray | None = None  # (W, 3, 3) axes of the views' rig in each frame's; None =
    # equal


def capture(frames: FrameSet, which: np.ndarray, size: int, optics: Optics = ONE_EYE) -> Captured:
    """Grey faces of some frames, as dense as rendered ones of `size` pixels."""
    if optics:
        return _capture_of_lenses(frames, which, size, optics)
    rig = _captured_rig(frames, size)
    images, weights = [], []
    for f in track(which, "cutting faces", total=len(which)):
        faces, mask = cut_faces(frames, int(f), rig)
        images.append((faces @ _LUMA / 255).astype(np.float32))
        found = load_weights(frames, int(f))
        trust = 1.0 if found is None else cubemap.cut_mask(found, rig)
        weights.append(None if mask is None else (mask * trust).astype(np.float32))
    rendered = optics.views(size)
    return Captured(which, rendered, rig_views(rig), tuple(images), tuple(weights))


def _capture_of_lenses(frames: FrameSet, which: np.ndarray, size: int, optics: Optics) -> Captured:
    """Faces like those of `capture`, of one lens each; blended pixels have no weight."""
    wide, rendered, lenses = _wide_rig(size), optics.views(size), optics.lenses
    square = {"width": wide.size, "height": wide.size, "principal": (wide.principal,) * 2}
    views = tuple(replace(view, **square) for view in rendered)
    pixels = np.stack(np.meshgrid(*2 * (np.arange(wide.size) + 0.5,)), axis=-1)
    rays, axes = np.stack([view.rays(pixels) for view in views]), lenses.optical_axes
    of_view = np.array([nearest_lens(view, lenses.centres) for view in views])
    clear = facing(rays, axes) == of_view[:, None, None]
    clear &= seam_sines(rays, axes) > np.sin(lenses.band_rad)
    images, weights = [], []
    for f in track(which, "cutting faces", total=len(which)):
        faces, masks = cut_lens_faces(frames, int(f), views, optics)
        images.append((np.stack(faces) @ _LUMA / 255).astype(np.float32))
        found = load_weights(frames, int(f))
        trust = clear if masks is None else clear & np.stack(masks)
        if found is not None:
            trust = trust * np.stack(optics.cutter(views, int(f)).cut_mask(found))
        weights.append(trust.astype(np.float32))
    turns = None if lenses.axes is None else lenses.axes[which]
    return Captured(which, rendered, views, tuple(images), tuple(weights), turns)


def splat_block(
    gaussians: Gaussians, captured: Captured, near: float, backend: Backend
) -> SplatBlock:
    """The block of captured frames, keys X(frame), against a fixed splat in the world of the poses;
    near: least z of a Gaussian, map units. Coarse to fine is one block after another."""
    views, turns = captured.views, captured.turns
    rotations, centres = (
        np.stack([v.rig_R_view for v in views]),
        np.stack([v.centre for v in views]),
    )
    focals, principals = np.array([v.focal for v in views]), np.array([v.principal for v in views])

    def render(row: int, world_T_rig: np.ndarray) -> RenderedView:
        if turns is not None:
            (world_T_rig,) = turned_rigs(world_T_rig[None], turns[[row]])
        return render_view(gaussians, world_T_rig, captured.rendered, near, backend)

    keys = [pose_variables.X(int(f)) for f in captured.which]
    cameras = FaceCameras(rotations, focals, principals)
    return SplatBlock(
        keys, captured.images, captured.weights, cameras, render, centres=centres, turns=turns
    )


def render_view(
    gaussians: Gaussians,
    world_T_rig: np.ndarray,
    views: Sequence[View],
    near: float,
    backend: Backend,
) -> RenderedView:
    """Opaque pixels of views of a rig at a pose (4, 4), as points with grey values."""
    points, greys = [], []
    cameras = rig_cameras(world_T_rig, views)
    images = backend.render(gaussians, cameras, None, near)
    for camera, image in zip(cameras, images, strict=True):
        grid = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        # at a step, the expected depth is of neither side
        low, high = image.depth.copy(), image.depth.copy()
        for axis in (0, 1):
            for shift in (1, -1):
                other = np.roll(image.depth, shift, axis)
                low, high = np.minimum(low, other), np.maximum(high, other)
        # neighbouring pixels whose depths differ by more than a tenth are an edge
        sure = (image.alpha > MIN_ALPHA) & ~(high - low > 0.1 * np.maximum(image.depth, 1e-9))
        depth = image.depth[sure].astype(np.float64)
        offsets = (np.stack(grid, axis=-1)[sure] - camera.principal) / camera.focal
        local = np.column_stack([offsets, np.ones(len(offsets))]) * depth[:, None]
        points.append(local @ camera.world_R_face.T + camera.face_in_world)
        # The scene behind a pixel that is not quite opaque is unknown: its share is left out.
        greys.append((image.color[sure] @ _LUMA) / image.alpha[sure])
    return RenderedView(np.concatenate(points), np.concatenate(greys))


def _captured_rig(frames: FrameSet, size: int) -> CubeRig:
    """Faces as dense as rendered ones and a little wider; cube frames keep their own faces."""
    if all(kind.panoramic for kind in frames.formats):
        return _wide_rig(size)
    if len(frames.formats) > 1:  # cube faces among them show no more than 90 degrees
        return CubeRig(size, np.pi / 2)
    return cubemap.native_rig(frames.format)


def _wide_rig(size: int) -> CubeRig:
    hfov = np.deg2rad(100.0)  # samples beyond a rendered edge find pixels
    return CubeRig(round(size * np.tan(hfov / 2)), hfov)


@dataclass(frozen=True, slots=True)
class SplatGreys(Family):
    """Grey values of frames and of a splat rendered from their poses. See `factors.splat`."""

    name = "splat"
    digest = ""  # stages keep their results by what the block is made of

    block: SplatBlock  # of the captured frames

    def blocks(self, snapshot: MapSnapshot) -> Sequence[Block]:
        """The block of all captured frames."""
        return (self.block,)
