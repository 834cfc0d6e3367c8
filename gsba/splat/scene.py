"""Splats from a run: posed faces, initial clouds, training, and metrics of held-out frames."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsba.bundle import triangulation
from gsba.camera.rig import CubeRig
from gsba.camera.views import ONE_EYE, Optics, View, turned_rigs
from gsba.frames import cubemap
from gsba.frames.held_out import HOLD_OUT_EVERY, held_out_rows
from gsba.frames.masks import load_mask
from gsba.frames.pixels import pictures_of
from gsba.log import GsbaError, track
from gsba.splat.camera import view_camera
from gsba.splat.gaussians import Gaussians, from_cloud
from gsba.splat.train import Images, Views
from gsba.types import FrameSet, Landmarks, Reconstruction, Tracks

_MAX_OVERSAMPLING = 8  # largest number of samples of a panorama along a pixel of a face


@dataclass(frozen=True, slots=True)
class Faces:
    """Pictures of some frames, with the same views of each."""

    views: tuple[View, ...]  # (K,)
    images: Images  # (W K,) of (h, w, 3) uint8 RGB, frame after frame
    use: Images  # (W K,) of (h, w) bool, unmasked pixels
    turns: np.ndarray | None = None  # (W, 3, 3) rig_R_lenses of each frame; None = the rig's axes

    def poses(self, world_T_rigs: np.ndarray) -> np.ndarray:
        """Poses (W, 4, 4) of the rigs that the views belong to, from those of the frames."""
        return world_T_rigs if self.turns is None else turned_rigs(world_T_rigs, self.turns)


@dataclass(frozen=True, slots=True)
class Split:
    """The frames that a splat is trained on, and those it is measured on."""

    training: np.ndarray  # (T,) int, frame indices
    held_out: np.ndarray  # (H,) int, frame indices: whole panoramas


def split_frames(usable: np.ndarray, every: int = HOLD_OUT_EVERY) -> Split:
    """Hold out one of `every` usable panoramas (F,), by default as exports do. GsbaError: too few
    frames for both parts."""
    rows = np.flatnonzero(usable)
    held = held_out_rows(len(rows), every)
    if len(rows) - len(held) < 2:
        raise GsbaError(f"{len(rows)} frames with poses are too few to hold one of {every} out")
    return Split(np.delete(rows, held), rows[held])


def load_faces(frames: FrameSet, which: np.ndarray, size: int, optics: Optics = ONE_EYE) -> Faces:
    """Faces of some frames (W,): six of 90 degrees, of `size` pixels, or those of one lens each."""
    rig, images, use = CubeRig(size, np.pi / 2), [], []
    views = optics.views(size)
    for f in track(which, "cutting faces", total=len(which)):
        if optics:
            parts, masks = cut_lens_faces(frames, int(f), views, optics)
        else:
            parts, masks = cut_faces(frames, int(f), rig)
        images += list(parts)
        use += list(masks) if masks is not None else [np.ones(p.shape[:2], bool) for p in parts]
    turns = None if optics.lenses.axes is None else optics.lenses.axes[which]
    return Faces(views, images, use, turns)


def cut_faces(frames: FrameSet, frame: int, rig: CubeRig) -> tuple[np.ndarray, np.ndarray | None]:
    """Faces (6, size, size, 3) uint8 RGB whose pixels are means over their area, like a renderer's,
    and their masks, bool or None.

    Sampling a panorama shrunk to the density of a face's middle would blur the face's corners,
    where three times as many pixels share an angle.
    """
    kind = frames.format_of(frame)
    if not kind.panoramic:
        whole = cubemap.native_rig(kind)
    else:
        times = -(-kind.width / (2 * np.pi) // rig.focal)  # until no denser in the middle
        whole = replace(rig, size=int(np.clip(times, 1, _MAX_OVERSAMPLING)) * rig.size)
    images, mask = cubemap.load(frames, frame, whole)
    if whole.size == rig.size:
        return images, mask
    shapes = [(rig.size, rig.size)] * len(images)
    surely = None if mask is None else np.stack(_masks_of_whole_pixels(mask, shapes))
    return np.stack(_averaged(images, shapes)), surely


def cut_lens_faces(
    frames: FrameSet, frame: int, views: Sequence[View], optics: Optics
) -> tuple[list[np.ndarray], list[np.ndarray] | None]:
    """Like `cut_faces`, of one lens each: images as large as the views, and masks or None."""
    kind = frames.format_of(frame)
    times = int(np.clip(-(-kind.width / (2 * np.pi) // views[0].focal), 1, _MAX_OVERSAMPLING))
    finer = tuple(view.finer(times) for view in views)
    cutter = optics.cutter(finer, frame)
    images = list(cutter.cut(pictures_of(frames, frame, cutter.focal)))
    whole = load_mask(frames, frame)
    masks = None if whole is None else cutter.cut_mask(whole)
    if times == 1:
        return images, masks
    shapes = [(view.width, view.height) for view in views]
    return _averaged(images, shapes), None if masks is None else _masks_of_whole_pixels(
        masks, shapes
    )


def _averaged(images: Images, shapes: Sequence[tuple[int, int]]) -> list[np.ndarray]:
    """Images resized to widths and heights, by means over areas where they shrink."""
    import cv2

    way = cv2.INTER_AREA if shapes[0][1] < len(images[0]) else cv2.INTER_CUBIC
    pairs = zip(images, shapes, strict=True)
    return [cv2.resize(image, shape, interpolation=way) for image, shape in pairs]


def _masks_of_whole_pixels(masks: Images, shapes: Sequence[tuple[int, int]]) -> list[np.ndarray]:
    """Masks resized to widths and heights, True where all of a pixel is."""
    shares = _averaged([mask.astype(np.float32) for mask in masks], shapes)
    return [share > 0.999 for share in shares]


def make_views(faces: Faces, world_T_rigs: np.ndarray) -> Views:
    """Posed faces, without those that are masked altogether; world_T_rigs: (W, 4, 4) poses of their
    frames."""
    each, poses = len(faces.views), faces.poses(world_T_rigs)
    seen = [v for v, use in enumerate(faces.use) if use.any()]
    cameras = [view_camera(poses[v // each], faces.views[v % each]) for v in seen]
    images, use = [faces.images[v] for v in seen], [faces.use[v] for v in seen]
    return Views(
        cameras, images, None if all(u.all() for u in use) else use, np.array(seen, int) // each
    )


def place_points(
    reconstruction: Reconstruction, world_T_rigs: np.ndarray, frames: np.ndarray, gate_rad: float
) -> tuple[Landmarks, np.ndarray]:
    """The run's points, triangulated again from some frames under given poses.

    Args:
        world_T_rigs: (F, 4, 4) poses, in a world of their own; only those of `frames` are used.
        gate_rad: observations further from their point are left out.

    Returns:
        Points with their observations, whose keypoints are rows of the reconstruction's
        observations; and the reconstruction's index (J,) of each point.
    """
    rows = np.flatnonzero(np.isin(reconstruction.observation_frames, frames))
    points, origins = reconstruction.observation_points[rows], reconstruction.observation_origins
    known, renumbered = np.unique(points, return_inverse=True)
    candidates = Tracks(
        renumbered.astype(np.int32),
        reconstruction.observation_frames[rows],
        np.arange(len(rows), dtype=np.int32),
        len(known),
    )
    placed = triangulation.triangulate(
        candidates,
        reconstruction.observation_bearings[rows],
        np.ones(len(rows)),
        world_T_rigs,
        gate_rad,
        origins_rig=None if origins is None else origins[rows],
    )
    kept = np.empty(len(placed.points_world), np.int64)
    kept[placed.tracks.points] = points[placed.tracks.keypoints]
    tracks = replace(placed.tracks, keypoints=rows[placed.tracks.keypoints])
    return replace(placed, tracks=tracks), kept


def start_cloud(
    reconstruction: Reconstruction, world_T_rigs: np.ndarray, frames: np.ndarray, sh_degree: int
) -> Gaussians:
    """Gaussians at the run's points, triangulated under any poses by one recipe; reconstruction,
    world_T_rigs, frames: see `place_points`."""
    landmarks, known = place_points(reconstruction, world_T_rigs, frames, float(np.deg2rad(3.0)))
    return from_cloud(landmarks.points_world, reconstruction.point_colors[known], sh_degree)
