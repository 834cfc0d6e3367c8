"""Cut the six pinhole faces of a frame out of its panorama."""

from collections.abc import Callable, Iterator

import cv2
import numpy as np

from gsba.camera.equiangular import Grid, around_squares, shrunk
from gsba.camera.rig import CubeRig
from gsba.camera.sphere import (
    around_sphere,
    dense_enough,
    erp_from_bearings,
    low_passed,
    pixel_bands,
    table,
)
from gsba.camera.straighten import PAD
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
        return cut_squares(load_squares(frames, frame), rig, kind.correction), masks
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
    faces = np.empty((len(FACES), rig.size, rig.size, *erp.shape[2:]), np.uint8)
    padded = around_sphere(low_passed(erp, rig.focal), PAD)
    for face, (u, v) in zip(faces, _maps_into(padded, rig), strict=True):
        cv2.remap(padded, u, v, cv2.INTER_CUBIC, dst=face)
    return faces


def cut_padded(padded: np.ndarray, rig: CubeRig, out: np.ndarray) -> Iterator[np.ndarray]:
    """Faces like those of `cut`, of a panorama with PAD pixels around it: one after the other, all
    in `out` (size, size[, C])."""
    inner = padded[PAD:-PAD, PAD:-PAD]
    small = low_passed(inner, rig.focal)
    if small is not inner:
        padded = around_sphere(small, PAD)
    for u, v in _maps_into(padded, rig):
        yield cv2.remap(padded, u, v, cv2.INTER_CUBIC, dst=out)


def cut_squares(
    squares: np.ndarray, rig: CubeRig, correction: tuple[float, ...] = ()
) -> np.ndarray:
    """Sample the faces of an equi-angular cube map, bicubic, continuous over all its edges.

    Args:
        squares: (6, S, S[, C]) uint8 of `gsba.camera.equiangular.squares`, FACES order.
        correction: coefficients of the stitching field, see `FrameSet`.

    Returns:
        (6, size, size[, C]) uint8, in FACES order.
    """
    squares = shrunk(squares, dense_enough(4 * squares.shape[1], rig.focal) // 4)
    faces = np.empty((len(FACES), rig.size, rig.size, *squares.shape[3:]), np.uint8)
    picture = around_squares(squares)
    maps = _grid_maps(rig, Grid(squares.shape[1], correction))
    for face, (u, v) in zip(faces, maps, strict=True):
        cv2.remap(picture, u, v, cv2.INTER_CUBIC, dst=face)
    return faces


def cut_mask(mask: np.ndarray, rig: CubeRig) -> np.ndarray:
    """Nearest-neighbour faces (6, size, size) of an ERP mask (H, 2H), bool or float32 weights."""
    padded = around_sphere(mask.astype(np.uint8) if mask.dtype == bool else mask, PAD)
    maps = _maps_into(padded, rig)
    faces = [cv2.remap(padded, u, v, cv2.INTER_NEAREST) for u, v in maps]
    return np.stack(faces).astype(mask.dtype)


def _maps_into(padded: np.ndarray, rig: CubeRig) -> np.ndarray:
    return _face_maps(rig, padded.shape[1] - 2 * PAD, padded.shape[0] - 2 * PAD)


@table(maxsize=2)
def _face_maps(rig: CubeRig, width: int, height: int) -> np.ndarray:
    """Sampling positions (6, 2, size, size) float32 in the padded panorama, OpenCV pixels."""
    return _maps_by(rig, lambda rays: erp_from_bearings(rays, width, height) - 0.5 + PAD)


@table(maxsize=2)
def _grid_maps(rig: CubeRig, grid: Grid) -> np.ndarray:
    """Sampling positions (6, 2, size, size) float32 in an equi-angular grid, OpenCV pixels."""
    return _maps_by(rig, grid.places)


def _maps_by(rig: CubeRig, places: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    maps = np.empty((len(FACES), 2, rig.size, rig.size), np.float32)
    for face in range(len(FACES)):
        for rows, centres in pixel_bands(np.arange(rig.size), rig.size):
            maps[face][:, rows] = np.moveaxis(places(rig.bearings(centres, face)), -1, 0)
    return maps
