"""Panoramas of raw pairs: the lens that faces a direction shows it; nothing is blended."""

import cv2
import numpy as np

from gsba.camera.fisheye import Pair, project
from gsba.camera.sphere import bearings_from_erp
from gsba.camera.tables import table
from gsba.frames.raw_pairs import decode_pair
from gsba.types import FrameSet

_ROWS_AT_ONCE = 256  # rows whose coordinates are held in double precision at once
SEAM = np.deg2rad(1.5)  # angle from the seam within which a window shows both lenses


def width_of(pair: Pair) -> int:
    """Pixels across a panorama as dense as the middle of a fisheye."""
    return 16 * round(2 * np.pi * max(lens.focal for lens in pair) / 16)


def load_raw(frames: FrameSet, f: int, gray: bool = False) -> list[np.ndarray]:
    """Pictures (h, w[, 3]) uint8 of both lenses of frame f, as stored on disk."""
    assert frames.fisheyes is not None
    lens = frames.fisheyes[0]
    return decode_pair(frames.paths[f], (lens.width, lens.height), gray)


def load_joined(frames: FrameSet, f: int, gray: bool, width: int) -> np.ndarray:
    """Panorama (width / 2, width[, 3]) uint8 of frame f, by its current calibration."""
    assert frames.fisheyes is not None
    pictures = load_raw(frames, f, gray)
    return join_pictures(pictures, frames.fisheyes, width, width / frames.width)


def join_pictures(pictures: list[np.ndarray], pair: Pair, width: int, share: float) -> np.ndarray:
    """Panorama (width / 2, width[, 3]) uint8 joined from the front and the back lens's picture.

    Args:
        pictures: (h, w[, 3]) uint8 of each lens.
        pair: their lenses.
        width: pixels across the panorama.
        share: its width over that of a panorama as dense as the pictures.
    """
    halves, maps = [], _maps(pair, width)
    for picture, places in zip(pictures, maps, strict=True):
        if share < 1:
            size = picture.shape[1::-1]
            picture = _shrunk(picture, share)
            scale = np.array(picture.shape[1::-1]) / size
            places = ((places + 0.5) * scale - 0.5).astype(np.float32)
        halves.append(_picture_at(picture, places))
    front, back = halves
    right, left = np.split(back, [width - _first(width) - width // 2], axis=1)
    return np.concatenate([left, front, right], axis=1)


@table(maxsize=2)
def clear_of_seam(height: int) -> np.ndarray:
    """Mask (height, 2 height) bool, True where windows of a raw pair's panorama show one lens
    only."""
    clear = np.empty((height, 2 * height), bool)
    for top in range(0, height, _ROWS_AT_ONCE):
        rows = np.arange(top, min(top + _ROWS_AT_ONCE, height)) + 0.5
        pixels = np.stack(np.meshgrid(np.arange(2 * height) + 0.5, rows), axis=-1)
        ahead = bearings_from_erp(pixels, 2 * height, height)[..., 2]
        clear[top : top + len(rows)] = np.abs(ahead) > np.sin(SEAM)
    clear.setflags(write=False)
    return clear


def _picture_at(picture: np.ndarray, places: np.ndarray) -> np.ndarray:
    nothing, how = np.zeros(0, np.float32), cv2.INTER_LANCZOS4
    return cv2.remap(picture, places, nothing, how, borderMode=cv2.BORDER_REPLICATE)


def _first(width: int) -> int:
    """The first column that the front lens faces."""
    return (width + 1) // 4


def _shrunk(picture: np.ndarray, share: float) -> np.ndarray:
    height, width = (max(round(share * size), 1) for size in picture.shape[:2])
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)


@table(maxsize=2)
def _maps(pair: Pair, width: int) -> tuple[np.ndarray, np.ndarray]:
    """OpenCV pixels (H, W / 2, 2) float32 in the front and the back picture of half a panorama
    each; columns of the back half begin at the right edge of the front half."""
    height, maps = width // 2, []
    for lens, first in zip(pair, (_first(width), _first(width) + width // 2), strict=True):
        columns = (first + np.arange(width // 2) + 0.5) % width
        places = np.empty((height, width // 2, 2), np.float32)
        for top in range(0, height, _ROWS_AT_ONCE):
            rows = np.arange(top, min(top + _ROWS_AT_ONCE, height)) + 0.5
            pixels = np.stack(np.meshgrid(columns, rows), axis=-1)
            found = project(lens, bearings_from_erp(pixels, width, height))
            places[top : top + len(rows)] = found - 0.5
        maps.append(places)
    return maps[0], maps[1]
