"""Raw dual fisheyes on disk: which pictures are of one frame, what their lenses are at first."""

import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from gsba.camera.calibration import fitted, read_calibration
from gsba.camera.fisheye import Pair, project
from gsba.frames.files import decode, image_size, is_image
from gsba.frames.image_circles import CircleSearch, ImageCircle, find_circle
from gsba.frames.side_by_side import cut
from gsba.log import GsbaError
from gsba.types import FACES, Fisheye

_log = logging.getLogger(__name__)

_OF_FACE = re.compile(rf".+_({'|'.join(FACES)})", re.IGNORECASE)
_HALF_FOV = np.deg2rad(100.0)  # of the circle that a fisheye of unknown make fills
_LOOKS = 8  # frames that show the image circles
_BEHIND = np.diag([-1.0, 1.0, -1.0])  # rig_R_lens of an upright back lens
_TURNS = [Rotation.from_euler("z", turn).as_matrix() for turn in np.deg2rad([0, 90, 180, 270])]
_OVERLAP = np.deg2rad(4.0)  # either way of the rim, which both lenses show
_AROUND, _ACROSS = 720, 9  # places at which they are compared
_CLEARLY = 0.1  # by how much more alike the right turn makes them than any other

Found = dict[str, tuple[Path, Path]]  # frame -> picture of the front lens, of the back lens


@dataclass(frozen=True, slots=True)
class _FileTags:
    """How the names of files say which lens took them."""

    pattern: re.Pattern[str]  # of a stem: groups before, lens, after
    lenses: tuple[str, str]  # what the front and the back lens are called, in upper case
    shown: tuple[str, str]  # how messages call the files
    maker: str = ""  # camera that names files so; empty = several do

    def read(self, stem: str) -> tuple[int, str] | None:
        """Lens, 0 front or 1 back, and the frame's name; None = the stem has no such tag."""
        found = self.pattern.fullmatch(stem)
        if found is None:
            return None
        return self.lenses.index(found["lens"].upper()), found["before"] + found["after"]


_CLOCK_TAGS = _FileTags(
    re.compile(r"(?P<before>.*_)(?P<lens>00|10)_(?P<after>.*)"), ("00", "10"), ("_00_", "_10_")
)
_FUSION = "GoPro Fusion"
_FUSION_TAGS = (
    _FileTags(
        re.compile(r"(?P<before>GP)(?P<lens>FR|BK)(?P<after>.+)", re.IGNORECASE),
        ("FR", "BK"),
        ("GPFR...", "GPBK..."),
        _FUSION,
    ),
    _FileTags(
        re.compile(r"(?P<before>G)(?P<lens>F|B)(?P<after>\d{4,}.*)", re.IGNORECASE),
        ("F", "B"),
        ("GF...", "GB..."),
        _FUSION,
    ),
)
_FOLDERS = (("front", "back"), ""), (("lens0", "lens1"), ""), (("fr", "bk"), _FUSION)


def find_pairs(folder: Path) -> Found | None:
    """Pictures of raw pairs in a folder, one file for each lens; None = it holds something else.

    Raises:
        GsbaError: a picture of one lens has none of the other.
    """
    entries = sorted(folder.iterdir())
    images = [path for path in entries if is_image(path) and path.is_file()]
    known = {*FACES, *(name for names, _ in _FOLDERS for name in names)}
    by_name = {path.name.lower(): path for path in entries if path.name.lower() in known}
    holding = {name: found for name, path in by_name.items() if (found := _images_in(path))}
    for names, maker in _FOLDERS:
        here = holding.keys() & {*names, *FACES}
        if not here or not here <= set(names):
            continue
        if images:
            raise GsbaError(
                f"{folder}: holds both images ('{images[0].name}') and folders of lenses "
                f"('{by_name[min(here)].name}'); keep one of them"
            )
        if len(here) == 1:
            (one,), (other,) = here, set(names) - here
            one, other = (by_name[one].name, other.upper() if maker else other)
            cube = "" if maker else ", of a cube most faces"
            raise GsbaError(
                f"{folder}: holds {one}/ but no pictures in {other}/: of raw pairs the other "
                f"lens's are missing{cube}; extract them again"
            )
        front, back = (_by_frame(folder, holding[name]) for name in names)
        shown = [f"{by_name[name].name if maker else name}/" for name in names]
        if maker:
            _log.info("%s: raw pairs of a %s, front lens in %s, back in %s", folder, maker, *shown)
        return _paired(folder, (front, back), (shown[0], shown[1]))
    for tags in (_CLOCK_TAGS, *_FUSION_TAGS):
        found = _tagged_pairs(folder, images, tags)
        if found is not None:
            return found
    return None


