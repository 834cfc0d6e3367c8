"""Panoramas of raw fisheyes: the lens that faces a direction shows it; nothing is blended."""

import cv2
import numpy as np

from gsba.camera.fisheye import Rig, facing, optical_axes, project
from gsba.camera.lens import seam_sines
from gsba.camera.sphere import erp_bands, table
from gsba.frames.raw_pairs import decode_pair
from gsba.types import FrameSet

SEAM = np.deg2rad(1.5)  # angle from the seam within which a window shows both lenses


def width_of(rig: Rig) -> int:
    """Pixels across a panorama as dense as the middle of a fisheye."""
    return 16 * round(2 * np.pi * max(lens.focal for lens in rig) / 16)


def load_raw(frames: FrameSet, f: int, gray: bool = False) -> list[np.ndarray]:
    """Pictures (h, w[, 3]) uint8 of all lenses of frame f, as stored on disk."""
    kind = frames.format_of(f)
    assert kind.fisheyes is not None
    lens = kind.fisheyes[0]
    return decode_pair(frames.paths[f], (lens.width, lens.height), gray)


def load_joined(frames: FrameSet, f: int, gray: bool, width: int) -> np.ndarray:
    """Panorama (width / 2, width[, 3]) uint8 of frame f, by its current calibration."""
    kind = frames.format_of(f)
    assert kind.fisheyes is not None
    pictures = load_raw(frames, f, gray)
    return join_pictures(pictures, kind.fisheyes, width, width / kind.width)


def join_pictures(pictures: list[np.ndarray], rig: Rig, width: int, share: float) -> np.ndarray:
    """Panorama (width / 2, width[, 3]) uint8 joined from each lens's picture.

    Args:
        pictures: (h, w[, 3]) uint8 of each lens.
        share: its width over that of a panorama as dense as the pictures.
    """
    joined = np.empty((width // 2, width, *pictures[0].shape[2:]), np.uint8)
    for picture, (columns, places, own) in zip(pictures, _parts(rig, width), strict=True):
        if share < 1:
            size = picture.shape[1::-1]
            shrunk = [max(round(share * pixels), 1) for pixels in size]
            picture = cv2.resize(picture, shrunk, interpolation=cv2.INTER_AREA)
            scale = np.array(picture.shape[1::-1]) / size
            places = ((places + 0.5) * scale - 0.5).astype(np.float32)
        nothing, how = np.zeros(0, np.float32), cv2.INTER_LANCZOS4
        shown = cv2.remap(picture, places, nothing, how, borderMode=cv2.BORDER_REPLICATE)
        if own is not None:
            own = own.reshape(*own.shape, *[1] * (shown.ndim - 2))
            shown = np.where(own, shown, joined[:, columns])
        joined[:, columns] = shown
    return joined


@table(maxsize=2)
def clear_of_seam(height: int, rig: Rig) -> np.ndarray:
    """Mask (height, 2 height) bool, True where windows of raw fisheyes' panorama show one lens
    only; read-only."""
    clear, axes = np.empty((height, 2 * height), bool), optical_axes(rig)
    for rows, bearings in erp_bands(np.arange(2 * height), 2 * height):
        clear[rows] = seam_sines(bearings, axes) > np.sin(SEAM)
    clear.setflags(write=False)
    return clear


@table(maxsize=2)
def _parts(rig: Rig, width: int) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray | None], ...]:
    """The part of a panorama that each lens shows: columns (C,) of the panorama; their places
    (H, C, 2) float32, OpenCV pixels in the lens's picture; and (H, C) bool, True where this lens
    faces the direction, None = everywhere."""
    height, axes, faced = width // 2, optical_axes(rig), np.empty((width // 2, width), np.uint8)
    # a column that lies exactly on a seam goes whole to the lens on its right
    aside = np.arange(width) + 1e-6
    for rows, bearings in erp_bands(aside, width):
        faced[rows] = facing(bearings, axes)
    parts = []
    for number, lens in enumerate(rig):
        own = faced == number
        columns = np.flatnonzero(own.any(axis=0))
        places = np.empty((height, len(columns), 2), np.float32)
        for rows, bearings in erp_bands(columns, width):
            places[rows] = project(lens, bearings) - 0.5
        own = own[:, columns]
        parts.append((columns, places, None if own.all() else own))
    return tuple(parts)
