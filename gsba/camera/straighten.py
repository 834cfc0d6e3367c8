"""Panoramas resampled to undo the bending by stitching."""

import numpy as np

from gsba.camera.sphere import (
    around_sphere,
    bearings_from_erp,
    erp_directions,
    erp_from_bearings,
    pixel_bands,
    table,
)

PAD = 4  # pixels of wrap-around: the support of bicubic sampling, and more
_FIELD_GRID_WIDTH = 256  # width of the grid on which a field is evaluated; its shortest wave is 18
# degrees or more


def straightened(erp: np.ndarray, correction: tuple[float, ...]) -> np.ndarray:
    """A panorama (H, 2H[, C]) uint8, or bool for a mask, as a camera without the field would have
    taken it: resampled by Lanczos, masks by their nearest pixel; correction: coefficients of the
    field, see `factors.sphere_field`."""
    import cv2

    if erp.dtype == bool:
        padded = around_sphere(erp.astype(np.uint8), PAD)
        return straightened_inside(padded, correction, how=cv2.INTER_NEAREST) > 0
    return straightened_inside(around_sphere(erp, PAD), correction)


def straightened_inside(
    padded: np.ndarray,
    correction: tuple[float, ...],
    out: np.ndarray | None = None,
    how: int | None = None,
) -> np.ndarray:
    """Like `straightened`, uint8, for a panorama padded by PAD pixels; written to `out`, if given;
    how: an interpolation of OpenCV, None = by Lanczos."""
    import cv2

    height, width = (size - 2 * PAD for size in padded.shape[:2])
    maps = _maps(correction, width, height)
    how = cv2.INTER_LANCZOS4 if how is None else how
    return cv2.remap(padded, maps[0], maps[1], how, dst=out)


def observed(directions: np.ndarray, correction: tuple[float, ...]) -> np.ndarray:
    """Directions (h, w, 3) in which bent pictures show true directions (h, w, 3), unit, rig frame,
    by the field on a coarse grid, interpolated."""
    import cv2

    padded = _padded_offsets(correction)
    places = erp_from_bearings(directions, _FIELD_GRID_WIDTH, _FIELD_GRID_WIDTH // 2) - 0.5 + PAD
    places = places.astype(np.float32)
    return directions + cv2.remap(padded, places[..., 0], places[..., 1], cv2.INTER_CUBIC)


@table(maxsize=1)
def _maps(correction: tuple[float, ...], width: int, height: int) -> np.ndarray:
    """OpenCV pixels (2, H, W) float32 in the padded panorama, one for each pixel of the result."""
    import cv2

    offsets = _padded_offsets(correction)
    out = np.empty((2, height, width), np.float32)
    scale = offsets.shape[1] - 2 * PAD
    for rows, pixels in pixel_bands(np.arange(width), height):
        places = (pixels * (scale / width) - 0.5 + PAD).astype(np.float32)
        moved = cv2.remap(offsets, places[..., 0], places[..., 1], cv2.INTER_CUBIC)
        found = erp_from_bearings(bearings_from_erp(pixels, width, height) + moved, width, height)
        out[:, rows] = np.moveaxis(found - 0.5 + PAD, -1, 0)
    return out


@table(maxsize=2)
def _padded_offsets(correction: tuple[float, ...]) -> np.ndarray:
    from factors.sphere_field import SphereField

    directions = erp_directions(_FIELD_GRID_WIDTH)
    observed = SphereField(np.array(correction)).observed(directions)
    return around_sphere((observed - directions).astype(np.float32), PAD)