def _tagged_pairs(folder: Path, images: Sequence[Path], tags: _FileTags) -> Found | None:
    """Pairs of files whose names say the lens; panoramas and cube faces may be named so."""
    tagged = {path: tag for path in images if (tag := tags.read(path.stem))}
    if not tagged or all(_OF_FACE.fullmatch(path.stem) for path in tagged):
        return None
    width, height = image_size(next(iter(tagged)))
    if width == 2 * height:
        return None
    of_lens: tuple[dict[str, Path], dict[str, Path]] = {}, {}
    for path, (lens, name) in tagged.items():
        if name in of_lens[lens]:
            raise _twice(folder, of_lens[lens][name], path)
        of_lens[lens][name] = path
    stray = next((path for path in images if path not in tagged), None)
    if stray is not None and all(of_lens):
        raise GsbaError(
            f"{folder}: '{stray.name}' lies among pictures of two lenses "
            f"({', '.join(tags.shown)}) but names none: remove it"
        )
    if stray is not None:
        return None
    if tags.maker:
        given = folder, tags.maker, *tags.shown
        _log.info("%s: raw pairs of a %s, %s of the front lens, %s of the back one", *given)
    return _paired(folder, of_lens, (f"a file {tags.shown[0]}", f"a file {tags.shown[1]}"))


def decode_pair(
    paths: Sequence[Path], size: tuple[int, int], gray: bool = False
) -> list[np.ndarray]:
    """Pictures (h, w[, 3]) uint8 of the front and of the back lens.

    Args:
        paths: of each, or twice that of one file in which they are side by side, perhaps squeezed.
        size: width and height of one lens's picture, not squeezed.
        gray: one channel instead of RGB.
    """
    if paths[0] == paths[1]:
        width, height = image_size(paths[0])
        squeezed = width == 2 * size[0] and height != size[1]
        return cut(
            decode(paths[0], (width, height) if squeezed else (2 * size[0], size[1]), gray), size
        )
    return [decode(path, size, gray) for path in paths]


def lenses_of(
    folder: Path,
    pairs: Sequence[tuple[Path, ...]],
    size: tuple[int, int],
    calibration: Path | None,
    circles: Sequence[ImageCircle] = (),
) -> Pair:
    """What the lenses of raw pairs are: by a calibration file, or of the circles that they show.

    Args:
        folder: that the pictures are in.
        pairs: files of each frame.
        size: width and height of one lens's picture.
        calibration: file; None = there is none.
        circles: image circles of the front and the back lens, or one of both; none = found.

    Raises:
        GsbaError: a calibration of other pictures, circles outside of the pictures, or pictures
            that show no circle.
    """
    if calibration is not None:
        return fitted(read_calibration(calibration), size, calibration)
    rows = np.unique(np.linspace(0, len(pairs) - 1, _LOOKS).astype(int))
    looks = [decode_pair(pairs[f], size, gray=True) for f in rows]
    front_circle, back_circle = _given(circles, size) or _found(folder, pairs[0], looks)
    front = _nominal(size, front_circle, np.eye(3))
    behind = [_nominal(size, back_circle, _BEHIND @ turn) for turn in _TURNS]
    back, clearly = _continued(looks, front, behind)
    if not clearly:
        raise GsbaError(
            f"{folder}: raw fisheyes of unknown lenses, and what both show at their rims does not "
            "tell how one is turned against the other: give --calibration FILE"
        )
    _log.warning(
        "%s: raw fisheyes of unknown lenses, taken for %.0f degrees in circles of %.0f and %.0f "
        "pixels (%s): --calibration FILE says better",
        folder,
        np.rad2deg(2 * _HALF_FOV),
        2 * front_circle.radius,
        2 * back_circle.radius,
        "given" if circles else f"found to {max(front_circle.sigma, back_circle.sigma):.1f} pixels",
    )
    return front, back


