"""Two fisheyes side by side in one picture, front left and back right: recognised, cut, unsqueezed.

Pictures of 2:1 hold two square ones. In pictures of 16:9 some cameras squeeze these, so that image
circles are ellipses; others leave them round, with rows to spare.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import cv2
import numpy as np

from gsba.frames.files import decode
from gsba.frames.image_circles import CircleSearch, find_circle
from gsba.log import GsbaError

LOOKED_AT = 5  # pictures in which two circles side by side are searched for

_SMALL = 512  # pixels across that are enough for it
_SEVERAL = 2  # of them that must show such
_BLACK, _LIT = 32, 40  # grey levels: around image circles, and inside
_GLOW = 110  # grey level of corners that a glowing housing lights, at most
_GLOW_SHARE = 0.75  # the same as a part of the median grey level inside the circles
_OUTSIDE, _INSIDE = 0.58, 0.42  # radii in heights: beyond circles, those of 200 degrees too, which
# the frame cuts off; well within
_ROWS = 0.25  # part of the rows with corners in which circles show beside black ones
_MAX_HEIGHT = 0.6  # height of a picture that is no 2:1, part of its width
_MAKERS = (
    (re.compile(r"360_\d+", re.IGNORECASE), "Samsung Gear 360"),
    (re.compile(r"R00\d+", re.IGNORECASE), "Ricoh Theta"),
)


@dataclass(frozen=True, slots=True)
class SideBySide:
    """Whether pictures hold two fisheyes side by side, and how these are cut out."""

    lens_size: tuple[int, int] | None  # width and height, pixels, of one lens's picture, cut out
    # and unsqueezed; None = they hold something else
    notes: tuple[str, ...] = ()  # for the log
    top: int = 0  # row at which a square around round circles of a higher picture begins


def may_hold_two(size: tuple[int, int]) -> bool:
    """Whether pictures of this width and height may hold two fisheyes side by side."""
    width, height = size
    return width % 2 == 0 and 0.5 * width <= height <= _MAX_HEIGHT * width and height > 0


def lens_sizes(size: tuple[int, int]) -> list[tuple[int, int]]:
    """Sizes that one lens's picture may have in pictures of a width and height: squeezed, round."""
    width, height = size
    square = (width // 2, width // 2)
    return [square] if 2 * height == width else [square, (width // 2, height)]


def recognise(greys: Iterable[np.ndarray], size: tuple[int, int], where: Path) -> SideBySide:
    """Find out whether pictures hold two fisheyes side by side.

    Black corners around lit circles tell it of most. Where housings glow in the corners, and in
    pictures that are no 2:1, both image circles must be found.

    Args:
        greys: (h, w) uint8 each, perhaps smaller than `size`; no more are taken than needed.
        size: width and height of the pictures.
        where: they are from, for the notes.
    """
    if not may_hold_two(size):
        return SideBySide(None)
    taken: list[np.ndarray] = []
    rest = iter(greys)
    lens_size = lens_sizes(size)[0]
    if size[0] == 2 * size[1]:
        shown, notes = two_circles(_noted(rest, taken), where)
        if shown or notes:
            return SideBySide(lens_size if shown else None, notes)
    looks = []
    for grey in chain(taken, rest):
        if _corners_lit(grey):
            return SideBySide(None)
        looks.append(grey)
    return _by_circles(looks, size, where) if looks else SideBySide(None)


def two_circles(greys: Iterable[np.ndarray], where: Path) -> tuple[bool, tuple[str, ...]]:
    """Whether 2:1 pictures are two image circles side by side, by their black corners; notes on it.

    A panorama may be black above and below, but then it is black in whole rows; circles are lit in
    rows whose corners are black. Pictures that are dark all over say nothing.

    Args:
        greys: (H, 2H) uint8 each; no more are taken than needed.
        where: they are of, for the notes.
    """
    seen = lit = 0
    for grey in greys:
        corners_black, rows = _circles(grey)
        if not corners_black:
            return False, ()
        seen, lit = seen + 1, lit + (rows >= _ROWS)
    if not seen:
        return False, ()
    if lit < min(_SEVERAL, seen):
        return False, (f"{where}: black corners, but around no circles: taken for a panorama",)
    note = (
        f"{where}: raw, two fisheyes side by side, front left and back right: corners black "
        f"around circles that are not, in {lit} of {seen} frames looked at"
    )
    return True, (note,)


def in_folder(
    folder: Path,
    paths: Sequence[Path],
    size: tuple[int, int],
    shape: tuple[int, int] | None = None,
    source: str = "",
) -> SideBySide:
    """Find out whether images of a folder hold two fisheyes side by side.

    Args:
        folder: that they are in.
        paths: in order.
        size: of each.
        shape: width and height of the lens's picture that a calibration is of; None = none is
            given. With one, images are taken for raw.
        source: the calibration's name.

    Raises:
        GsbaError: a calibration is given, but they are panoramas.
    """
    if not may_hold_two(size):
        return SideBySide(None)
    spread = [(2 * i + 1) * len(paths) // (2 * LOOKED_AT) for i in range(LOOKED_AT)]
    rows = dict.fromkeys([len(paths) // 2, *spread])  # the middle one settles most panoramas
    greys = _readable([paths[row] for row in rows], size)
    maker = next((name for named, name in _MAKERS if named.match(paths[0].stem)), "")
    if shape is None:
        found = recognise(greys, size, folder)
        if found.lens_size is None or not maker:
            return found
        return SideBySide(found.lens_size, (*found.notes, f"{folder}: named as a {maker} does"))
    if not all(_circles(grey)[0] for grey in greys):
        raise GsbaError(
            f"{folder}: holds 2:1 pictures that are lit up to the corners, so panoramas that are "
            f"stitched, and {source} is of raw fisheyes: leave --calibration out, or "
            "give the raw pictures"
        )
    alike = [one for one in lens_sizes(size) if one[0] * shape[1] == one[1] * shape[0]]
    note = f"{folder}: raw, two fisheyes side by side, front left and back right"
    return SideBySide(alike[0] if alike else lens_sizes(size)[0], (note,))


def cut(picture: np.ndarray, lens_size: tuple[int, int]) -> list[np.ndarray]:
    """Pictures (h, w[, 3]) of the front and of the back lens out of one that holds both.

    Args:
        picture: (H, 2 w[, 3]) uint8.
        lens_size: w and h; H differs from h where both were squeezed.
    """
    width, height = lens_size
    if picture.shape[0] != height:
        picture = cv2.resize(picture, (2 * width, height), interpolation=cv2.INTER_AREA)
    return [picture[:, :width], picture[:, width:]]


def _by_circles(looks: Sequence[np.ndarray], size: tuple[int, int], where: Path) -> SideBySide:
    """The size of a lens's picture under which both halves of pictures show image circles best."""
    best, num_rays, middle = None, 0, 0.5
    for width, height in lens_sizes(size):
        across = looks[0].shape[1] // 2
        small = across, round(across * height / width)
        halves = zip(*(cut(_even(look), small) for look in looks), strict=True)
        found: list[CircleSearch] = [find_circle(half) for half in halves]
        rays = sum(one.num_rays for one in found)
        circles = [one.circle for one in found if one.circle is not None]
        if len(circles) == 2 and rays > num_rays:
            best, num_rays = (width, height), rays
            middle = float(np.mean([circle.y for circle in circles])) / small[1]
    if best is None:
        return SideBySide(None)
    note = f"{where}: raw, two fisheyes side by side, front left and back right, both circles found"
    if best[1] == size[1]:
        top = round(middle * size[1] - best[0] / 2)
        return SideBySide(best, (note,), min(max(top, 0), max(size[1] - best[0], 0)))
    squeezed = f"; they are ellipses: {size[0]}x{size[1]} is read as {2 * best[0]}x{best[1]}"
    return SideBySide(best, (note + squeezed,))


def _even(picture: np.ndarray) -> np.ndarray:
    return picture[:, : picture.shape[1] // 2 * 2]


def _noted(greys: Iterator[np.ndarray], taken: list[np.ndarray]) -> Iterator[np.ndarray]:
    for grey in greys:
        taken.append(grey)
        yield grey


def _readable(paths: Iterable[Path], size: tuple[int, int]) -> Iterator[np.ndarray]:
    """Grey pictures, small ones where that is fast; what is damaged is refused when it is used."""
    for path in paths:
        try:
            yield decode(path, size, gray=True, at_least=_SMALL)
        except GsbaError:
            continue


def _radii(shape: tuple[int, ...]) -> np.ndarray:
    """Distance of pixels from the middle of the half that they are in, parts of a half's sides."""
    height, width = shape[0], shape[1]
    v, u = np.ogrid[:height, :width]
    side = width / 2
    return np.hypot(np.mod(u + 0.5, side) / side - 0.5, (v + 0.5) / height - 0.5)


def _corners_lit(grey: np.ndarray) -> bool:
    """Whether a picture (h, w) uint8 is brighter around image circles than a housing glows."""
    radii = _radii(grey.shape)
    around = float(np.percentile(grey[radii > _OUTSIDE], 90))
    inside = float(np.median(grey[radii < _INSIDE]))
    return around >= min(_GLOW, max(_GLOW_SHARE * inside, _BLACK))


def _circles(grey: np.ndarray) -> tuple[bool, float]:
    """What speaks for two image circles in a picture (H, 2H) uint8, or in one that is squeezed.

    Returns:
        whether all around them is black, and in which part of the rows they are lit beside it.
    """
    radii = _radii(grey.shape)
    outside, inside = radii > _OUTSIDE, radii < _INSIDE
    rows = np.flatnonzero(outside.any(axis=1) & inside.any(axis=1))
    if not len(rows):
        return False, 0.0
    black = bool(np.percentile(grey[outside], 90) < _BLACK)
    lit = [
        np.median(grey[row, inside[row]]) > _LIT and grey[row, outside[row]].mean() < _BLACK
        for row in rows
    ]
    return black, float(np.mean(lit))
