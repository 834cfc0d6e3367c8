"""Raw dual fisheyes on disk: which pictures are of one frame, what their lenses are at first."""

import logging
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from gsba.camera.calibration import fitted, read_calibration
from gsba.camera.fisheye import Pair, project
from gsba.frames.files import decode, image_size, is_image
from gsba.log import GsbaError
from gsba.types import FACES, Fisheye

_log = logging.getLogger(__name__)

_FOLDERS = ("front", "back"), ("lens0", "lens1")
_FILES = re.compile(r"(?P<before>.*_)(?P<lens>00|10)(?P<after>_.*)")
_OF_FACE = re.compile(rf".+_({'|'.join(FACES)})", re.IGNORECASE)
_HALF_FOV = np.deg2rad(100.0)  # of the circle that a fisheye of unknown make fills
_DARK = 24  # grey value of what no light reaches, at most
_LOOKS = 8  # frames that show where light reaches
_BEHIND = np.diag([-1.0, 1.0, -1.0])  # rig_R_lens of an upright back lens
_TURNS = [Rotation.from_euler("z", turn).as_matrix() for turn in np.deg2rad([0, 90, 180, 270])]
_OVERLAP = np.deg2rad(4.0)  # either way of the rim, which both lenses show
_AROUND, _ACROSS = 720, 9  # places at which they are compared
_CLEARLY = 0.1  # by how much more alike the right turn makes them than any other
_RIM = 64  # directions from a circle's middle
_IN_CORNERS = 0.02  # share of the pixels of a circle's corners that may be bright
_STEP = 0.5  # pixels, in which a rim is looked for
_LEAST = 0.3  # radius of a fisheye's circle, parts of its picture
_ON_RIM, _OFF = 0.4, 0.02  # part of the rim's places that lie on a circle, within parts of a radius

_LOOKED_AT = 5  # pictures in which two circles side by side are looked for
_SMALL = 512  # pixels across that are enough for it
_SEVERAL = 2  # of them that must show such
_BLACK, _LIT = 32, 40  # grey levels: around image circles, and inside
_OUTSIDE, _INSIDE = 0.58, 0.42  # radii in heights: beyond circles, those of 200 degrees too, which
# the frame cuts off; well within
_ROWS = 0.25  # part of the rows with corners in which circles show beside black ones

Found = dict[str, tuple[Path, Path]]  # frame -> picture of the front lens, of the back lens


def find_pairs(folder: Path) -> Found | None:
    """Pictures of raw pairs in a folder, one file for each lens; None = it holds something else.

    Raises:
        GsbaError: a picture of one lens has none of the other.
    """
    entries = sorted(folder.iterdir())
    images = [path for path in entries if is_image(path) and path.is_file()]
    known = {*FACES, *(name for names in _FOLDERS for name in names)}
    by_name = {path.name.lower(): path for path in entries if path.name.lower() in known}
    holding = {name: found for name, path in by_name.items() if (found := _images_in(path))}
    for names in _FOLDERS:
        here = holding.keys() & {*names, *FACES}
        if not here or not here <= set(names):
            continue
        if images:
            raise GsbaError(
                f"{folder}: holds both images ('{images[0].name}') and folders of lenses "
                f"('{min(here)}'); keep one of them"
            )
        if len(here) == 1:
            (other,) = set(names) - here
            raise GsbaError(
                f"{folder}: holds {min(here)}/ but no pictures in {other}/: of raw pairs the other "
                "lens's are missing, of a cube most faces; extract them again"
            )
        front, back = (_by_stem(folder, holding[name]) for name in names)
        return _paired(folder, (front, back), (f"{names[0]}/", f"{names[1]}/"))
    return _tagged_pairs(folder, images)


