"""Cut the six pinhole faces of a frame out of its panorama."""

from collections.abc import Iterator

import cv2
import numpy as np

from gsba.camera.pictures import AnyGrid, Picture, cube_map, panorama
from gsba.camera.rig import CubeRig
from gsba.camera.sphere import dense_enough, pixel_bands, table
from gsba.config import CubemapSettings
from gsba.frames.masks import load_usable
from gsba.frames.pixels import load_erp, load_faces
from gsba.frames.track_pairs import load_squares
from gsba.types import FACES, FrameSet, PictureFormat

HFOV_DEG = 96.0  # of a face: keypoints near an edge are whole on one of both faces


def rig_for(kind: PictureFormat, settings: CubemapSettings) -> CubeRig:
    """The rig on which features of a camera's frames are found.

    Unless a size is set, a face centre has `oversampling` times the pixel density of the
    panorama's equator, within `min_face_size` and `max_face_size`: 0.5 suffices where patches
    refine the keypoints. Frames that come as cube faces keep 90 degrees, and their own size up to
    `max_face_size`.
    """
    if not kind.panoramic:
        return CubeRig(min(kind.native_face_size, settings.max_face_size), np.pi / 2)
    hfov = np.deg2rad(HFOV_DEG)
    native = 2 * kind.width / (2 * np.pi) * np.tan(hfov / 2)
    wanted = max(round(settings.oversampling * native), settings.min_face_size)
    size = min(wanted, settings.max_face_size)
    return CubeRig(size, hfov)


def native_rig(kind: PictureFormat, most: int | None = None) -> CubeRig:
    """Faces 90 degrees wide, as dense as the frames; of panoramas at most `most` pixels across."""
    size = kind.native_face_size
    return CubeRig(min(size, most) if most and kind.panoramic else size, np.pi / 2)


def load(frames: FrameSet, frame: int, rig: CubeRig) -> tuple[np.ndarray, np.ndarray | None]:
    """Faces (6, size, size, 3) uint8 RGB of a frame and their masks (6, size, size) bool, or
    None."""
    kind = frames.format_of(frame)
    mask = load_usable(frames, frame)
    masks = None if mask is None else cut_mask(mask, rig)
    if kind.tracks is not None:
        picture = cube_map(load_squares(frames, frame), kind.correction, rig.focal)
        return np.stack(list(faces_of(picture, rig))), masks
    if kind.panoramic:
        width = dense_enough(kind.width, rig.focal)
        return cut(load_erp(frames, frame, width=width), rig), masks
    images = np.zeros((len(FACES), rig.size, rig.size, 3), np.uint8)
    present = [FACES.index(name) for name in kind.faces]
    images[present] = load_faces(frames, frame, size=rig.size)
    usable = np.zeros((len(FACES), rig.size, rig.size), bool)
    usable[present] = True
    return images, usable if masks is None else usable & masks


def cut(erp: np.ndarray, rig: CubeRig) -> np.ndarray:
    """Sample the faces of a panorama, bicubic, continuous over the seam and the poles.

    Args:
        erp: (H, 2H) or (H, 2H, C) uint8 equirectangular image.

    Returns:
        (6, size, size[, C]) uint8, in FACES order.
    """
    return np.stack(list(faces_of(panorama(erp, rig.focal), rig)))


def faces_of(
    picture: Picture, rig: CubeRig, how: int = cv2.INTER_CUBIC, out: np.ndarray | None = None
) -> Iterator[np.ndarray]:
    """Faces (size, size[, C]) of a picture of all directions, in FACES order, one after the other,
    by an interpolation of OpenCV; all in `out`, if given."""
    for u, v in _maps(rig, picture.grid):
        yield cv2.remap(picture.image, u, v, how, dst=out)


def cut_mask(mask: np.ndarray, rig: CubeRig) -> np.ndarray:
    """Nearest-neighbour faces (6, size, size) of an ERP mask (H, 2H), bool or float32 weights."""
    picture = panorama(mask.astype(np.uint8) if mask.dtype == bool else mask)
    return np.stack(list(faces_of(picture, rig, cv2.INTER_NEAREST))).astype(mask.dtype)


@table(maxsize=2)
def _maps(rig: CubeRig, grid: AnyGrid) -> np.ndarray:
    """Sampling positions (6, 2, size, size) float32 in a picture, OpenCV pixels."""
    maps = np.empty((len(FACES), 2, rig.size, rig.size), np.float32)
    for face in range(len(FACES)):
        for rows, centres in pixel_bands(np.arange(rig.size), rig.size):
            maps[face][:, rows] = np.moveaxis(grid.places(rig.bearings(centres, face)), -1, 0)
    return maps
