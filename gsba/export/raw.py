"""Export of raw fisheyes, with masks of their image circles."""

from dataclasses import dataclass

import numpy as np

from gsba.camera.fisheye import Rig, rotation_of, unproject
from gsba.camera.sphere import erp_from_bearings, pixel_bands, table
from gsba.export.pictures import FrameWriter, SharedPixels
from gsba.frames.dual_fisheye import load_raw
from gsba.log import GsbaError
from gsba.types import Fisheye, PictureFormat

SEEN_DEG = 90.0  # largest angle from a lens's axis: beyond, COLMAP's fisheye cameras give no ray or
# a wrong one, and gsplat renders nothing


def raw_lenses(kind: PictureFormat) -> Rig:
    """Lenses of raw frames. Raises GsbaError: the frames are not raw."""
    if kind.fisheyes is None:
        raise GsbaError("--images fisheye is for runs on raw fisheyes: these frames are stitched")
    return kind.fisheyes


@dataclass(frozen=True, slots=True)
class RawPictures(FrameWriter):
    """Copies all fisheye images of a frame, and writes masks of their image circles.

    Images side by side in one file, and those that trainers misread, are encoded again.
    """

    link: bool = False  # make hard links instead of copies

    def __call__(self, shown: SharedPixels) -> None:
        f, frames = shown.f, shown.frames
        two = frames.paths[f][0] != frames.paths[f][1]

        def used() -> list[np.ndarray]:
            size = shown.kind.width, shown.kind.height
            circles = [_circle(lens, *size) for lens in raw_lenses(shown.kind)]
            if frames.mask_paths[f] is None:
                return [seen for seen, _ in circles]
            return [seen & shown.mask.ravel()[places] for seen, places in circles]

        originals = frames.paths[f] if two else ()
        given = shown, "raw", lambda: load_raw(frames, f), used
        self.write(*given, originals=originals, link=self.link)


@table(maxsize=4)
def _circle(lens: Fisheye, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Mask (h, w) bool of what a lens sees within SEEN_DEG; the panorama's pixel, (h, w) int32."""
    seen = np.empty((lens.height, lens.width), bool)
    pixels = np.empty((lens.height, lens.width), np.int32)
    for rows, centres in pixel_bands(np.arange(lens.width), lens.height):
        directions = unproject(lens, centres)
        seen[rows] = directions @ rotation_of(lens)[:, 2] > np.cos(np.deg2rad(SEEN_DEG))
        places = erp_from_bearings(directions.astype(np.float32), width, height)
        u, v = np.moveaxis(np.minimum(places, (width - 1, height - 1)), -1, 0).astype(int)
        pixels[rows] = v * width + u
    return seen, pixels