def _tagged_pairs(folder: Path, images: Sequence[Path]) -> Found | None:
    """Pairs of files `..._00_...` and `..._10_...`; panoramas and cube faces may be named so."""
    tagged = [(m, path) for path in images if (m := _FILES.fullmatch(path.stem))]
    if not tagged or all(_OF_FACE.fullmatch(path.stem) for _, path in tagged):
        return None
    width, height = image_size(tagged[0][1])
    if width == 2 * height:
        return None
    stray = next((path for path in images if not _FILES.fullmatch(path.stem)), None)
    of_lens: dict[str, dict[str, Path]] = {"00": {}, "10": {}}
    for match, path in tagged:
        name, found = f"{match['before']}{match['after'][1:]}", of_lens[match["lens"]]
        if name in found:
            raise _twice(folder, found[name], path)
        found[name] = path
    if stray is not None and of_lens["00"] and of_lens["10"]:
        raise GsbaError(
            f"{folder}: '{stray.name}' lies among pictures of two lenses (_00_, _10_) but names "
            "none: remove it"
        )
    if stray is not None:
        return None
    return _paired(folder, (of_lens["00"], of_lens["10"]), ("a file _00_", "a file _10_"))


def side_by_side(
    folder: Path, paths: Sequence[Path], size: tuple[int, int], calibration: Path | None = None
) -> bool:
    """Whether 2:1 pictures show two fisheyes, front left and back right; says so in the log.

    Args:
        folder: that they are of.
        paths: in order.
        size: of each.
        calibration: where one is given, they are.

    Raises:
        GsbaError: a calibration is given, but they are panoramas.
    """
    spread = [(2 * i + 1) * len(paths) // (2 * _LOOKED_AT) for i in range(_LOOKED_AT)]
    rows = dict.fromkeys([len(paths) // 2, *spread])  # the middle one settles most panoramas
    greys = _readable([paths[row] for row in rows], size)
    if calibration is None:
        shown, notes = two_circles(greys, folder)
        for note in notes:
            _log.info(note)
        return shown
    if not all(_circles(grey)[0] for grey in greys):
        raise GsbaError(
            f"{folder}: holds 2:1 pictures that are lit up to the corners, so panoramas that are "
            f"stitched, and {calibration.name} is of raw fisheyes: leave --calibration out, or "
            "give the raw pictures"
        )
    _log.info("%s: raw, two fisheyes side by side, front left and back right", folder)
    return True


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


def decode_pair(
    paths: Sequence[Path], size: tuple[int, int], gray: bool = False
) -> list[np.ndarray]:
    """Pictures (h, w[, 3]) uint8 of the front and of the back lens.

    Args:
        paths: of each, or twice that of one file in which they are side by side.
        size: width and height of one lens's picture.
        gray: one channel instead of RGB.
    """
    width, height = size
    if paths[0] == paths[1]:
        both = decode(paths[0], (2 * width, height), gray)
        return [both[:, :width], both[:, width:]]
    return [decode(path, size, gray) for path in paths]


def lenses_of(folder: Path, pairs: Sequence[tuple[Path, ...]], calibration: Path | None) -> Pair:
    """What the lenses of raw pairs are: by a calibration file, or of the circles that they show.

    Raises:
        GsbaError: a calibration of other pictures, or pictures that show no circle.
    """
    first, second = pairs[0]
    width, height = image_size(first)
    size = (width // 2 if first == second else width, height)
    if calibration is not None:
        return fitted(read_calibration(calibration), size, calibration)
    rows = np.unique(np.linspace(0, len(pairs) - 1, _LOOKS).astype(int))
    looks = np.array([decode_pair(pairs[f], size, gray=True) for f in rows])
    circles = [_circle(lit) for lit in looks.max(axis=0)]
    if circles[0] is None or circles[1] is None:
        cube = "; of a cube, its other faces" if first.parent.name.lower() == "front" else ""
        raise GsbaError(
            f"{folder}: its {'front' if circles[0] is None else 'back'} pictures show no bright "
            f"circle within black corners, as fisheyes do: of raw pairs, give --calibration FILE"
            f"{cube}"
        )
    front = _nominal(size, circles[0], np.eye(3))
    behind = [_nominal(size, circles[1], _BEHIND @ turn) for turn in _TURNS]
    back, clearly = _continued(looks, front, behind)
    if not clearly:
        raise GsbaError(
            f"{folder}: raw fisheyes of unknown lenses, and what both show at their rims does not "
            "tell how one is turned against the other: give --calibration FILE"
        )
    _log.warning(
        "%s: raw fisheyes of unknown lenses, taken for %.0f degrees in circles of %.0f pixels: "
        "--calibration FILE says better",
        folder,
        np.rad2deg(2 * _HALF_FOV),
        2 * circles[0][2],
    )
    return front, back


def _images_in(folder: Path) -> list[Path]:
    """Images of what may be a folder, in name order."""
    if not folder.is_dir():
        return []
    try:
        return [path for path in sorted(folder.iterdir()) if is_image(path)]
    except OSError as error:
        raise GsbaError(f"{folder}: cannot be read ({error.strerror})") from None


def _by_stem(folder: Path, images: Iterable[Path]) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for path in images:
        if path.stem in found:
            raise _twice(folder, found[path.stem], path)
        found[path.stem] = path
    return found


def _twice(folder: Path, one: Path, other: Path) -> GsbaError:
    return GsbaError(
        f"{folder}: '{one.name}' and '{other.name}' are one lens's picture of one frame twice: "
        "keep one"
    )


def _paired(
    folder: Path, found: tuple[Mapping[str, Path], Mapping[str, Path]], kinds: tuple[str, str]
) -> Found:
    for one, other, kind in ((0, 1, kinds[1]), (1, 0, kinds[0])):
        missing = sorted(found[one].keys() - found[other].keys())
        if missing:
            raise GsbaError(
                f"{folder}: '{found[one][missing[0]].name}' has no picture in {kind} of the other "
                f"lens ({len(missing)} of {len(found[one])}); remove it, or extract both alike"
            )
    return {name: (path, found[1][name]) for name, path in found[0].items()}


def _nominal(
    size: tuple[int, int], circle: tuple[float, float, float], rig_R_lens: np.ndarray
) -> Fisheye:
    """An equidistant lens that fills a circle."""
    x, y, radius = circle
    a, b, c = (float(v) for v in Rotation.from_matrix(rig_R_lens).as_rotvec())
    return Fisheye(*size, radius / float(_HALF_FOV), (x, y), (0.0, 0.0, 0.0, 0.0), (a, b, c))


def _continued(looks: np.ndarray, front: Fisheye, behind: list[Fisheye]) -> tuple[Fisheye, bool]:
    """The one of several back lenses whose pictures go on where the front one's end, and whether it
    is clearly that one.

    Args:
        looks: (N, 2, h, w) uint8, pictures of both.
    """
    scores = [rim_likeness(looks, front, lens) for lens in behind]
    order = np.argsort(scores)[::-1]
    return behind[int(order[0])], bool(scores[order[0]] > scores[order[1]] + _CLEARLY)


def rim_likeness(
    looks: Sequence[Sequence[np.ndarray]] | np.ndarray, front: Fisheye, back: Fisheye
) -> float:
    """Mean correlation of what both lenses show at their rims, about 1 where lenses are right.

    Args:
        looks: (N, 2, h, w) uint8, pictures of both.
    """
    longitudes = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    angles = np.pi / 2 + np.linspace(-_OVERLAP, _OVERLAP, _ACROSS)[:, None]
    ring = np.stack(
        [
            np.sin(angles) * np.cos(longitudes),
            np.sin(angles) * np.sin(longitudes),
            np.cos(angles) * np.ones_like(longitudes),
        ],
        axis=-1,
    )
    both = [(_seen(one, front, ring), _seen(other, back, ring)) for one, other in looks]
    return float(np.mean([_alike(one, other) for one, other in both]))


def _seen(picture: np.ndarray, lens: Fisheye, directions: np.ndarray) -> np.ndarray:
    places = (project(lens, directions) - 0.5).astype(np.float32)
    blurred = cv2.GaussianBlur(picture, (0, 0), lens.focal / _AROUND * np.pi)
    return cv2.remap(blurred, places[..., 0], places[..., 1], cv2.INTER_LINEAR).astype(np.float64)


def _alike(one: np.ndarray, other: np.ndarray) -> float:
    """Correlation of two pictures."""
    a, b = one - one.mean(), other - other.mean()
    return float(np.sum(a * b) / np.sqrt(max(np.sum(a * a) * np.sum(b * b), 1e-12)))


def _readable(paths: Iterable[Path], size: tuple[int, int]) -> Iterator[np.ndarray]:
    """Grey pictures, small ones where that is fast; what is damaged is refused when it is used."""
    for path in paths:
        try:
            yield decode(path, size, gray=True, at_least=_SMALL)
        except GsbaError:
            continue


def _circles(grey: np.ndarray) -> tuple[bool, float]:
    """What speaks for two image circles in a 2:1 picture (H, 2H) uint8.

    Returns:
        whether all around them is black, and in which part of the rows they are lit beside it.
    """
    height, width = grey.shape
    v, u = np.ogrid[:height, :width]
    radius = np.hypot(np.mod(u + 0.5, height) - height / 2, v + 0.5 - height / 2)
    outside, inside = radius > _OUTSIDE * height, radius < _INSIDE * height
    rows = np.flatnonzero(outside.any(axis=1) & inside.any(axis=1))
    if not len(rows):
        return False, 0.0
    black = bool(np.percentile(grey[outside], 90) < _BLACK)
    lit = [
        np.median(grey[row, inside[row]]) > _LIT and grey[row, outside[row]].mean() < _BLACK
        for row in rows
    ]
    return black, float(np.mean(lit))


def _circle(lit: np.ndarray) -> tuple[float, float, float] | None:
    """Centre and radius, pixels, of the disc that light reaches in a picture (h, w) uint8; None =
    it reaches the corners as well."""
    height, width = lit.shape
    bright = cv2.medianBlur(lit, 5) > _DARK
    if not bright.any():
        return None
    x, y, radius, inner = width / 2, height / 2, 0.0, np.zeros((0, 2))
    for _ in range(3):
        points = _rim(bright, x, y)
        inner = points[
            (points > 1.5).all(axis=1) & (points < np.array([width, height]) - 1.5).all(axis=1)
        ]
        if len(inner) < _RIM // 8:
            return None
        x, y, radius = _fitted_circle(inner)
        if not (0 < x < width and 0 < y < height):
            return None
    off = np.abs(np.hypot(inner[:, 0] - x, inner[:, 1] - y) - radius)
    if np.mean(off < _OFF * radius) < _ON_RIM or radius < _LEAST * min(width, height):
        return None
    grid = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    outside = np.hypot(grid[..., 0] - x, grid[..., 1] - y) > 1.03 * radius
    if outside.mean() < 0.05 or bright[outside].mean() > _IN_CORNERS:
        return None
    return x, y, radius


def _rim(bright: np.ndarray, x: float, y: float) -> np.ndarray:
    """The furthest bright pixel from a place in each of many directions, (N, 2)."""
    height, width = bright.shape
    reach = np.arange(1.0, np.hypot(height, width), _STEP)
    angles = 2 * np.pi * (np.arange(4 * _RIM) + 0.5) / (4 * _RIM)
    across = x + reach * np.cos(angles)[:, None]
    down = y + reach * np.sin(angles)[:, None]
    inside = (across >= 0) & (across < width) & (down >= 0) & (down < height)
    columns, rows = (
        np.minimum(across.astype(int), width - 1),
        np.minimum(down.astype(int), height - 1),
    )
    lit = inside & bright[np.maximum(rows, 0), np.maximum(columns, 0)]
    seen = lit.any(axis=1)
    last = lit.shape[1] - 1 - np.argmax(lit[:, ::-1], axis=1)
    return np.stack([across[np.arange(len(last)), last], down[np.arange(len(last)), last]], axis=1)[
        seen
    ]


def _fitted_circle(points: np.ndarray) -> tuple[float, float, float]:
    """Circle through points (N, 2), those far inside of it (dark places at the rim) let go."""
    weights = np.ones(len(points))
    x = y = radius = 0.0
    for _ in range(10):
        columns = np.column_stack([2 * points, np.ones(len(points))]) * weights[:, None]
        right = weights * np.sum(points**2, axis=1)
        (x, y, rest), *_ = np.linalg.lstsq(columns, right, rcond=None)
        radius = float(np.sqrt(max(rest + x * x + y * y, 1e-9)))
        off = np.hypot(points[:, 0] - x, points[:, 1] - y) - radius
        weights = 1 / (1 + (off / (0.01 * radius)) ** 2)
    return float(x), float(y), radius
