"""Pixels of a frame: its panorama, for any panoramic layout, or its cube faces."""

import math
import threading

import numpy as np

from gsba.camera.pictures import Picture, cube_map, lens_picture, panorama
from gsba.camera.sphere import around_sphere
from gsba.camera.straighten import PAD, straightened, straightened_inside
from gsba.frames.dual_fisheye import load_joined, load_raw
from gsba.frames.files import decode
from gsba.frames.track_pairs import load_squares, panorama_of
from gsba.types import FrameSet


class Buffers(threading.local):
    """A thread's arrays by name: allocating fresh pages costs as much as filling them."""

    def __init__(self) -> None:
        self._kept: dict[str, np.ndarray] = {}

    def array(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """An uninitialised uint8 array; the next one of this name in this thread reuses its
        memory."""
        size = math.prod(shape)
        if name not in self._kept or self._kept[name].size < size:
            self._kept.pop(name, None)
            self._kept[name] = np.empty(size, np.uint8)
        return self._kept[name][:size].reshape(shape)


def load_erp(frames: FrameSet, f: int, gray: bool = False, width: int | None = None) -> np.ndarray:
    """Equirectangular image of frame f, (height, width, 3) uint8 RGB, or (height, width) grey.

    The frames' stitching correction is applied, if they have one.

    Args:
        frames: panoramas.
        width: pixels across, even: wider frames are averaged down to it.
    """
    import cv2

    kind = frames.format_of(f)
    if not kind.panoramic:
        raise ValueError("load_erp needs equirectangular frames")
    if kind.fisheyes is not None:
        return load_joined(frames, f, gray, min(width or kind.width, kind.width))
    if kind.tracks is not None:
        faces = load_squares(frames, f, gray)
        return panorama_of(faces, min(width or kind.width, kind.width), kind.correction)
    erp = decode(frames.paths[f][0], (kind.width, kind.height), gray, at_least=width)
    if width is not None and width < erp.shape[1]:
        erp = cv2.resize(erp, (width, width // 2), interpolation=cv2.INTER_AREA)
    return straightened(erp, kind.correction) if kind.correction else erp


def load_padded(frames: FrameSet, f: int, buffers: Buffers) -> np.ndarray:
    """Panorama like that of `load_erp`, RGB, padded: (height + 2 PAD, width + 2 PAD, 3) uint8.

    It lies in the thread's buffers: the next one replaces it. A JPEG is decoded at the end of
    the memory through which it is then moved, so that a frame is held once.
    """
    kind = frames.format_of(f)
    shape = (kind.height + 2 * PAD, kind.width + 2 * PAD, 3)
    padded = buffers.array("padded", shape)
    if kind.layout != "erp":
        return around_sphere(load_erp(frames, f), PAD, padded)
    size = kind.width, kind.height
    room = padded.reshape(-1)[-3 * kind.width * kind.height :]
    around_sphere(decode(frames.paths[f][0], size, room=room), PAD, padded)
    if not kind.correction:
        return padded
    straight = buffers.array("straight", shape)
    inner = straight[PAD:-PAD, PAD:-PAD]
    return around_sphere(straightened_inside(padded, kind.correction, inner), PAD, straight)


def load_faces(frames: FrameSet, f: int, gray: bool = False, size: int | None = None) -> np.ndarray:
    """Cube faces of frame f, (len(kind.faces), height, width[, 3]) uint8, RGB or grey.

    Args:
        frames: cube faces.
        size: pixels across: larger faces are averaged down to it.
    """
    import cv2

    kind = frames.format_of(f)
    if kind.panoramic:
        raise ValueError("load_faces needs cube frames")
    stored = kind.width, kind.height
    faces = [decode(path, stored, gray, at_least=size) for path in frames.paths[f]]
    if size is not None and size < kind.width:
        faces = [cv2.resize(face, (size, size), interpolation=cv2.INTER_AREA) for face in faces]
    return np.stack(faces)


def pictures_of(frames: FrameSet, f: int, focal: float = np.inf) -> list[Picture]:
    """Pictures (h, w, 3) uint8 RGB that show frame f, of panoramas: those of all raw lenses, as
    stored on disk, or one of all directions; for pinhole views of a focal length, pixels."""
    kind = frames.format_of(f)
    if kind.fisheyes is not None:
        pairs = zip(kind.fisheyes, load_raw(frames, f), strict=True)
        return [lens_picture(lens, image, focal) for lens, image in pairs]
    if kind.tracks is not None:
        return [cube_map(load_squares(frames, f), kind.correction, focal)]
    return [panorama(load_erp(frames, f), focal)]
