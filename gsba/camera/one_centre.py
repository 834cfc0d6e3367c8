"""Panoramas of two lenses as one camera in the middle between them would have taken them.

A stitcher joins both pictures as if everything were far: what is near stands beside its place, to
one side in front and to the other behind, and is doubled or cut at the seam. Here each direction is
looked up where its lens has what lies there, as far away as points of the map around it say, with
all rows read in the middle of the exposure. Across the seam both are blended, which is no worse in
pixels than a hard cut of raw pictures, and better than one of a panorama that is blended there.
What no point tells the depth of stays about as wrong as it was.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import numpy as np

from gsba.camera.equiangular import Grid, around_squares
from gsba.camera.fisheye import project
from gsba.camera.lens import Lenses
from gsba.camera.sphere import around_sphere, bearings_from_erp, erp_from_bearings
from gsba.camera.straighten import PAD
from gsba.camera.views import depths_along, observed_points
from gsba.types import Reconstruction

_COARSE = 128  # width of the grid that depths are taken on
_NEAREST = 12.0  # distances of a lens from the middle: nearer, the seam lies beyond fisheyes' rims
_FAR = 1e9  # map units
_BAND = 128  # rows of which coordinates are held in double precision

_Look = Callable[[int, np.ndarray], np.ndarray]  # lens and directions (h, w, 3) to pixels (h, w, C)


class Stitcher:
    """Makes the panorama of one frame."""

    def __init__(self, lenses: Lenses, frame: int, scene: np.ndarray) -> None:
        """Where either lens has each direction of the rig.

        Args:
            lenses: two of them.
            frame: its index there.
            scene: (N, 3) points in the rig frame of this frame, which tell how far things are.
        """
        self._lenses = lenses.of_frame(frame)
        centres = (np.arange(pixels) + 0.5 for pixels in (_COARSE, _COARSE // 2))
        pixels = np.stack(np.meshgrid(*centres), axis=-1)
        rays = bearings_from_erp(pixels, _COARSE, _COARSE // 2).reshape(-1, 3)
        depths = np.full(len(rays), _FAR)
        if len(scene):
            nearest = _NEAREST * float(np.linalg.norm(lenses.centre))
            depths = np.maximum(depths_along(rays, scene), nearest)
        same, self._offsets = np.zeros(len(rays), int), []
        for sign in (1.0, -1.0):
            shown = self._lenses.seeing(depths[:, None] * rays, same, np.full(len(rays), sign))
            shown /= np.linalg.norm(shown, axis=1, keepdims=True)
            offsets = (shown - rays).reshape(_COARSE // 2, _COARSE, 3).astype(np.float32)
            self._offsets.append(around_sphere(offsets, PAD))

    def stitched(self, erp: np.ndarray) -> np.ndarray:
        """The panorama (H, 2 H, C) uint8 of one that a stitcher made."""
        return self._joined(erp.shape[1], erp.shape[2], _looking_up(erp, cv2.INTER_LANCZOS4))

    def stitched_squares(
        self, squares: np.ndarray, correction: tuple[float, ...] = ()
    ) -> np.ndarray:
        """The panorama (2 S, 4 S, C) uint8 of an equi-angular cube map.

        Args:
            squares: (6, S, S, C) uint8, FACES order.
            correction: of what stitching bends, see `FrameSet`.
        """
        picture, grid = around_squares(squares), Grid(squares.shape[1], correction)

        def look(_: int, shown: np.ndarray) -> np.ndarray:
            maps = grid.places(shown).astype(np.float32)
            return cv2.remap(picture, maps[..., 0], maps[..., 1], cv2.INTER_LANCZOS4)

        return self._joined(4 * grid.size, squares.shape[3], look)

    def stitched_mask(self, mask: np.ndarray) -> np.ndarray:
        """The mask (H, 2 H) bool of one that belongs to a stitcher's panorama, or to that of a raw
        pair: a direction is used where all is that it is blended of."""
        white = mask.astype(np.uint8)[..., None] * 255
        joined = self._joined(mask.shape[1], 1, _looking_up(white, cv2.INTER_NEAREST))
        return joined[..., 0] == 255

    def stitched_raw(self, pictures: list[np.ndarray], width: int) -> np.ndarray:
        """The panorama (width / 2, width, C) uint8 of both pictures (h, w, C) uint8 of a raw
        pair."""
        pair = self._lenses.reference_calibration
        assert pair is not None

        def look(lens: int, shown: np.ndarray) -> np.ndarray:
            places = (project(pair[lens], shown) - 0.5).astype(np.float32)
            return cv2.remap(
                pictures[lens], places[..., 0], places[..., 1], cv2.INTER_LANCZOS4,
                borderMode=cv2.BORDER_REPLICATE,
            )  # fmt: skip

        return self._joined(width, pictures[0].shape[2], look)

    def _joined(self, width: int, channels: int, look: _Look) -> np.ndarray:
        """The panorama (width / 2, width, C) uint8 of what both lenses show."""
        parts = []
        for top, rays in _bands(width):
            ahead, joined = self._ahead(rays), np.zeros((*rays.shape[:2], channels), np.float32)
            for lens, share in enumerate((ahead, 1 - ahead)):
                columns = np.flatnonzero((share > 0).any(axis=0))
                moved = self._moved(lens, top, columns, len(rays), width)
                part = look(lens, rays[:, columns] + moved).reshape(*moved.shape[:2], channels)
                joined[:, columns] += share[:, columns, None] * part
            parts.append(np.rint(joined).astype(np.uint8))
        return np.concatenate(parts)

    def _ahead(self, rays: np.ndarray) -> np.ndarray:
        """What part of directions (h, w, 3) is the front lens's, (h, w) float32 in [0, 1]."""
        axes, band = self._lenses.axes, self._lenses.band_rad
        along = rays[..., 2] if axes is None else rays @ axes[0][:, 2]
        if not band:
            return (along >= 0).astype(np.float32)
        angles = np.arcsin(np.clip(along, -1, 1))
        return np.clip(0.5 + angles / (2 * band), 0, 1).astype(np.float32)

    def _moved(
        self, lens: int, top: int, columns: np.ndarray, num_rows: int, width: int
    ) -> np.ndarray:
        """From directions of a panorama's rows and columns to where a lens has them, (h, w, 3)."""
        scale = _COARSE / width
        places = np.meshgrid(columns + 0.5, np.arange(top, top + num_rows) + 0.5)
        across, down = ((at * scale - 0.5 + PAD).astype(np.float32) for at in places)
        return cv2.remap(self._offsets[lens], across, down, cv2.INTER_CUBIC)


def _looking_up(erp: np.ndarray, how: int) -> _Look:
    """Where a panorama (H, 2 H, C) shows directions, whichever lens they are of."""
    height, width = erp.shape[:2]
    padded = around_sphere(erp, PAD)

    def look(_: int, shown: np.ndarray) -> np.ndarray:
        maps = (erp_from_bearings(shown, width, height) - 0.5 + PAD).astype(np.float32)
        return cv2.remap(padded, maps[..., 0], maps[..., 1], how)

    return look


def _bands(width: int) -> Iterator[tuple[int, np.ndarray]]:
    """First row and directions (h, width, 3) of parts of a panorama."""
    height = width // 2
    for top in range(0, height, _BAND):
        rows = np.arange(top, min(top + _BAND, height)) + 0.5
        pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, rows), axis=-1)
        yield top, bearings_from_erp(pixels, width, height)


def seen_from_the_middle(reconstruction: Reconstruction) -> Reconstruction:
    """The same with bearings from the rig's centre to where observed rays are at their points."""
    if reconstruction.observation_origins is None:
        return reconstruction
    bearings = observed_points(reconstruction)
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    return replace(reconstruction, observation_bearings=bearings, observation_origins=None)
