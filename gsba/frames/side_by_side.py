"""Two fisheyes side by side in one picture, front left and back right: two square ones in 2:1; in
16:9 squeezed ones, whose image circles are ellipses, or round ones with rows to spare."""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import tee
from pathlib import Path

import cv2
import numpy as np

from gsba.frames.files import decode
from gsba.frames.image_circles import CircleSearch, find_circle
from gsba.log import GsbaError
from gsba.types.records import spread_rows

LOOKED_AT = 5  # pictures in which two image circles side by side are searched

_MAX_BLACK_LEVEL, _MIN_LIT_LEVEL = 32, 40  # grey levels: darkest around image circles; lit inside
_MAX_GLOW_LEVEL = 110  # largest grey level of corners that a glowing housing lights
_MAX_RELATIVE_GLOW = 0.75  # the largest level relative to the median inside the circles
_OUTSIDE_RADIUS, _INSIDE_RADIUS = 0.58, 0.42  # radii in heights: beyond all circles, including
# those of 200 degrees, which the frame cuts off; well inside of them
_MAKERS = (
    (re.compile(r"360_\d+", re.IGNORECASE), "Samsung Gear 360"),
    (re.compile(r"R00\d+", re.IGNORECASE), "Ricoh Theta"),
)


@dataclass(frozen=True, slots=True)
class SideBySide:
    """The result of a search for two fisheyes side by side, and how to cut them out."""

    lens_size: tuple[int, int] | None  # width and height, pixels, of one lens's picture, cut out
    # and unsqueezed; None = they hold something else
    notes: tuple[str, ...] = ()  # for the log
    top: int = 0  # row at which a square around round circles of a higher picture begins


def may_hold_two(size: tuple[int, int]) -> bool:
    """True if pictures of this width and height may hold two fisheyes side by side."""
    width, height = size
    return width % 2 == 0 and 0.5 * width <= height <= 0.6 * width and height > 0


