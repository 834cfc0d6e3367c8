"""Patches that fit worst: a point's surroundings in one frame, and as another frame shows them."""

import base64
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from factors.sphere_field import SphereField
from gsba.camera.cameras import Cameras
from gsba.camera.sphere import erp_from_bearings
from gsba.geometry import unit
from gsba.log import GsbaError
from gsba.report.html.figures import level_axes
from gsba.report.html.pictures import residuals_of_rows, small_panorama
from gsba.types import FrameSet, Reconstruction

_REACH = 12  # pixels from a patch's centre to its edge
_MAX_WIDTH = 2048  # pixels of the panoramas that patches are cut from


def worst_patches(
    frames: FrameSet, reconstruction: Reconstruction, cameras: Cameras, worst: Sequence[int]
) -> list[dict[str, Any]]:
    """The point that fits worst of each of the worst frames.

    The surface around the point faces the reference, the frame in which the point fits best.

    Returns:
        "frame", "reference", "residual_deg" in the frame, "correlation" of both patches, and "png"
        (base64): grey patches of reference and frame side by side, and their difference around
        middle grey, both patches with the same mean and contrast.
    """
    import cv2

    width = min(max(kind.panorama_width for kind in frames.formats), _MAX_WIDTH)

    @cache
    def grey(f: int) -> np.ndarray:
        red, green, blue = np.moveaxis(small_panorama(frames, f, width), 2, 0).astype(np.float32)
        return (red + green + blue) / 3

    found = []
    for f in worst:
        row, host, residual = _worst_observation(reconstruction, f)
        point = reconstruction.points_world[reconstruction.observation_points[row]]
        grid = _facing_plane(point, reconstruction.world_T_rigs[host], 2 * np.pi / width)
        try:
            pair = [_sampled(grey(g), grid, g, frames, reconstruction, cameras) for g in (host, f)]
        except GsbaError:  # a picture that vanished; the pictures of all frames name it
            continue
        level = [(patch - patch.mean()) / max(float(patch.std()), 1e-6) for patch in pair]
        strip = np.clip(128 + 50 * np.hstack([*level, level[0] - level[1]]), 0, 255)
        png = cv2.imencode(".png", strip.astype(np.uint8))[1].tobytes()
        found.append(
            {
                "frame": f,
                "reference": host,
                "residual_deg": np.degrees(residual),
                "correlation": float(np.mean(level[0] * level[1])),
                "png": base64.b64encode(png).decode("ascii"),
            }
        )
    return found


def _worst_observation(reconstruction: Reconstruction, f: int) -> tuple[int, int, float]:
    """Observation of a frame with the largest residual, the frame in which its point fits best
    besides, and the residual in radians."""
    points, owners = reconstruction.observation_points, reconstruction.observation_frames
    rows = np.flatnonzero(owners == f)
    sizes = np.linalg.norm(residuals_of_rows(reconstruction, rows), axis=1)
    row = int(rows[sizes.argmax()])
    others = np.flatnonzero((points == points[row]) & (owners != f))
    fits = np.linalg.norm(residuals_of_rows(reconstruction, others), axis=1)
    return row, int(owners[others[fits.argmin()]]), float(sizes.max())


def _facing_plane(point: np.ndarray, world_T_host: np.ndarray, pixel: float) -> np.ndarray:
    """Points (N, N, 3), world, on the plane through a point that faces a frame, upright there and a
    pixel apart."""
    local = world_T_host[:3, :3].T @ (point - world_T_host[:3, 3])
    depth = np.linalg.norm(local)
    (east,), (south,) = level_axes(local[None] / depth)
    steps = pixel * depth * np.arange(-_REACH, _REACH + 1)
    local = local + steps[None, :, None] * east + steps[:, None, None] * south
    return local @ world_T_host[:3, :3].T + world_T_host[:3, 3]


def _sampled(
    grey: np.ndarray,
    points_world: np.ndarray,
    f: int,
    frames: FrameSet,
    reconstruction: Reconstruction,
    cameras: Cameras,
) -> np.ndarray:
    """Grey values (N, N) of a frame's panorama where it shows points (N, N, 3)."""
    import cv2

    pose = reconstruction.world_T_rigs[f]
    local = ((points_world - pose[:3, 3]) @ pose[:3, :3]).reshape(-1, 3)
    if cameras:
        local = cameras.seeing(local, np.full(len(local), f))
    bearings = SphereField(np.array(frames.format_of(f).correction)).observed(unit(local))
    at = erp_from_bearings(bearings, grey.shape[1], grey.shape[0]).astype(np.float32) - 0.5
    at = at.reshape(*points_world.shape[:2], 2)
    return cv2.remap(grey, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