def _given(
    circles: Sequence[ImageCircle], size: tuple[int, int]
) -> tuple[ImageCircle, ImageCircle] | None:
    """Circles of both lenses as a caller says; None = nothing is said.

    Raises:
        GsbaError: one of them is not in the picture.
    """
    if not circles:
        return None
    width, height = size
    for circle in circles:
        inside = 0 < circle.x < width and 0 < circle.y < height
        if not inside or not 0 < circle.radius < np.hypot(width, height) / 2:
            raise GsbaError(
                f"--circle {circle.x:g},{circle.y:g},{circle.radius:g}: lies outside of the "
                f"pictures, which are {width}x{height} for one lens: give the circle's centre and "
                "radius in pixels of these"
            )
    return circles[0], circles[-1]


def _found(
    folder: Path, first: Sequence[Path], looks: Sequence[Sequence[np.ndarray]]
) -> tuple[ImageCircle, ImageCircle]:
    """Circles that the pictures of both lenses show.

    Raises:
        GsbaError: one lens's show none.
    """
    circles = []
    for name, pictures in zip(("front", "back"), zip(*looks, strict=True), strict=True):
        search: CircleSearch = find_circle(pictures)
        if search.circle is None:
            cube = "; of a cube, its other faces" if first[0].parent.name.lower() == "front" else ""
            raise GsbaError(
                f"{folder}: its {name} pictures show no bright circle within darker corners, as "
                f"fisheyes do ({search.sighting()}): of raw pairs, give --circle X,Y,R (pixels) or "
                f"--calibration FILE{cube}"
            )
        circles.append(search.circle)
    return circles[0], circles[1]


def _images_in(folder: Path) -> list[Path]:
    """Images of what may be a folder, in name order."""
    if not folder.is_dir():
        return []
    try:
        return [path for path in sorted(folder.iterdir()) if is_image(path)]
    except OSError as error:
        raise GsbaError(f"{folder}: cannot be read ({error.strerror})") from None


def _by_frame(folder: Path, images: Iterable[Path]) -> dict[str, Path]:
    """Pictures of one lens by frame: by their stems, without what these say of the lens."""
    found: dict[str, Path] = {}
    for path in images:
        tag = next((tag for tags in _FUSION_TAGS if (tag := tags.read(path.stem))), None)
        name = path.stem if tag is None else tag[1]
        if name in found:
            raise _twice(folder, found[name], path)
        found[name] = path
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


def _nominal(size: tuple[int, int], circle: ImageCircle, rig_R_lens: np.ndarray) -> Fisheye:
    """An equidistant lens that fills a circle."""
    a, b, c = (float(v) for v in Rotation.from_matrix(rig_R_lens).as_rotvec())
    focal, none = circle.radius / float(_HALF_FOV), (0.0, 0.0, 0.0, 0.0)
    return Fisheye(*size, focal, (circle.x, circle.y), none, (a, b, c))


def _continued(
    looks: Sequence[Sequence[np.ndarray]], front: Fisheye, behind: list[Fisheye]
) -> tuple[Fisheye, bool]:
    """The one of several back lenses whose pictures go on where the front one's end, and whether it
    is clearly that one.

    Args:
        looks: (h, w) uint8 pictures of both, of each of several frames.
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