def lens_sizes(size: tuple[int, int]) -> list[tuple[int, int]]:
    """Sizes that one lens's picture may have in pictures of a width and height: squeezed, round."""
    width, height = size
    square = (width // 2, width // 2)
    return [square] if 2 * height == width else [square, (width // 2, height)]


def recognise(greys: Iterable[np.ndarray], size: tuple[int, int], where: Path) -> SideBySide:
    """Detect two fisheyes side by side in pictures.

    Black corners around lit circles suffice for most. Where housings glow in the corners, and in
    pictures that are not 2:1, both image circles must be found.

    Args:
        greys: (h, w) uint8 each, perhaps smaller than `size`; no more are taken than needed.
        where: source of the pictures, for the notes.
    """
    if not may_hold_two(size):
        return SideBySide(None)
    greys, again = tee(greys)
    lens_size = lens_sizes(size)[0]
    if size[0] == 2 * size[1]:
        shown, notes = two_circles(greys, where)
        if shown or notes:
            return SideBySide(lens_size if shown else None, notes)
    looks = []
    for grey in again:
        radii = _radii(grey.shape)
        around = float(np.percentile(grey[radii > _OUTSIDE_RADIUS], 90))
        inside = float(np.median(grey[radii < _INSIDE_RADIUS]))
        if around >= min(_MAX_GLOW_LEVEL, max(_MAX_RELATIVE_GLOW * inside, _MAX_BLACK_LEVEL)):
            return SideBySide(None)
        looks.append(grey)
    return _by_circles(looks, size, where) if looks else SideBySide(None)


def two_circles(greys: Iterable[np.ndarray], where: Path) -> tuple[bool, tuple[str, ...]]:
    """True if 2:1 pictures hold two image circles side by side, by their black corners; and notes.

    A panorama may be black above and below, but then it is black in whole rows; circles are lit in
    rows whose corners are black. Pictures that are dark all over are skipped.

    Args:
        greys: (H, 2H) uint8 each; no more are taken than needed.
        where: source of the pictures, for the notes.
    """
    seen = lit = 0
    for grey in greys:
        corners_black, rows = _circle_evidence(grey)
        if not corners_black:
            return False, ()
        seen, lit = seen + 1, lit + (rows >= 0.25)
    if not seen:
        return False, ()
    if lit < min(2, seen):  # pictures must show two circles
        return False, (f"{where}: black corners, but around no circles: read as a panorama",)
    note = (
        f"{where}: raw, two fisheyes side by side, front left and back right: corners black "
        f"around circles that are not, in {lit} of {seen} frames looked at"
    )
    return True, (note,)


def one_beside_other(grey: np.ndarray) -> np.ndarray:
    """Upper and lower half (h, w) of a picture (2h, w) beside each other."""
    half = grey.shape[0] // 2
    return np.concatenate([grey[:half], grey[half : 2 * half]], axis=1)


def in_folder(
    folder: Path,
    paths: Sequence[Path],
    size: tuple[int, int],
    shape: tuple[int, int] | None = None,
    source: str = "",
) -> SideBySide:
    """Detect two fisheyes side by side in the images of a folder.

    Args:
        paths: the images in order.
        shape: width and height of the lens's picture that a calibration belongs to; None = no
            calibration is given. With one, images are assumed to be raw.
        source: the calibration's name.

    Raises:
        GsbaError: a calibration is given, but they are panoramas.
    """
    if not may_hold_two(size):
        return SideBySide(None)
    spread = spread_rows(len(paths), LOOKED_AT).tolist()
    rows = dict.fromkeys([len(paths) // 2, *spread])  # the middle one suffices for most panoramas
    greys = readable([paths[row] for row in rows], size)
    maker = next((name for named, name in _MAKERS if named.match(paths[0].stem)), "")
    if shape is None:
        found = recognise(greys, size, folder)
        if found.lens_size is None or not maker:
            return found
        return SideBySide(found.lens_size, (*found.notes, f"{folder}: named as a {maker} does"))
    if not all(_circle_evidence(grey)[0] for grey in greys):
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
    """The lens picture's size under which both halves of pictures show image circles best."""
    best, num_rays, middle = None, 0, 0.5
    for width, height in lens_sizes(size):
        across = looks[0].shape[1] // 2
        small = across, round(across * height / width)
        halves = zip(*(cut(look[:, : 2 * across], small) for look in looks), strict=True)
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


def readable(paths: Iterable[Path], size: tuple[int, int]) -> Iterator[np.ndarray]:
    """Grey pictures, small ones where that is fast; damaged ones are skipped here and refused
    later."""
    for path in paths:
        try:
            yield decode(path, size, gray=True, at_least=512)
        except GsbaError:
            continue


def _radii(shape: tuple[int, ...]) -> np.ndarray:
    """Distance of pixels from the middle of their half of the picture, in units of its sides."""
    height, width = shape[0], shape[1]
    v, u = np.ogrid[:height, :width]
    side = width / 2
    return np.hypot(np.mod(u + 0.5, side) / side - 0.5, (v + 0.5) / height - 0.5)


def _circle_evidence(grey: np.ndarray) -> tuple[bool, float]:
    """True if all around two circles is black; part of the rows in which they are lit beside it."""
    radii = _radii(grey.shape)
    outside, inside = radii > _OUTSIDE_RADIUS, radii < _INSIDE_RADIUS
    rows = np.flatnonzero(outside.any(axis=1) & inside.any(axis=1))
    if not len(rows):
        return False, 0.0
    black = bool(np.percentile(grey[outside], 90) < _MAX_BLACK_LEVEL)
    lit = [
        np.median(grey[row, inside[row]]) > _MIN_LIT_LEVEL
        and grey[row, outside[row]].mean() < _MAX_BLACK_LEVEL
        for row in rows
    ]
    return black, float(np.mean(lit))
