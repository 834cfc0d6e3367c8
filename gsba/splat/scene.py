"""From a run to splats: posed faces, start clouds, training, and metrics of held-out frames."""

from dataclasses import dataclass, replace

import numpy as np

from gsba.bundle import triangulation
from gsba.camera.rig import CubeRig
from gsba.config import SplatSettings, TriangulateSettings
from gsba.frames import cubemap
from gsba.log import GsbaError, track
from gsba.splat.camera import face_camera
from gsba.splat.gaussians import Gaussians, from_cloud
from gsba.splat.train import Views, extent_of
from gsba.types import FrameSet, Landmarks, PoseStatus, Reconstruction, Tracks

_GATE = np.deg2rad(3.0)  # of an observation under poses that may have drifted
_MAX_TIMES = 8  # samples of a panorama along a pixel of a face, at most


@dataclass(frozen=True, slots=True)
class Split:
    """Which frames a splat is trained on and which it is measured on."""

    training: np.ndarray  # (T,) int, frame indices
    held_out: np.ndarray  # (H,) int, frame indices: whole panoramas


def split_frames(usable: np.ndarray, every: int) -> Split:
    """Hold out whole panoramas: every `every`-th usable frame, starting half-way.

    Args:
        usable: (F,) bool.
        every: 2 or more.

    Raises:
        GsbaError: too few frames for both parts.
    """
    rows = np.flatnonzero(usable)
    held = np.arange(len(rows)) % every == every // 2
    if not held.any() or held.all():
        raise GsbaError(f"{len(rows)} frames with poses are too few to hold one of {every} out")
    return Split(rows[~held], rows[held])


def refined_frames(reconstruction: Reconstruction) -> np.ndarray:
    """Frames (F,) bool whose refined poses images constrain."""
    return reconstruction.pose_statuses == PoseStatus.REFINED


def load_faces(frames: FrameSet, which: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Faces of some frames, 90 degrees wide.

    Returns:
        Images (6 W, size, size, 3) uint8 RGB, frame after frame, and where they count, bool.
    """
    rig = CubeRig(size, np.pi / 2)
    images = np.empty((len(which), 6, size, size, 3), np.uint8)
    use = np.ones((len(which), 6, size, size), bool)
    for i, f in enumerate(track(which, "cutting faces", total=len(which))):
        images[i], mask = cut_faces(frames, int(f), rig)
        if mask is not None:
            use[i] = mask
    return images.reshape(-1, size, size, 3), use.reshape(-1, size, size)


def cut_faces(frames: FrameSet, frame: int, rig: CubeRig) -> tuple[np.ndarray, np.ndarray | None]:
    """Faces whose pixels are means over their area, as a renderer's are.

    Sampling a panorama that was shrunk to the density of a face's middle would blur its corners,
    where three times as many pixels share an angle.

    Returns:
        (6, size, size, 3) uint8 RGB, and where they may be used, bool or None.
    """
    import cv2

    if not frames.panoramic:
        whole = cubemap.native_rig(frames)
    else:
        times = -(-frames.width / (2 * np.pi) // rig.focal)  # until no denser in the middle
        whole = replace(rig, size=int(np.clip(times, 1, _MAX_TIMES)) * rig.size)
    images, mask = cubemap.load(frames, frame, whole)
    if whole.size == rig.size:
        return images, mask
    shape = (rig.size, rig.size)
    way = cv2.INTER_AREA if rig.size < whole.size else cv2.INTER_CUBIC
    images = np.stack([cv2.resize(image, shape, interpolation=way) for image in images])
    if mask is None:
        return images, None
    shares = [cv2.resize(m.astype(np.float32), shape, interpolation=way) for m in mask]
    return images, np.stack(shares) > 0.999


def make_views(images: np.ndarray, use: np.ndarray, world_T_rigs: np.ndarray) -> Views:
    """Pose faces, dropping those with nothing to see.

    Args:
        images, use: of `load_faces`.
        world_T_rigs: (W, 4, 4) of their frames.
    """
    rig = CubeRig(images.shape[1], np.pi / 2)
    seen = np.flatnonzero(use.any(axis=(1, 2)))
    cameras = [face_camera(world_T_rigs[v // 6], int(v % 6), rig) for v in seen]
    if len(seen) < len(images):
        images, use = images[seen], use[seen]
    return Views(cameras, images, None if use.all() else use, seen // 6)


def place_points(
    reconstruction: Reconstruction, world_T_rigs: np.ndarray, frames: np.ndarray, gate_rad: float
) -> tuple[Landmarks, np.ndarray]:
    """The run's points, triangulated anew from some frames under given poses.

    Args:
        reconstruction: whose observations are used.
        world_T_rigs: (F, 4, 4) poses, in a world of their own; only those of `frames` are used.
        frames: frame indices.
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
        TriangulateSettings(),
        origins_rig=None if origins is None else origins[rows],
    )
    kept = np.empty(len(placed.points_world), np.int64)
    kept[placed.tracks.points] = points[placed.tracks.keypoints]
    tracks = replace(placed.tracks, keypoints=rows[placed.tracks.keypoints])
    return replace(placed, tracks=tracks), kept


def start_cloud(
    reconstruction: Reconstruction, world_T_rigs: np.ndarray, frames: np.ndarray, sh_degree: int
) -> Gaussians:
    """Gaussians at the run's points, placed in the world of any poses by one recipe.

    Args:
        reconstruction, world_T_rigs, frames: see `place_points`.
        sh_degree: of the Gaussians.
    """
    landmarks, known = place_points(reconstruction, world_T_rigs, frames, float(_GATE))
    return from_cloud(landmarks.points_world, reconstruction.point_colors[known], sh_degree)


def near_of(world_T_rigs: np.ndarray, settings: SplatSettings) -> float:
    """Least z, map units, of a Gaussian that is seen by rigs (N, 4, 4)."""
    return settings.near * extent_of(world_T_rigs[:, :3, 3])
