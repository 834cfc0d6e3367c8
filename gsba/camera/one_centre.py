"""Panoramas of two lenses resampled as one camera in the middle between them would take them.

Each direction is looked up where its lens shows it, at the depth of map points around it, with all
rows read in the middle of the exposure; both lenses are blended across the seam.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from gsba.camera.fisheye import facing
from gsba.camera.lens import Lenses
from gsba.camera.pictures import Picture, panorama
from gsba.camera.sphere import around_sphere, erp_bands, erp_directions
from gsba.camera.straighten import PAD
from gsba.camera.views import FAR_DEPTH, depths_along, observed_points
from gsba.geometry import unit
from gsba.types import Reconstruction

_DEPTH_GRID_WIDTH = 128  # width of the grid that depths are taken on


class Stitcher:
    """Makes the panorama of one frame."""

    def __init__(self, lenses: Lenses, frame: int, scene: np.ndarray) -> None:
        """Compute the offset from each direction of the rig to its direction in each lens, in the
        frame-th frame of the lenses, at the depths of scene points (N, 3), rig frame."""
        self._lenses = lenses.of_frame(frame)
        grid = erp_directions(_DEPTH_GRID_WIDTH)
        rays = grid.reshape(-1, 3)
        depths = np.full(len(rays), FAR_DEPTH)
        if len(scene):
            # nearer points would lie beyond the rims at the seam
            depths = np.maximum(depths_along(rays, scene), 6.0 * lenses.baseline)
        same, self._offsets = np.zeros(len(rays), int), []
        for lens in range(lenses.num_lenses):
            shown = self._lenses.seeing(depths[:, None] * rays, same, np.full(len(rays), lens))
            offsets = (unit(shown) - rays).reshape(grid.shape).astype(np.float32)
            self._offsets.append(around_sphere(offsets, PAD))

    def stitched(self, pictures: Sequence[Picture], width: int) -> np.ndarray:
        """The panorama (width / 2, width, C) uint8, resampled from a picture of all directions, or
        from those (L) of raw lenses."""
        return self._joined(width, pictures, cv2.INTER_LANCZOS4)

    def stitched_mask(self, mask: np.ndarray) -> np.ndarray:
        """The mask (H, 2 H) bool for the resampled panorama, from the mask of a stitcher's panorama
        or of a raw pair: a direction is used where all pixels blended into it are."""
        white = panorama(mask.astype(np.uint8)[..., None] * 255)
        return self._joined(mask.shape[1], [white], cv2.INTER_NEAREST)[..., 0] == 255

    def _joined(self, width: int, pictures: Sequence[Picture], how: int) -> np.ndarray:
        """`stitched`, by an interpolation of OpenCV."""
        parts, channels = [], pictures[0].image.shape[2]
        for rows, rays in erp_bands(np.arange(width), width):
            joined = np.zeros((*rays.shape[:2], channels), np.float32)
            for lens, share in enumerate(self._weights(rays)):
                columns = np.flatnonzero((share > 0).any(axis=0))
                if not len(columns):  # a lens that looks up shows nothing of the rows below
                    continue
                scale = _DEPTH_GRID_WIDTH / width
                places = np.meshgrid(columns + 0.5, np.arange(rows.start, rows.stop) + 0.5)
                across, down = ((at * scale - 0.5 + PAD).astype(np.float32) for at in places)
                moved = cv2.remap(self._offsets[lens], across, down, cv2.INTER_CUBIC)
                picture = pictures[lens if len(pictures) > 1 else 0]
                part = picture.sample(rays[:, columns] + moved, how).reshape(
                    *moved.shape[:2], channels
                )
                joined[:, columns] += share[:, columns, None] * part
            parts.append(np.rint(joined).astype(np.uint8))
        return np.concatenate(parts)

    def _weights(self, rays: np.ndarray) -> list[np.ndarray]:
        """Blending weights (h, w) float32 of each lens in directions (h, w, 3), of sum 1."""
        axes, band, looks = self._lenses.axes, self._lenses.band_rad, self._lenses.optical_axes
        own = rays if axes is None else rays @ axes[0]
        if not band:
            nearest = facing(own, looks)
            return [(nearest == lens).astype(np.float32) for lens in range(len(looks))]
        sides = []
        for lens, look in enumerate(looks):  # how far a lens's side of its nearest seam reaches
            apart = [look - other for k, other in enumerate(looks) if k != lens]
            sines = np.min([own @ (way / np.linalg.norm(way)) for way in apart], axis=0)
            sides.append(np.clip(0.5 + np.arcsin(np.clip(sines, -1, 1)) / (2 * band), 0, 1))
        total = np.sum(sides, axis=0)  # 1 where two lenses meet
        return [(side / total).astype(np.float32) for side in sides]


def seen_from_the_middle(reconstruction: Reconstruction) -> Reconstruction:
    """Observed points as bearings from the rig's centre, instead of as rays from lenses."""
    if reconstruction.observation_origins is None:
        return reconstruction
    bearings = unit(observed_points(reconstruction))
    return replace(reconstruction, observation_bearings=bearings, observation_origins=None)
