"""The equi-angular cube map that GoPro's MAX cameras record, as two tracks of three squares each.

Track 0 shows left, front and right, the second track down, back and up, turned by a quarter. A
square is as high as its track, and equal steps in it are equal angles from its middle: u = (atan(x
/ z) / (pi / 2) + 1/2) S, for both axes. Front and back are of one lens each. The other four are
half of the front and half of the back lens: their middle columns stand twice, once from each lens,
so that they are wider than high. A track is 3 S + 2 overlap wide: its size gives the overlap.

Flat squares, pinhole faces of 90 degrees, are looked up in the same way: equal steps in them are
equal steps of x / z.

Source of the layout: P. Bourke, paulbourke.net/panorama/gopromax2sphere (2021). The turns, the
overlap and the angles were checked on frames of a MAX at 3K and panoramas made of them.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from gsba.camera.rig import RIG_R_FACE
from gsba.camera.sphere import table
from gsba.camera.straighten import PAD, observed
from gsba.types import FACES

# Storage of each face in FACES order: track, square from the left, and quarter turns
# counterclockwise that set it upright.
_STORED = ((0, 1, 0), (0, 2, 0), (1, 1, 1), (0, 0, 0), (1, 2, -1), (1, 0, -1))

_FACE_ALONG = np.array([[1, 3], [5, 4], [0, 2]])  # by axis x, y, z and sign +, -
_AXES = RIG_R_FACE[:, :, :2]  # (6, 3, 2), right and down of each face
_AXIS_OF, _SIGN_OF = np.abs(_AXES).argmax(axis=1), _AXES.sum(axis=1)  # (6, 2) each


def is_equiangular(width: int, height: int) -> bool:
    """True if one of two tracks can have this size, pixels."""
    extra = width - 3 * height
    even = extra % 2 == 0 and (height + extra // 2) % 2 == 0
    return height > 0 and even and 0 <= extra <= height / 4  # cameras have 1/60 to 1/20


def overlap_of(width: int, height: int) -> int:
    """Columns in the middle of a side square that are recorded twice, by the size of a track,
    pixels."""
    return (width - 3 * height) // 2


def square_pixels(
    directions: np.ndarray, size: int, flat: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of directions (..., 3), rig frame, of any length, in upright equi-angular squares of
    `size` pixels, or flat ones: pinhole faces of 90 degrees. Returns (...) uint8, indices into
    FACES, and (..., 2) float64 pixels, corner origin."""
    magnitudes = np.abs(directions)
    axis = np.argmax(magnitudes, axis=-1)[..., None]
    along = np.take_along_axis(directions, axis, axis=-1)
    faces = _FACE_ALONG[axis, (along < 0).astype(int)][..., 0]
    slopes = directions / np.maximum(np.abs(along), 1e-300)
    steps = slopes / 2 if flat else np.arctan(slopes) / (np.pi / 2)
    across = np.take_along_axis(steps, _AXIS_OF[faces], axis=-1) * _SIGN_OF[faces]
    return faces.astype(np.uint8), (across + 0.5) * size


def square_directions(pixels: np.ndarray, face: int, size: int, flat: bool = False) -> np.ndarray:
    """Directions (..., 3), rig frame, of pixels (..., 2) of an upright equi-angular or flat square
    or less than an eighth of it beyond its border."""
    steps = pixels / size - 0.5
    across = 2 * steps if flat else np.tan(steps * (np.pi / 2))
    local = np.concatenate([across, np.ones_like(across[..., :1])], axis=-1)
    return local @ RIG_R_FACE[face].T


