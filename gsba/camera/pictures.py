"""Pictures of any layout as functions of direction: where they show it, and their sample there."""

from dataclasses import dataclass

import cv2
import numpy as np

from gsba.camera.equiangular import Grid, around_squares, shrunk
from gsba.camera.fisheye import project
from gsba.camera.sphere import around_sphere, dense_enough, erp_from_bearings, low_passed
from gsba.camera.straighten import PAD
from gsba.types import Fisheye

_MAX_OVERSAMPLING = 1.5  # largest ratio of a raw picture's density to a view's: beyond it, detail
# aliases


@dataclass(frozen=True, slots=True)
class PanoramaGrid:
    """Pixels of directions in a panorama with PAD pixels around it."""

    width: int  # pixels, without those around
    height: int

    def places(self, directions: np.ndarray) -> np.ndarray:
        """OpenCV pixels (..., 2) float64 of directions (..., 3), rig frame."""
        return erp_from_bearings(directions, self.width, self.height) - 0.5 + PAD


@dataclass(frozen=True, slots=True)
class LensGrid:
    """Pixels of directions in the picture of a raw lens, of its calibrated size or scaled."""

    lens: Fisheye
    width: int  # pixels of the picture
    height: int

    def places(self, directions: np.ndarray) -> np.ndarray:
        """OpenCV pixels (..., 2) float64 of directions (..., 3), rig frame."""
        scale = np.array([self.width, self.height]) / (self.lens.width, self.lens.height)
        return project(self.lens, directions) * scale - 0.5


AnyGrid = PanoramaGrid | Grid | LensGrid


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture, and the pixels in which it shows directions."""

    image: np.ndarray  # (h, w[, C]) of any type that OpenCV samples
    grid: AnyGrid

    def sample(self, directions: np.ndarray, how: int) -> np.ndarray:
        """Values (h, w[, C]) in directions (h, w, 3), by an interpolation of OpenCV."""
        return self.at(self.grid.places(directions), how)

    def at(self, places: np.ndarray, how: int) -> np.ndarray:
        """Values (h, w[, C]) at OpenCV pixels (h, w, 2), by an interpolation of OpenCV."""
        places, border = places.astype(np.float32, copy=False), cv2.BORDER_REPLICATE
        return cv2.remap(self.image, places[..., 0], places[..., 1], how, borderMode=border)


# Pictures for pinhole views of a focal length, pixels, are averaged down to about their density.


def panorama(erp: np.ndarray, focal: float = np.inf) -> Picture:
    """A panorama (H, 2 H[, C]), continued over its seam and poles."""
    padded = around_sphere(low_passed(erp, focal), PAD)
    return Picture(padded, PanoramaGrid(*_inner(padded).shape[1::-1]))


def padded_panorama(padded: np.ndarray, focal: float = np.inf) -> Picture:
    """A panorama with PAD pixels around it."""
    inner = _inner(padded)
    if dense_enough(inner.shape[1], focal) < inner.shape[1]:
        return panorama(inner, focal)
    return Picture(padded, PanoramaGrid(*inner.shape[1::-1]))


def cube_map(
    squares: np.ndarray, correction: tuple[float, ...] = (), focal: float = np.inf
) -> Picture:
    """An equi-angular cube map (6, S, S[, C]), FACES order; correction: coefficients of the
    stitching field, see `PictureFormat`."""
    squares = shrunk(squares, dense_enough(4 * squares.shape[1], focal) // 4)
    return Picture(around_squares(squares), Grid(squares.shape[1], correction))


def lens_picture(lens: Fisheye, image: np.ndarray, focal: float = np.inf) -> Picture:
    """The picture (h, w[, C]) of a raw lens."""
    share = min(_MAX_OVERSAMPLING * focal / lens.focal, 1.0)
    if share * _MAX_OVERSAMPLING < 1:
        image = cv2.resize(image, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    return Picture(image, LensGrid(lens, *image.shape[1::-1]))


def _inner(padded: np.ndarray) -> np.ndarray:
    return padded[PAD:-PAD, PAD:-PAD]
