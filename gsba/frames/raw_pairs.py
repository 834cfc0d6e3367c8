"""Raw dual fisheyes on disk: which pictures are of one frame, what their lenses are at first."""

import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from gsba.camera.calibration import fitted, read_calibration
from gsba.camera.fisheye import Pair, project
from gsba.frames.files import decode, image_size, is_image
from gsba.log import GsbaError
from gsba.types import Fisheye

_log = logging.getLogger(__name__)

_FOLDERS = ("front", "back"), ("lens0", "lens1")
_FILES = re.compile(r"(?P<before>.*_)(?P<lens>00|10)(?P<after>_.*)")
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

Found = dict[str, tuple[Path, Path]]  # frame -> picture of the front lens, of the back lens


def find_pairs(folder: Path) -> Found | None:
    """Pictures of raw pairs in a folder; None = it holds something else.

    Raises:
        GsbaError: a picture of one lens has none of the other.
    """
    by_name = {path.name.lower(): path for path in sorted(folder.iterdir())}
    holding = {name for name, path in by_name.items() if path.is_dir() and _images(path)}
    for front, back in _FOLDERS:
        if {front, back} <= holding and not holding - {front, back}:
            found = (_images(by_name[front]), _images(by_name[back]))
            return _paired(folder, found, (f"{front}/", f"{back}/"))
    tagged = [(m, path) for path in by_name.values() if (m := _FILES.fullmatch(path.stem))]
    of_lens = {"00": dict[str, Path](), "10": dict[str, Path]()}
    for match, path in tagged:
        if is_image(path):
            of_lens[match["lens"]][f"{match['before']}{match['after'][1:]}"] = path
    if of_lens["00"] and of_lens["10"]:
        return _paired(folder, (of_lens["00"], of_lens["10"]), ("a file _00_", "a file _10_"))
    return None


def lenses_of(folder: Path, pairs: Sequence[tuple[Path, ...]], calibration: Path | None) -> Pair:
    """What the lenses of raw pairs are: by a calibration file, or of the circles that they show.

    Raises:
        GsbaError: a calibration of other pictures, or pictures that show no circle.
    """
    size = image_size(pairs[0][0])
    if calibration is not None:
        return fitted(read_calibration(calibration), size, calibration)
    rows = np.unique(np.linspace(0, len(pairs) - 1, _LOOKS).astype(int))
    looks = np.array([[decode(path, size, gray=True) for path in pairs[f]] for f in rows])
    circles = [circle for lit in looks.max(axis=0) if (circle := _circle(lit)) is not None]
    if len(circles) < 2:
        raise GsbaError(
            f"{folder}: holds {_FOLDERS[0][0]} and {_FOLDERS[0][1]} pictures without the black "
            "corners of fisheyes: of raw pairs, give --calibration FILE; of a cube, its other faces"
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


def _images(folder: Path) -> dict[str, Path]:
    return {path.stem: path for path in sorted(folder.iterdir()) if is_image(path)}


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
    ahead = [_seen(pictures[0], front, ring) for pictures in looks]
    scores = [
        np.mean([_alike(a, _seen(p[1], lens, ring)) for a, p in zip(ahead, looks, strict=True)])
        for lens in behind
    ]
    order = np.argsort(scores)[::-1]
    return behind[int(order[0])], bool(scores[order[0]] > scores[order[1]] + _CLEARLY)


def _seen(picture: np.ndarray, lens: Fisheye, directions: np.ndarray) -> np.ndarray:
    places = (project(lens, directions) - 0.5).astype(np.float32)
    blurred = cv2.GaussianBlur(picture, (0, 0), lens.focal / _AROUND * np.pi)
    return cv2.remap(blurred, places[..., 0], places[..., 1], cv2.INTER_LINEAR).astype(np.float64)


def _alike(one: np.ndarray, other: np.ndarray) -> float:
    """Correlation of two pictures."""
    a, b = one - one.mean(), other - other.mean()
    return float(np.sum(a * b) / np.sqrt(max(np.sum(a * a) * np.sum(b * b), 1e-12)))


def _circle(lit: np.ndarray) -> tuple[float, float, float] | None:
    """Centre and radius, pixels, of the disc that light reaches in a picture (h, w) uint8; None =
    it reaches the corners as well."""
    height, width = lit.shape
    bright = cv2.medianBlur(lit, 5) > _DARK
    if not bright.any():
        return None
    x, y = width / 2, height / 2
    for _ in range(3):
        points = _rim(bright, x, y)
        inner = points[
            (points > 1.5).all(axis=1) & (points < np.array([width, height]) - 1.5).all(axis=1)
        ]
        if len(inner) < _RIM // 8:
            return None
        x, y, radius = _fitted_circle(inner)
    grid = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    outside = np.hypot(grid[..., 0] - x, grid[..., 1] - y) > 1.03 * radius
    if outside.mean() < 0.05 or bright[outside].mean() > _IN_CORNERS:
        return None
    return x, y, radius


def _rim(bright: np.ndarray, x: float, y: float) -> np.ndarray:
    """The furthest bright pixel from a place in each of many directions, (N, 2)."""
    height, width = bright.shape
    reach = np.arange(1.0, np.hypot(height, width))
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