def squares(tracks: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Upright equi-angular squares (6, S, S[, C]) uint8, FACES order, of two tracks (S, width[,
    C]), see `is_equiangular`. The columns recorded twice are blended, each lens's weight falling
    linearly to nothing where its picture ends; no pixel is resampled."""
    height, width = tracks[0].shape[:2]
    overlap, out = overlap_of(width, height), []
    starts = 0, height + overlap, 2 * height + overlap
    for track, slot, turns in _STORED:
        stored = tracks[track][:, starts[slot] :]
        square = stored[:, :height] if slot == 1 else _blended(stored, height, overlap)
        out.append(np.rot90(square, turns))
    return np.stack(out)


def shrunk(faces: np.ndarray, size: int) -> np.ndarray:
    """Squares averaged down to `size` pixels; unchanged where they are no larger."""
    if size >= faces.shape[1]:
        return faces
    return np.stack([cv2.resize(f, (size, size), interpolation=cv2.INTER_AREA) for f in faces])


def around_squares(faces: np.ndarray, flat: bool = False) -> np.ndarray:
    """Join equi-angular or flat squares (6, S, S[, C]) in one picture, three beside three, for
    `Grid` to look up; each gets PAD pixels of what lies beyond its border on the sphere."""
    size = faces.shape[1]
    cell = size + 2 * PAD
    out = np.empty((2 * cell, 3 * cell, *faces.shape[3:]), faces.dtype)
    for n, face in enumerate(faces):
        top, left = cell * (n // 3), cell * (n % 3)
        padded = cv2.copyMakeBorder(face, PAD, PAD, PAD, PAD, cv2.BORDER_REPLICATE)
        out[top : top + cell, left : left + cell] = padded
    rows, columns, maps = _borders(size, flat)
    out[rows, columns] = cv2.remap(out, maps[0], maps[1], cv2.INTER_CUBIC)
    return out


@dataclass(frozen=True, slots=True)
class Grid:
    """Pixels of directions in the picture that `around_squares` makes."""

    size: int  # pixels across a square
    correction: tuple[float, ...] = ()  # coefficients of the stitching field, see `FrameSet`
    flat: bool = False  # True = squares are pinhole faces

    def places(self, directions: np.ndarray) -> np.ndarray:
        """OpenCV pixels (..., 2) float64 of directions (..., 3), rig frame."""
        if self.correction:
            directions = observed(directions, self.correction)
        faces, pixels = square_pixels(directions, self.size, self.flat)
        corners = np.stack([faces % 3, faces // 3], axis=-1) * (self.size + 2.0 * PAD)
        return pixels + corners + (PAD - 0.5)


def _blended(stored: np.ndarray, size: int, overlap: int) -> np.ndarray:
    """Doubled columns (S, S[, C]) of a side square blended; `stored` begins at its left edge."""
    half = (size + overlap) // 2
    first = half - overlap
    left, right = stored[:, first:half], stored[:, half : half + overlap]
    share = _left_share(np.arange(first, half) + 0.5, size, overlap).astype(np.float32)
    share = share.reshape(1, -1, *[1] * (stored.ndim - 2))
    both = np.rint(share * left + (1 - share) * right).astype(stored.dtype)
    rest = stored[:, half + overlap : size + overlap]
    return np.concatenate([stored[:, :first], both, rest], axis=1)


def _left_share(columns: np.ndarray, size: int, overlap: int) -> np.ndarray:
    """Weight of the lens in the left half of a side square, at columns of the blended square."""
    return np.clip(0.5 + (size / 2 - columns) / max(overlap, 1e-9), 0, 1)


@table(maxsize=4)
def _borders(size: int, flat: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows and columns (n, k) of a grid's padding, and OpenCV pixels (2, n, k) of its source."""
    cell, grid = size + 2 * PAD, Grid(size, flat=flat)
    ring = np.ones((cell, cell), bool)
    ring[PAD:-PAD, PAD:-PAD] = False
    v, u = np.nonzero(ring)
    pixels = np.stack([u, v], axis=-1) + (0.5 - PAD)
    places = [grid.places(square_directions(pixels, n, size, flat)) for n in range(len(FACES))]
    rows = np.stack([v + cell * (n // 3) for n in range(len(FACES))])
    columns = np.stack([u + cell * (n % 3) for n in range(len(FACES))])
    maps = np.moveaxis(np.stack(places), -1, 0).astype(np.float32)
    shape = 4 * len(FACES), -1  # rows that OpenCV can take
    return rows.reshape(shape), columns.reshape(shape), maps.reshape(2, *shape)
