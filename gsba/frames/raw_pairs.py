"""Raw fisheyes on disk: a picture of each lens, and the initial calibration of the lenses."""

import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from gsba.camera.calibration import read_calibration, scaled_to_size
from gsba.camera.fisheye import Rig
from gsba.frames.files import Found, decode, image_size, images_by_name, images_in, is_image, paired
from gsba.frames.image_circles import CircleSearch, ImageCircle, find_circle
from gsba.frames.lens_names import FUSION_NAMES, LENS_NAMES, LensNames
from gsba.frames.lens_overlap import measure_overlap, scaled
from gsba.frames.side_by_side import cut
from gsba.log import GsbaError
from gsba.types import FACES, Fisheye, rows_across

_log = logging.getLogger(__name__)

_OF_FACE = re.compile(rf".+_({'|'.join(FACES)})", re.IGNORECASE)
_NOMINAL_HALF_FOV_RAD = np.deg2rad(100.0)  # half angle of the image circle of an unknown fisheye
_RIG_R_BACK_LENS = np.diag([-1.0, 1.0, -1.0])  # rig_R_lens of an upright back lens
_QUARTER_TURNS = [
    Rotation.from_euler("z", turn).as_matrix() for turn in np.deg2rad([0, 90, 180, 270])
]

_NUMBERED = re.compile(r"lens(\d+)", re.IGNORECASE)  # folders of more than two lenses


_FOLDERS = (("front", "back"), ""), (("lens0", "lens1"), ""), (("fr", "bk"), "GoPro Fusion")


def find_pairs(folder: Path) -> Found | None:
    """Pictures of raw lenses in a folder, one file for each lens; None = it holds something else.
    Raises GsbaError: a picture of one lens has no counterpart."""
    entries = sorted(folder.iterdir())
    images = [path for path in entries if is_image(path) and path.is_file()]
    numbered = {int(m[1]): path for path in entries if (m := _NUMBERED.fullmatch(path.name))}
    numbered = {lens: path for lens, path in numbered.items() if images_in(path)}
    if len(numbered) > 2 and not images:
        return _of_numbered(folder, numbered)
    known = {*FACES, *(name for names, _ in _FOLDERS for name in names)}
    by_name = {path.name.lower(): path for path in entries if path.name.lower() in known}
    holding = {name: found for name, path in by_name.items() if (found := images_in(path))}
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
        front, back = (images_by_name(folder, holding[name], _name_of) for name in names)
        shown = [f"{by_name[name].name if maker else name}/" for name in names]
        if maker:
            _log.info("%s: raw pairs of a %s, front lens in %s, back in %s", folder, maker, *shown)
        return paired(folder, (front, back), (shown[0], shown[1]))
    for tags in LENS_NAMES:
        found = _tagged_pairs(folder, images, tags)
        if found is not None:
            return found
    return None


def _of_numbered(folder: Path, numbered: Mapping[int, Path]) -> Found:
    """Pictures of three lenses or more, in folders lens0, lens1, ..."""
    if sorted(numbered) != list(range(len(numbered))):
        held = ", ".join(f"{numbered[lens].name}/" for lens in sorted(numbered))
        raise GsbaError(
            f"{folder}: holds pictures in {held}: lenses are numbered from lens0 on without a gap"
        )
    found = [
        images_by_name(folder, images_in(numbered[lens]), _name_of) for lens in sorted(numbered)
    ]
    for lens, other in enumerate(found[1:], 1):
        kinds = f"{numbered[0].name}/", f"{numbered[lens].name}/"
        paired(folder, (found[0], other), kinds)
    return {name: tuple(of_lens[name] for of_lens in found) for name in found[0]}


def _tagged_pairs(folder: Path, images: Sequence[Path], tags: LensNames) -> Found | None:
    """Pairs of files named after their lens; None for panoramas and cube faces named like that."""
    tagged = {path: tag for path in images if (tag := tags.read(path.stem))}
    if not tagged or all(_OF_FACE.fullmatch(path.stem) for path in tagged):
        return None
    width, height = image_size(next(iter(tagged)))
    if width == 2 * height:
        return None
    names = {path.stem: name for path, (_, name) in tagged.items()}
    of_lens = []
    for lens in (0, 1):
        own = (path for path in tagged if tagged[path][0] == lens)
        of_lens.append(images_by_name(folder, own, names.__getitem__))
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
    return paired(folder, of_lens, (f"a file {tags.shown[0]}", f"a file {tags.shown[1]}"))


