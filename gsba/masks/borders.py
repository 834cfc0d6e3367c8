"""Areas that are black in every panorama: poles and borders without pixels, shapes painted over.

No scene stays black to the last grey level while the camera moves; what does holds no pixels of
it, but its rim looks like a structure that moves with the camera.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from gsba.camera.sphere import around_seam
from gsba.frames.files import image_header
from gsba.frames.pixels import load_erp
from gsba.types import FrameSet, rows_across

_WIDTH_PX = 512  # pixels across the pictures that are compared
_MAX_BLACK_LEVEL = 6  # grey levels: JPEG's noise around 0
_MIN_SHARE, _MAX_SHARE = 0.002, 0.6  # of the picture: smaller areas are dark corners of the scene,
# with larger ones frames are dark


@dataclass(frozen=True, slots=True)
class Borders:
    """Areas without pixels in all frames of a camera."""

    mask: np.ndarray  # (h, 2h) bool, True = use; smaller than the frames
    share: float  # part of the picture that is black; 0 = none


def find_borders(frames: FrameSet) -> Borders:
    """Detect areas that are black in all panoramas; raw lenses and cube faces have none."""
    everything = np.ones((_WIDTH_PX // 2, _WIDTH_PX), bool)
    if frames.format.layout != "erp" or frames.format.width < _WIDTH_PX:
        return Borders(everything, 0.0)
    brightest = np.zeros(everything.shape, np.uint8)
    for f in rows_across(len(frames), 8):
        grey = load_erp(frames, int(f), gray=True, width=_WIDTH_PX)
        np.maximum(brightest, cv2.resize(grey, everything.shape[::-1]), out=brightest)
        if not (brightest <= _MAX_BLACK_LEVEL).any():
            return Borders(everything, 0.0)
    found = black_areas(brightest)
    share = float(found.mean())
    if not share:
        return Borders(everything, 0.0)
    return Borders(~widened(found, 3), share)  # pixels beside black areas


def widened(places: np.ndarray, pixels: int) -> np.ndarray:
    """Places (h, 2h) bool and those within some pixels of them, over the seam, too."""
    around, size = around_seam(places.astype(np.uint8), pixels), 2 * pixels + 1
    return cv2.dilate(around, np.ones((size, size), np.uint8))[:, pixels:-pixels] > 0


def black_areas(brightest: np.ndarray) -> np.ndarray:
    """Large areas (h, 2h) bool of no pixels, by the largest grey level uint8 of each in all
    pictures; none if most of the picture is as dark."""
    black = (brightest <= _MAX_BLACK_LEVEL).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(black, connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= _MIN_SHARE * black.size
    large[0] = False
    found = large[labels.astype(np.intp)] if count > 1 else np.zeros(black.shape, bool)
    return found if found.mean() <= _MAX_SHARE else np.zeros_like(found)


def padded(frames: FrameSet) -> bool:
    """True if panoramas are padded to the sphere, by their GPano tags."""
    return any(image_header(frames.paths[f][0]).crop is not None for f in (0, len(frames) - 1))
