"""The worst frames as small panoramas with the residuals of their observations."""

import base64
import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from gsba.camera.fisheye import facing, optical_axes, project
from gsba.camera.rig import CubeRig, owner_faces
from gsba.camera.sphere import erp_directions, erp_from_bearings
from gsba.frames.files import decode
from gsba.frames.pixels import load_erp, load_faces
from gsba.report.html.figures import tangent_residuals
from gsba.report.report import frame_quality
from gsba.types import FACES, FrameSet, Reconstruction, rows_across

NUM_PICTURES = 6
_WIDTH = 720  # pixels across an image


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
    rows = rows[rows_across(len(rows), 350)]  # more would hide the image
    bearings = reconstruction.observation_bearings[rows]
    residuals = np.degrees(residuals_of_rows(reconstruction, rows))
    level = np.maximum(np.hypot(bearings[:, 0], bearings[:, 2]), 0.05)
    places = erp_from_bearings(bearings, 1, 1)
    vectors = np.column_stack([places, residuals[:, 0] / level, residuals[:, 1]])
    return {
        "frame": f,
        "jpeg": jpeg_text(small_panorama(frames, f, _WIDTH), [72]),
        "width": _WIDTH,
        "height": _WIDTH // 2,
        "vectors": vectors.round(5),
    }


def residuals_of_rows(reconstruction: Reconstruction, rows: np.ndarray) -> np.ndarray:
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


def small_panorama(frames: FrameSet, f: int, width: int) -> np.ndarray:
    """Panorama (width / 2, width, 3) uint8 RGB of a frame, black where it has no face.

    Raw lenses and faces are read at a part of their size and sampled at the nearest pixel.
    """
    kind = frames.format_of(f)
    import cv2

    raw = kind.fisheyes is not None and len(set(frames.paths[f])) == len(kind.fisheyes)
    if kind.panoramic and not raw:
        erp = load_erp(frames, f, width=width)
        return cv2.resize(erp, (width, width // 2), interpolation=cv2.INTER_AREA)
    bearings = erp_directions(width)
    out = np.zeros((width // 2, width, 3), np.uint8)
    if raw:
        rig = kind.fisheyes or ()
        owners = facing(bearings, optical_axes(rig))
        for number, (lens, path) in enumerate(zip(rig, frames.paths[f], strict=True)):
            image, own = decode(path, (lens.width, lens.height), at_least=width), owners == number
            scale = image.shape[1] / lens.width
            out[own] = _nearest(image, scale * project(lens, bearings[own]))
        return out
    size = min(kind.width, width // 2)
    rig, owners = CubeRig(size, np.pi / 2), owner_faces(bearings)
    for image, name in zip(load_faces(frames, f, size=size), kind.faces, strict=True):
        own = owners == FACES.index(name)
        out[own] = _nearest(image, rig.project(bearings[own], FACES.index(name)))
    return out


def _nearest(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Colours (N, 3) of an image (H, W, 3) at pixels (N, 2), corner origin."""
    height, width = image.shape[:2]
    columns, rows = np.nan_to_num(np.floor(pixels)).astype(int).T
    return image[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]


def jpeg_text(image: np.ndarray, qualities: Sequence[int], room: int | None = None) -> str:
    """JPEG (base64) of an RGB image in the first quality in which it has at most `room` bytes, else
    in the last one."""
    import cv2

    encoded = b""
    for quality in qualities:
        how = [cv2.IMWRITE_JPEG_QUALITY, quality]
        how += [] if room is None else [cv2.IMWRITE_JPEG_OPTIMIZE, 1]
        encoded = cv2.imencode(".jpg", image[..., ::-1], how)[1].tobytes()
        if room is None or len(encoded) <= room:
            break
    return base64.b64encode(encoded).decode("ascii")