def decode_pair(
    paths: Sequence[Path], size: tuple[int, int], gray: bool = False
) -> list[np.ndarray]:
    """Pictures (h, w[, 3]) uint8 of each lens.

    Args:
        paths: of each lens, or twice that of a file with both side by side, perhaps squeezed.
        size: width and height of one lens's picture, not squeezed.
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
) -> tuple[Rig, bool]:
    """Initial lenses of raw frames: from a calibration, or of a pair from the image circles.

    Args:
        pairs: files of each frame.
        size: width and height of one lens's picture.
        circles: image circles of the front and the back lens, or one for both; none = detect them.

    Returns:
        the lenses, and True if they are to be estimated: nominal lenses, or a calibration that the
        pictures contradict.

    Raises:
        GsbaError: a calibration of other pictures or of another number of lenses, circles outside
            of the pictures, or pictures without a visible circle.
    """
    rows = rows_across(len(pairs), 8)
    if calibration is not None:
        some = [pairs[f] for f in rows]
        return _calibrated(folder, some, size, calibration)
    if len(pairs[0]) > 2:
        raise GsbaError(
            f"{folder}: holds pictures of {len(pairs[0])} lenses, and nothing says how these lie: "
            f"give --calibration FILE with lenses.lens0 to lenses.lens{len(pairs[0]) - 1}"
        )
    looks = [decode_pair(pairs[f], size, gray=True) for f in rows]
    front_circle, back_circle = _given_circles(circles, size) or _found_circles(
        folder, pairs[0], looks
    )
    front = _nominal_lens(size, front_circle, np.eye(3))
    behind = [_nominal_lens(size, back_circle, _RIG_R_BACK_LENS @ turn) for turn in _QUARTER_TURNS]
    radii = front_circle.radius, back_circle.radius
    turn, found_scale = measure_overlap(looks, front, behind, radii)
    if turn is None:
        raise GsbaError(
            f"{folder}: raw fisheyes of unknown lenses, and their overlap at the rims does not "
            "determine how one is turned against the other: give --calibration FILE"
        )
    scale = found_scale or 1.0
    off = max(front_circle.sigma, back_circle.sigma)
    _log.warning(
        "%s: raw fisheyes of unknown lenses, assumed to cover %.0f degrees in circles of %.0f "
        "and %.0f pixels (circles %s%s): for a better start pass --calibration FILE",
        folder,
        np.rad2deg(2 * _NOMINAL_HALF_FOV_RAD) / scale,
        *(2 * radius for radius in radii),
        "given" if circles else f"found to {off:.1f} pixels",
        "" if found_scale is None else "; degrees by both lenses' overlap at the seam",
    )
    return scaled((front, behind[turn]), scale), True


def _calibrated(
    folder: Path, chosen: Sequence[Sequence[Path]], size: tuple[int, int], calibration: Path
) -> tuple[Rig, bool]:
    """Lenses of a calibration; a pair that pictures contradict is rescaled, and True (to estimate).
    `chosen`: files of some frames, as for `decode_pair`."""
    known, num = scaled_to_size(read_calibration(calibration), size, calibration), len(chosen[0])
    if len(known) != num:
        raise GsbaError(
            f"{calibration}: calibrates {len(known)} lenses, but {folder} has pictures of {num}"
        )
    if num > 2:
        return known, False
    pair = known[0], known[-1]
    try:
        looks = [decode_pair(paths, size, gray=True) for paths in chosen]
    except GsbaError:  # the error is raised when the picture is used
        return pair, False
    circles = [find_circle(pictures).circle for pictures in zip(*looks, strict=True)]
    if circles[0] is None or circles[1] is None:
        return pair, False
    radii = circles[0].radius, circles[1].radius
    scale = measure_overlap(looks, pair[0], [pair[1]], radii)[1] or 1.0
    # parallax of near things looks like one or two percent
    if abs(scale - 1) < 0.025:
        return pair, False
    _log.warning(
        "%s: %s does not fit these pictures: both lenses match at the seam with focal lengths "
        "%.1f %% %s; the lenses start from these and are estimated",
        folder,
        calibration.name,
        100 * abs(scale - 1),
        "longer" if scale > 1 else "shorter",
    )
    return scaled(pair, scale), True


def _given_circles(
    circles: Sequence[ImageCircle], size: tuple[int, int]
) -> tuple[ImageCircle, ImageCircle] | None:
    """Image circles given by the caller; None = none are given."""
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


def _found_circles(
    folder: Path, first: Sequence[Path], looks: Sequence[Sequence[np.ndarray]]
) -> tuple[ImageCircle, ImageCircle]:
    """Image circles found in the pictures of both lenses."""
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


def _name_of(stem: str) -> str:
    """Frame name of one lens's picture: its stem without the part that names the lens."""
    tags = (names.read(stem) for names in FUSION_NAMES)
    return next((tag[1] for tag in tags if tag), stem)


def _nominal_lens(size: tuple[int, int], circle: ImageCircle, rig_R_lens: np.ndarray) -> Fisheye:
    """An equidistant lens whose field of view fills an image circle."""
    a, b, c = (float(v) for v in Rotation.from_matrix(rig_R_lens).as_rotvec())
    focal, none = circle.radius / float(_NOMINAL_HALF_FOV_RAD), (0.0, 0.0, 0.0, 0.0)
    return Fisheye(*size, focal, (circle.x, circle.y), none, (a, b, c))
