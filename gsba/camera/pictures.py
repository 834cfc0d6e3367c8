"""Pictures of any layout as functions of direction: where they show it, and their sample there."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from gsba.camera.equiangular import Grid, around_squares
from gsba.camera.fisheye import project
from gsba.camera.sphere import around_sphere, erp_from_bearings
from gsba.camera.straighten import PAD
from gsba.types import Fisheye


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture, and the pixels in which it shows directions."""

    image: np.ndarray  # (h, w[, C]) of any type that OpenCV samples
    places: Callable[[np.ndarray], np.ndarray]  # directions (..., 3), rig frame, to OpenCV pixels
    # (..., 2) float64

    def sample(self, directions: np.ndarray, how: int) -> np.ndarray:
        """Values (h, w[, C]) in directions (h, w, 3), by an interpolation of OpenCV."""
        places = self.places(directions).astype(np.float32)
        border = cv2.BORDER_REPLICATE
        return cv2.remap(self.image, places[..., 0], places[..., 1], how, borderMode=border)


def panorama(erp: np.ndarray) -> Picture:
    """A panorama (H, 2 H[, C]), continued over its seam and poles."""
    return padded_panorama(around_sphere(erp, PAD))


def padded_panorama(padded: np.ndarray) -> Picture:
    """A panorama with PAD pixels around it."""
    height, width = (size - 2 * PAD for size in padded.shape[:2])
    return Picture(padded, lambda shown: erp_from_bearings(shown, width, height) - 0.5 + PAD)


def cube_map(squares: np.ndarray, correction: tuple[float, ...] = ()) -> Picture:
    """An equi-angular cube map (6, S, S[, C]), FACES order; correction: coefficients of the
    stitching field, see `PictureFormat`."""
    return Picture(around_squares(squares), Grid(squares.shape[1], correction).places)


def lens_picture(lens: Fisheye, image: np.ndarray) -> Picture:
    """The picture of a raw lens, of its calibrated size or scaled."""
    scale = np.array(image.shape[1::-1]) / (lens.width, lens.height)
    return Picture(image, lambda shown: project(lens, shown) * scale - 0.5)
