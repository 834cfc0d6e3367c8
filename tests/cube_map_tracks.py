"""Both tracks of an equi-angular cube map of a sphere of colours, written down square by square."""

from collections.abc import Callable

import cv2
import numpy as np
from synthetic import unit

from gsba.camera.sphere import around_sphere, erp_from_bearings
from gsba.camera.straighten import PAD


def track_directions(size: int, overlap: int) -> np.ndarray:
    """Where pixels of both tracks look, (2, size, 3 size + 2 overlap, 3), not unit."""
    middle = (np.arange(size) + 0.5) / size - 0.5
    half = (size + overlap) // 2
    columns = (np.arange(half) + 0.5) / size - 0.5
    side = np.concatenate([columns, columns + (half - overlap) / size])
    wide, narrow = (
        np.meshgrid(np.tan(np.pi / 2 * u), np.tan(np.pi / 2 * middle)) for u in (side, middle)
    )
    (u, v), one = wide, np.ones_like(wide[0])
    left, right = [-one, v, u], [one, v, -u]
    down, up = [-v, one, -u], [-v, -one, u]
    u, v = narrow
    front, back = [u, v, np.ones_like(u)], [-v, -u, -np.ones_like(u)]
    rows = [[left, front, right], [down, back, up]]
    return np.stack([np.concatenate([np.stack(s, -1) for s in row], axis=1) for row in rows])


def picture_tracks(
    size: int, overlap: int, seen: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Tracks (size, 3 size + 2 overlap[, C]) uint8 of what is seen in unit directions (..., 3)."""
    directions = unit(track_directions(size, overlap))
    first, second = np.rint(seen(directions)).astype(np.uint8)
    return first, second


def looking_up(erp: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """What a panorama (H, 2 H, C) uint8 shows in directions (T, h, w, 3)."""
    padded, (height, width) = around_sphere(erp, PAD), erp.shape[:2]

    def seen(directions: np.ndarray) -> np.ndarray:
        places = (erp_from_bearings(directions, width, height) - 0.5 + PAD).astype(np.float32)
        parts = [np.moveaxis(part, -1, 0) for part in places]
        return np.stack([cv2.remap(padded, u, v, cv2.INTER_CUBIC) for u, v in parts])

    return seen
