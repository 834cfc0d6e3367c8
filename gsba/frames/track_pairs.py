"""Equi-angular cube maps on disk: two tracks of GoPro's MAX cameras, two pictures a frame."""

import logging
import re
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from gsba.camera.equiangular import (
    Grid,
    around_squares,
    is_equiangular,
    overlap_of,
    shrunk,
    square_directions,
    square_pixels,
    squares,
)
from gsba.camera.sphere import erp_bands, table
from gsba.frames.files import (
    Found,
    decode,
    entries_of,
    images_by_name,
    images_in,
    paired,
)
from gsba.log import GsbaError
from gsba.types import FACES, FrameSet, rows_across

_log = logging.getLogger(__name__)

_FOLDER = re.compile(r"track(\d+)", re.IGNORECASE)
_MIN_CORRELATION = 0.5  # median correlation of grey values along edges shared by both tracks:
# 0.95 and more on real frames, 0.2 and less on pictures of several instants
_MIN_CONTRAST = 4.0  # least standard deviation of grey levels along an edge that is used


def find_tracks(folder: Path) -> Found | None:
    """Find the pictures of both tracks of each frame in folders `track0` and `track5`.

    Any two numbers do; the lower one is the track of the front lens.

    Returns:
        Paths of the pictures by the frame's name, or None where no such folder holds images.

    Raises:
        GsbaError: one folder or more than two hold images, or their names differ.
    """
    found: dict[int, Path] = {}
    for path in entries_of(folder):
        match = _FOLDER.fullmatch(path.name)
        if match and images_in(path):
            found[int(match[1])] = path
    if not found:
        return None
    names = [found[number].name for number in sorted(found)]
    if len(names) != 2:
        several = f"pictures in {len(names)} folders, {', '.join(names)}"
        held = f"{names[0]}/ but no pictures of the second track" if len(names) == 1 else several
        raise GsbaError(
            f"{folder}: holds {held}; of a .360 recording, extract both video tracks, as track0/ "
            "and track5/ (gsba extract does)"
        )
    tracks = [images_by_name(one, images_in(one)) for one in (folder / name for name in names)]
    return paired(folder, tracks, [f"{name}/" for name in names])


def check_tracks(folder: Path, pairs: Sequence[tuple[Path, ...]], size: tuple[int, int]) -> None:
    """Check the size of the pictures of two tracks, and the pixels of some frames.

    Args:
        pairs: paths of both pictures of each frame.
        size: width and height of all pictures.

    Raises:
        GsbaError: tracks of an equi-angular cube map cannot have this size, or squares do not
            continue one another across both tracks.
    """
    width, height = size
    if not is_equiangular(width, height):
        raise GsbaError(
            f"{pairs[0][0]}: is {width}x{height}, no track of a .360 recording, which is three "
            "squares wide and up to a twelfth more (4096x1344, 2272x736)"
        )
    _log.info(
        "%s: GoPro's equi-angular cube map, two tracks of %dx%d, %d columns from both lenses",
        folder, width, height, overlap_of(width, height),
    )  # fmt: skip
    # Refuse tracks whose grey values on both sides of common edges are not correlated
    rows = rows_across(len(pairs), 5)
    found = [_edge_correlations(_decoded(pairs[row], size, gray=True)) for row in rows]
    known = np.concatenate(found)
    if len(known) and np.median(known) < _MIN_CORRELATION:
        raise GsbaError(
            f"{folder}: squares of {pairs[0][0].parent.name} and {pairs[0][1].parent.name} do not "
            f"meet at their edges (correlation {np.median(known):.2f}): their pictures are not of "
            "the same instants, or not of GoPro's equi-angular layout; extract both tracks again"
        )


def load_squares(frames: FrameSet, f: int, gray: bool = False) -> np.ndarray:
    """Upright squares (6, S, S[, 3]) uint8 of frame f, FACES order; see `equiangular.squares`."""
    kind = frames.format_of(f)
    assert kind.tracks is not None
    return _decoded(frames.paths[f], kind.tracks, gray)


def panorama_of(faces: np.ndarray, width: int, correction: tuple[float, ...] = ()) -> np.ndarray:
    """Panorama (width / 2, width[, 3]) uint8 of upright squares (6, S, S[, 3]) uint8."""
    faces = shrunk(faces, max(round(width / 4), 1))
    u, v = maps_of_panorama(Grid(faces.shape[1], correction), width)
    return cv2.remap(around_squares(faces), u, v, cv2.INTER_LANCZOS4)


def _decoded(paths: Sequence[Path], size: tuple[int, int], gray: bool) -> np.ndarray:
    first, second = (decode(path, size, gray) for path in paths)
    return squares((first, second))


@table(maxsize=2)
def maps_of_panorama(grid: Grid, width: int) -> np.ndarray:
    """Places (2, width / 2, width) float32 of a panorama's pixels in a grid, OpenCV pixels."""
    maps = np.empty((2, width // 2, width), np.float32)
    for rows, bearings in erp_bands(np.arange(width), width):
        maps[:, rows] = np.moveaxis(grid.places(bearings), -1, 0)
    return maps


def _edge_correlations(faces: np.ndarray) -> np.ndarray:
    """Correlations (n,) of means along edges of squares (6, S, S) that both tracks share, where
    they have contrast."""
    size, found = faces.shape[1], []
    along = np.arange(size) + 0.5
    for face in ("front", "right", "left"):  # of track 0
        n = FACES.index(face)
        for u, v in ((along, -0.5), (along, size + 0.5), (-0.5, along), (size + 0.5, along)):
            beyond = np.stack(np.broadcast_arrays(u, v), axis=-1)
            others, pixels = square_pixels(square_directions(beyond, n, size), size)
            if FACES[others[size // 2]] in ("front", "right", "left"):
                continue
            inner = np.clip(beyond, 0, size - 1).astype(int)
            there = np.clip(pixels, 0, size - 1).astype(int)
            sides = faces[n, inner[:, 1], inner[:, 0]], faces[others, there[:, 1], there[:, 0]]
            parts = [np.array_split(values, min(64, size)) for values in sides]
            a, b = ([part.mean() for part in side] for side in parts)
            if min(np.std(a), np.std(b)) > _MIN_CONTRAST:
                found.append(np.corrcoef(a, b)[0, 1])
    return np.array(found)
