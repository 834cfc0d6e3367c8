"""The worst frames as small panoramas with the residuals of their observations."""

import base64
import dataclasses
from typing import Any

import numpy as np

from gsba.camera.rig import CubeRig, owner_faces
from gsba.camera.sphere import bearings_from_erp, erp_from_bearings
from gsba.frames.pixels import load_erp, load_faces
from gsba.report.html.figures import tangent_residuals
from gsba.report.report import frame_quality
from gsba.types import FACES, FrameSet, Reconstruction

NUM_PICTURES = 6
_WIDTH = 720  # pixels across an image
_JPEG_QUALITY = 72
_MAX_VECTORS = 350  # residuals in an image


def worst_frames(reconstruction: Reconstruction) -> list[int]:
    """Frames by falling median residual, at most `NUM_PICTURES`, without unobserved ones."""
    residuals = frame_quality(reconstruction).median_residuals_deg
    order = np.argsort(-np.nan_to_num(residuals, nan=-1.0), kind="stable")
    return [int(f) for f in order[:NUM_PICTURES] if np.isfinite(residuals[f])]


def picture(frames: FrameSet, reconstruction: Reconstruction, f: int) -> dict[str, Any]:
    """Frame as JPEG (base64) with the residuals of its observations.

    Returns:
        "frame", "jpeg", "width", "height" in pixels, and "vectors" (N, 4): position of the
        observation relative to width and height, and predicted minus observed direction in
        degrees of longitude and latitude.
    """
    rows = np.flatnonzero(reconstruction.observation_frames == f)
    if len(rows) > _MAX_VECTORS:
        rows = rows[np.linspace(0, len(rows) - 1, _MAX_VECTORS).astype(int)]
    bearings = reconstruction.observation_bearings[rows]
    residuals = np.degrees(_of_rows(reconstruction, rows))
    level = np.maximum(np.hypot(bearings[:, 0], bearings[:, 2]), 0.05)
    places = erp_from_bearings(bearings, 1, 1)
    vectors = np.column_stack([places, residuals[:, 0] / level, residuals[:, 1]])
    return {
        "frame": f,
        "jpeg": _jpeg(_small_panorama(frames, f)),
        "width": _WIDTH,
        "height": _WIDTH // 2,
        "vectors": vectors.round(5),
    }


def _of_rows(reconstruction: Reconstruction, rows: np.ndarray) -> np.ndarray:
    """Tangent residuals (N, 2) of observations `rows` (N,), radians."""
    origins = reconstruction.observation_origins
    chosen = dataclasses.replace(
        reconstruction,
        observation_points=reconstruction.observation_points[rows],
        observation_frames=reconstruction.observation_frames[rows],
        observation_origins=None if origins is None else origins[rows],
        observation_bearings=reconstruction.observation_bearings[rows],
    )
    return tangent_residuals(chosen)


def _small_panorama(frames: FrameSet, f: int) -> np.ndarray:
    """Panorama (H, W, 3) uint8 RGB of a frame, assembled from cube faces if it has faces only."""
    kind = frames.format_of(f)
    import cv2

    if kind.panoramic:
        erp = load_erp(frames, f, width=_WIDTH)
        return cv2.resize(erp, (_WIDTH, _WIDTH // 2), interpolation=cv2.INTER_AREA)
    faces, rig = load_faces(frames, f), CubeRig(kind.width, np.pi / 2)
    centres = np.stack(np.meshgrid(np.arange(_WIDTH), np.arange(_WIDTH // 2)), axis=-1) + 0.5
    bearings = bearings_from_erp(centres, _WIDTH, _WIDTH // 2)
    owners = owner_faces(bearings)
    out = np.zeros((*owners.shape, 3), np.uint8)
    for image, name in zip(faces, kind.faces, strict=True):
        own = owners == FACES.index(name)
        pixels = np.floor(rig.project(bearings[own], FACES.index(name)))
        columns, rows = np.clip(pixels, 0, rig.size - 1).astype(int).T
        out[own] = image[rows, columns]
    return out


def _jpeg(image: np.ndarray) -> str:
    import cv2

    encoded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
    return base64.b64encode(encoded.tobytes()).decode("ascii")
