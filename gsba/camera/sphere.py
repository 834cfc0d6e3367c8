"""Equirectangular pixels, the bearings that they show, and what lies beyond a picture's border."""

import functools
import threading
from collections.abc import Callable, Iterator
from typing import ParamSpec, TypeVar

import numpy as np

_BAND_ROWS = 256  # rows whose coordinates are held in double precision at once
_ROWS_AT_ONCE = 64  # rows moved at once, so that they stay in the cache


def bearings_from_erp(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """Unit bearings (..., 3) float64, rig frame (x right, y down, z forward = centre column), of
    equirectangular pixels (..., 2), (u, v), of an image of this size, width = 2 height; the centre
    of the top-left pixel is at (0.5, 0.5)."""
    longitude = 2 * np.pi * (pixels[..., 0] / width - 0.5)
    latitude = np.pi * (0.5 - pixels[..., 1] / height)
    c = np.cos(latitude)
    return np.stack([c * np.sin(longitude), -np.sin(latitude), c * np.cos(longitude)], axis=-1)


def row_bands(height: int) -> Iterator[slice]:
    """Yield the bands of a picture's rows."""
    for top in range(0, height, _BAND_ROWS):
        yield slice(top, min(top + _BAND_ROWS, height))


def pixel_bands(columns: np.ndarray, height: int) -> Iterator[tuple[slice, np.ndarray]]:
    """Yield rows and centres (h, C, 2) of the pixels of bands of a picture's columns (C,)."""
    for rows in row_bands(height):
        centres = np.meshgrid(columns + 0.5, np.arange(rows.start, rows.stop) + 0.5)
        yield rows, np.stack(centres, axis=-1)


def erp_bands(columns: np.ndarray, width: int) -> Iterator[tuple[slice, np.ndarray]]:
    """Yield rows and bearings (h, C, 3) of bands of columns (C,) of a panorama."""
    for rows, pixels in pixel_bands(columns, width // 2):
        yield rows, bearings_from_erp(pixels, width, width // 2)


def erp_directions(width: int) -> np.ndarray:
    """Bearings (width / 2, width, 3) of all pixels of a panorama that is held at once."""
    return np.concatenate([rays for _, rays in erp_bands(np.arange(width), width)])


def erp_from_bearings(bearings: np.ndarray, width: int, height: int) -> np.ndarray:
    """Equirectangular pixels, (..., 2) float64 with u in [0, width], of vectors (..., 3)."""
    x, y, z = bearings[..., 0], bearings[..., 1], bearings[..., 2]
    u = width * (np.arctan2(x, z) / (2 * np.pi) + 0.5)
    v = height * (0.5 + np.arctan2(y, np.hypot(x, z)) / np.pi)
    return np.stack([u, v], axis=-1)


def dense_enough(width: int, focal: float) -> int:
    """Width to average a panorama down to for pinhole images: detail beyond theirs aliases."""
    density = 2 * np.pi * focal  # panorama width at which pixels are as dense as in their middle
    return 2 * round(density / 2) if width > 1.5 * density else width


def low_passed(erp: np.ndarray, focal: float) -> np.ndarray:
    """A panorama averaged down to `dense_enough`; itself where it is no denser."""
    import cv2

    width = dense_enough(erp.shape[1], focal)
    if width == erp.shape[1]:
        return erp
    return cv2.resize(erp, (width, width // 2), interpolation=cv2.INTER_AREA)


def around_seam(image: np.ndarray, columns: int) -> np.ndarray:
    """A panorama (h, 2h[, C]) padded by columns from beyond the seam on either side."""
    return np.concatenate([image[:, -columns:], image, image[:, :columns]], axis=1)


def around_sphere(image: np.ndarray, pad: int, out: np.ndarray | None = None) -> np.ndarray:
    """A panorama (h, 2h[, C]) padded by what lies beyond seam and poles on the sphere; out: (h + 2
    pad, 2h + 2 pad[, C]) to fill. The panorama may already be in its middle, or occupy the end of
    its memory: no row is written over one that is still to be moved."""
    height, width = image.shape[:2]
    if out is None:
        shape = (height + 2 * pad, width + 2 * pad, *image.shape[2:])
        out = np.empty(shape, image.dtype)
    for top in range(0, height, _ROWS_AT_ONCE):
        rows = image[top : top + _ROWS_AT_ONCE]
        out[pad + top : pad + top + len(rows), pad:-pad] = rows
    inner = out[:, pad:-pad]
    inner[:pad] = np.roll(inner[pad : 2 * pad][::-1], width // 2, axis=1)
    inner[-pad:] = np.roll(inner[-2 * pad : -pad][::-1], width // 2, axis=1)
    out[:, :pad], out[:, -pad:] = inner[:, -pad:], inner[:, :pad]
    return out


P = ParamSpec("P")
T = TypeVar("T")


def table(maxsize: int) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """A `functools.lru_cache` that computes an entry once if several threads need it at once."""

    def kept(compute: Callable[P, T]) -> Callable[P, T]:
        cached, lock = functools.lru_cache(maxsize=maxsize)(compute), threading.Lock()

        @functools.wraps(compute)
        def look_up(*args: P.args, **kwargs: P.kwargs) -> T:
            with lock:
                return cached(*args, **kwargs)  # type: ignore[arg-type]

        return look_up

    return kept
