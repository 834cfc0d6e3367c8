"""From a run to splats: posed faces, start clouds, training, and metrics of held-out frames."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsba.bundle import triangulation
from gsba.camera.rig import CubeRig, owner_faces
from gsba.config import SplatSettings, TriangulateSettings
from gsba.frames import cubemap
from gsba.geometry import bearings_from_erp
from gsba.log import GsbaError, track
from gsba.splat.backend import Backend
from gsba.splat.camera import face_camera, rig_cameras
from gsba.splat.gaussians import Gaussians, from_cloud
from gsba.splat.metrics import psnr, ssim
from gsba.splat.train import Views, extent_of
from gsba.types import FACES, FrameSet, Landmarks, PoseStatus, Reconstruction, Tracks

_GATE = np.deg2rad(3.0)  # of an observation under poses that may have drifted
_MAX_TIMES = 8  # samples of a panorama along a pixel of a face, at most
_ROUNDED_DB = 60.0  # of a face at most: rounding to 8 bits alone leaves 59
_PANORAMA_HFOV_DEG = 94.0  # of the faces a panorama is sampled from


@dataclass(frozen=True, slots=True)
class Split:
    """Which frames a splat is trained on and which it is measured on."""

    training: np.ndarray  # (T,) int, frame indices
    held_out: np.ndarray  # (H,) int, frame indices: whole panoramas


@dataclass(frozen=True, slots=True)
class Score:
    """How close renderings of a panorama's six faces are to what was captured."""

    psnr: float  # dB, over the pixels of all faces together
    ssim: float  # mean over faces
    psnr_exposed: float  # dB, after the gain of each channel that fits best: exposure aside
    lpips: float | None = None  # mean over faces; None = there were no weights


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

    if frames.layout == "cube":
        whole = CubeRig(frames.width, np.pi / 2)
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
    points = reconstruction.observation_points[rows]
    known, renumbered = np.unique(points, return_inverse=True)
    candidates = Tracks(
        renumbered.astype(np.int32),
        reconstruction.observation_frames[rows],
        np.arange(len(rows), dtype=np.int32),
        len(known),
    )
    placed = triangulation.run(
        candidates,
        reconstruction.observation_bearings[rows],
        np.ones(len(rows)),
        world_T_rigs,
        gate_rad,
        TriangulateSettings(),
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


Distance = Callable[[np.ndarray, np.ndarray, np.ndarray | None], float]


def measure(
    gaussians: Gaussians,
    views: Views,
    settings: SplatSettings,
    near: float,
    backend: Backend,
    lpips: Distance | None = None,
) -> dict[int, Score]:
    """Scores of panoramas, by their number in the views.

    Args:
        gaussians: the splat.
        views: held-out faces; a panorama that is masked altogether has none, and no score.
        settings: degree of the harmonics.
        near: least z of a Gaussian, map units.
        backend: the renderer.
        lpips: see `gsba.splat.lpips`; None = leave it out.

    Raises:
        GsbaError: no panorama has a pixel to measure.
    """
    return {
        int(views.panoramas[rows[0]]): _score(
            gaussians, views, rows, settings, near, backend, lpips
        )
        for rows in _panoramas(views)
    }


def face_psnrs(
    gaussians: Gaussians, views: Views, settings: SplatSettings, near: float, backend: Backend
) -> np.ndarray:
    """PSNR of each view (V,) in dB, after the gain of each channel that fits its panorama best.

    Args:
        gaussians, views, settings, near, backend: see `measure`.

    Raises:
        GsbaError: no panorama has a pixel to measure.
    """
    found = np.zeros(len(views.cameras))
    for rows in _panoramas(views):
        pairs = _pairs(gaussians, views, rows, settings, near, backend)
        gains = _gains(
            [image[use] for image, _, use in pairs], [real[use] for _, real, use in pairs]
        )
        for v, (image, real, use) in zip(rows, pairs, strict=True):
            found[v] = min(psnr(np.clip(gains * image, 0, 1), real, use), _ROUNDED_DB)
    return found


def _panoramas(views: Views) -> list[np.ndarray]:
    """Rows of the views of each panorama.

    Raises:
        GsbaError: there is none.
    """
    if len(views.cameras) == 0:
        raise GsbaError("no pixel to measure a splat on: all held-out frames are masked")
    return [np.flatnonzero(views.panoramas == i) for i in np.unique(views.panoramas)]


def _pairs(
    gaussians: Gaussians,
    views: Views,
    rows: np.ndarray,
    settings: SplatSettings,
    near: float,
    backend: Backend,
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Of each view: rendering and truth (H, W, 3) float32, 0..1, and where they count, bool."""
    cameras = [views.cameras[v] for v in rows]
    renderings = backend.render(gaussians, cameras, settings.sh_degree, near)
    pairs = []
    for v, rendering in zip(rows, renderings, strict=True):
        image, real = np.clip(rendering.color, 0, 1), views.images[v].astype(np.float32) / 255
        use = np.ones(real.shape[:2], bool) if views.use is None else views.use[v]
        pairs.append((image, real, use))
    return pairs


def _gains(images: Sequence[np.ndarray], truths: Sequence[np.ndarray]) -> np.ndarray:
    """Gain of each channel (3,) that carries pixels (N, 3) closest to what they should be."""
    image, real = np.concatenate(images), np.concatenate(truths)
    return np.sum(image * real, axis=0) / np.maximum(np.sum(image * image, axis=0), 1e-9)


def _score(
    gaussians: Gaussians,
    views: Views,
    rows: np.ndarray,
    settings: SplatSettings,
    near: float,
    backend: Backend,
    lpips: Distance | None,
) -> Score:
    found, truth, similarities, distances = [], [], [], []
    for image, real, use in _pairs(gaussians, views, rows, settings, near, backend):
        similarities.append(ssim(image, real, use))
        if lpips is not None:
            distances.append(lpips(image, real, use))
        found.append(image[use])
        truth.append(real[use])
    gains = _gains(found, truth)
    image, real = np.concatenate(found), np.concatenate(truth)
    exposed = psnr(np.clip(gains * image, 0, 1), real)
    far = float(np.mean(distances)) if distances else None
    return Score(psnr(image, real), float(np.nanmean(similarities)), exposed, far)


def mean_score(scores: Iterable[Score]) -> Score:
    """Mean of each metric over panoramas."""
    scores = list(scores)
    columns = ((s.psnr, s.ssim, s.psnr_exposed) for s in scores)
    distances = [s.lpips for s in scores if s.lpips is not None]
    far = float(np.mean(distances)) if distances else None
    means = Score(*(float(np.mean(column)) for column in zip(*columns, strict=True)))
    return replace(means, lpips=far)


def near_of(world_T_rigs: np.ndarray, settings: SplatSettings) -> float:
    """Least z, map units, of a Gaussian that is seen by rigs (N, 4, 4)."""
    return settings.near * extent_of(world_T_rigs[:, :3, 3])


def render_faces(
    gaussians: Gaussians, world_T_rig: np.ndarray, rig: CubeRig, near: float, backend: Backend
) -> np.ndarray:
    """The six faces (6, size, size, 3) uint8 RGB of a rig, in FACES order."""
    renderings = backend.render(gaussians, rig_cameras(world_T_rig, rig), None, near)
    return np.stack([to_uint8(rendering.color) for rendering in renderings])


def render_panorama(
    gaussians: Gaussians, world_T_rig: np.ndarray, width: int, near: float, backend: Backend
) -> np.ndarray:
    """An equirectangular image (width / 2, width, 3) uint8 RGB, sampled from wider faces."""
    import cv2

    hfov = np.deg2rad(_PANORAMA_HFOV_DEG)
    rig = CubeRig(round(width / np.pi * np.tan(hfov / 2)), hfov)  # as dense as the equator
    faces = render_faces(gaussians, world_T_rig, rig, near, backend)
    height = width // 2
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    bearings = bearings_from_erp(np.stack([u, v], axis=-1), width, height)
    owners = owner_faces(bearings)
    at = (rig.project(bearings, owners) - 0.5).astype(np.float32)
    image = np.empty((height, width, 3), np.uint8)
    for face in range(len(FACES)):
        sampled = cv2.remap(faces[face], at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        image[owners == face] = sampled[owners == face]
    return image


def to_uint8(color: np.ndarray) -> np.ndarray:
    """Colours 0..1 as 0..255, limited and rounded."""
    return (np.clip(color, 0, 1) * 255 + 0.5).astype(np.uint8)
