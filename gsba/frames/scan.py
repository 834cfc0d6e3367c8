"""Captured frames on disk: which images form a frame, in what order, and their pixels."""

import filecmp
import logging
import re
import shlex
import unicodedata
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from gsba.camera.calibration import read_calibration
from gsba.camera.factory_lenses import FactoryLenses
from gsba.camera.fisheye import Rig
from gsba.frames.dual_fisheye import width_of
from gsba.frames.factory_start import FACTORY_FILE, find_factory_lenses, starting_lenses
from gsba.frames.files import (
    EXTRACTED,
    decode,
    entries_of,
    image_header,
    image_size,
    images_by_name,
    images_in,
    is_image,
)
from gsba.frames.headers import Header
from gsba.frames.image_circles import ImageCircle
from gsba.frames.masks import find_masks
from gsba.frames.panorama_checks import NUM_LOOKS, OVER_UNDER, REMEDIES, unlike_panorama
from gsba.frames.raw_pairs import find_pairs, lenses_of
from gsba.frames.side_by_side import (
    in_folder,
    lens_sizes,
    may_hold_two,
    one_beside_other,
    readable,
    two_circles,
)
from gsba.frames.times import frame_times
from gsba.frames.track_pairs import check_tracks, find_tracks
from gsba.log import GsbaError, track
from gsba.types import FACES, FrameSet, PictureFormat
from gsba.types.records import spread_rows

MAX_ROUNDING = 0.02  # of the width by which encoders miss 2:1
_log = logging.getLogger(__name__)

MIN_FRAMES = 3
_SIDE_FACES = ("front", "right", "back", "left")
_TIMES_FILE = "timestamps.csv"
_TAGGED = re.compile(rf"(?P<name>.+)_(?P<face>{'|'.join(FACES)})", re.IGNORECASE)
UNSUPPORTED_FORMATS = {  # images that are not read, by suffix
    ".avif": "AVIF",
    ".36p": "GoPro .36P",
    ".bmp": "BMP",
    ".dng": "DNG",
    ".exr": "EXR",
    ".gif": "GIF",
    ".heic": "HEIC",
    ".heif": "HEIF",
    ".jp2": "JPEG 2000",
    ".jxl": "JPEG XL",
}


def scan(
    folder: Path,
    timestamps: Path | None = None,
    fps: float | None = None,
    masks: Path | None = None,
    order_suffices: bool = False,
    calibration: Path | None = None,
    circles: Sequence[ImageCircle] = (),
    min_frames: int = MIN_FRAMES,
) -> FrameSet:
    """The frames of a folder, in time order, checked by their headers.

    It holds equirectangular images; or cube faces in subfolders `front`, `right`, ... or files
    `NAME_front.jpg`, ...; or raw fisheyes, a file for each lens (see `find_pairs`) or side by side
    in 2:1 or 16:9 images; or both tracks of an equi-angular cube map in `track0` and `track5`.

    Args:
        folder: JPEG, PNG, WebP or TIFF images; other files are ignored.
        timestamps: table of times (see `read_times`); else `timestamps.csv` in the folder, unless
            `fps` is given; else file names that are times; else EXIF tags.
        fps: frames per second of these files in name order.
        masks: one ERP mask for all frames, or a folder with one for each; white = use.
        order_suffices: use name order where no source gives times.
        calibration: calibration file of raw fisheyes, see `gsba.camera.calibration`.
        circles: image circles of raw fisheyes, front and back, or one for both; none = detect.
        min_frames: fewer are refused.

    Raises:
        GsbaError: a file or frame cannot be used; the message names the first one.
    """
    if timestamps is not None and fps is not None:
        raise GsbaError("--timestamps and --fps both give the times of frames; pass one")
    layout, faces, found = _find_frames(Path(folder))
    if len(found) < min_frames:
        num = "1 frame" if len(found) == 1 else f"{len(found)} frames"
        below = _in_subfolders(Path(folder))
        more = f" ({below})" if below else ""
        raise GsbaError(f"{folder}: {num}; at least {min_frames} are needed{more}")
    names, times, timed = _in_time_order(Path(folder), found, timestamps, fps, order_suffices)
    paths = tuple(found[name] for name in names)
    width, height = _common_size(paths, layout)
    images, lens_size = [group[0] for group in paths], (width, height)
    tracks = lens_size if layout == "eac" else None
    if tracks:
        check_tracks(Path(folder), paths, tracks)
    factory = find_factory_lenses(Path(folder), images) if calibration is None else None
    known = calibration, circles, factory
    if layout == "erp" and (raw := _pair_size(Path(folder), images, lens_size, *known)) is not None:
        layout, lens_size = "fisheye", raw
        paths = tuple((path, path) for path in images)
    fisheyes, nominal = _lenses(Path(folder), layout, paths, lens_size, *known)
    if fisheyes is not None or tracks is not None:
        width = 4 * tracks[1] if tracks else width_of(fisheyes)  # type: ignore[arg-type]
        height = width // 2
    kind = PictureFormat(layout, width, height, faces, (), fisheyes, tracks, nominal)
    return FrameSet(
        names=names,
        paths=tuple(tuple(path.absolute() for path in group) for group in paths),
        timestamps=times,
        mask_paths=find_masks(masks, names, (width, height) if kind.panoramic else None),
        formats=(kind,),
        timed=timed,
    )


def warn_of_repeats(frames: FrameSet) -> None:
    """Pictures that are there twice have the same errors, which count as independent ones."""
    same = partial(filecmp.cmp, shallow=False)
    repeats = [
        name
        for name, (before, after) in zip(frames.names[1:], pairwise(frames.paths), strict=True)
        if before != after and all(map(same, before, after))
    ]
    if repeats:
        _log.warning(
            "%d of %d frames are the picture before them once more, %s first: errors will be larger"
            " than stated; leave them out",
            len(repeats),
            len(frames),
            repeats[0],
        )


def _in_time_order(
    folder: Path,
    found: Mapping[str, tuple[Path, ...]],
    timestamps: Path | None,
    fps: float | None,
    order_suffices: bool,
) -> tuple[tuple[str, ...], np.ndarray, bool]:
    """Names (F,) of the frames, ascending times (F,), and True if these are real times."""
    names = sorted(found, key=_natural)
    for name in names:  # of tables and datasets
        if any(unicodedata.category(letter) in ("Cc", "Cs") for letter in name):
            raise GsbaError(
                f"{folder}: the file name {name!r} holds control characters or is not UTF-8: "
                "rename it"
            )
    if names != sorted(names):
        swap = next((a, b) for a, b in pairwise(names) if a > b)
        _log.warning("frames are taken in numeric order (%s before %s)", *swap)
    table = timestamps
    if table is None and fps is None and (folder / _TIMES_FILE).is_file():
        table = folder / _TIMES_FILE
    if fps is not None:
        # stella_vslam gives every file of a folder a time slot, images or not
        last = max(path.name for path in found[names[-1]])
        early = [
            p.name for p in entries_of(folder) if p.is_file() and not is_image(p) and p.name < last
        ]
        if early:
            _log.warning(
                "--fps counts images only; if stella_vslam read this folder with '%s' in it, its "
                "times are %d frames later",
                early[0],
                len(early),
            )
    pictures = [found[name] for name in names]
    times, timed = frame_times(names, table, fps, order_suffices, pictures)
    order = np.argsort(times, kind="stable")
    names, times = [names[i] for i in order], times[order]
    same = np.flatnonzero(np.diff(times) <= 0)
    if len(same):
        a, b = names[same[0]], names[same[0] + 1]
        raise GsbaError(f"frames '{a}' and '{b}' have the same time {times[same[0]]!r}")
    return tuple(names), times, timed


def _pair_size(
    folder: Path,
    images: Sequence[Path],
    size: tuple[int, int],
    calibration: Path | None = None,
    circles: Sequence[ImageCircle] = (),
    factory: FactoryLenses | None = None,
) -> tuple[int, int] | None:
    """Size of one lens's picture where images hold two side by side; None = panoramas."""
    if factory is not None:
        return lens_sizes(size)[0]
    shape, source = None, ""
    if calibration is not None:
        front, source = read_calibration(calibration)[0], calibration.name
        shape = front.width, front.height
    found = in_folder(folder, images, size, shape, source)
    for note in found.notes:
        _log.info(note)
    if found.lens_size is None and circles and may_hold_two(size):
        _log.info("%s: read as two fisheyes side by side, because of --circle", folder)
        return lens_sizes(size)[-1]
    if found.lens_size is None and size[0] != 2 * size[1]:
        raise _no_panorama(images[0], image_header(images[0]), "; nor are there two image circles")
    if found.lens_size is None:
        _refuse_others(folder, images, size)
    return found.lens_size


def _refuse_others(folder: Path, images: Sequence[Path], size: tuple[int, int]) -> None:
    """Refuse 2:1 pictures that are no panoramas by their tags, or by what they show without any."""
    tags = image_header(images[0]).tags
    if tags is not None and tags.projection not in ("", "equirectangular"):
        raise GsbaError(
            f"{images[0]}: its GPano tags say '{tags.projection}'; gsba reads equirectangular "
            "panoramas"
        )
    if tags is not None and (tags.whole or image_header(images[0]).crop is not None):
        return
    chosen = np.unique(spread_rows(len(images), NUM_LOOKS)).tolist()
    kind = unlike_panorama(readable([images[k] for k in chosen], size))
    if kind:
        raise GsbaError(f"{folder} holds no panoramas but {kind}: {REMEDIES[kind]}")


def _lenses(
    folder: Path,
    layout: str,
    paths: Sequence[tuple[Path, ...]],
    size: tuple[int, int],
    calibration: Path | None,
    circles: Sequence[ImageCircle],
    factory: FactoryLenses | None,
) -> tuple[Rig | None, bool]:
    """Initial lenses of raw fisheyes, None = other layouts; True if they are to be estimated."""
    if layout == "fisheye" and factory is not None and not circles:
        return starting_lenses(folder, paths, size, factory), True
    if layout == "fisheye":
        return lenses_of(folder, paths, size, calibration, circles)
    held = "cube faces" if layout == "cube" else "panoramas"
    if calibration is not None:
        raise GsbaError(
            f"{calibration}: a calibration is for raw fisheyes, but {folder} holds {held}: "
            "leave --calibration out"
        )
    if circles:
        raise GsbaError(f"{folder}: holds {held}, but --circle is for raw fisheyes: leave it out")
    return None, False


def _find_frames(folder: Path) -> tuple[str, tuple[str, ...], dict[str, tuple[Path, ...]]]:
    """Layout, faces, and the images of each frame by name."""
    entries = entries_of(folder)
    pairs = find_pairs(folder)
    if pairs is not None:
        return "fisheye", (), dict(pairs)
    tracks = find_tracks(folder)
    if tracks is not None:
        return "eac", (), tracks
    images = [path for path in entries if is_image(path) and path.is_file()]
    subfolders = {
        path.name.lower(): path
        for path in entries
        if path.name.lower() in FACES and images_in(path)
    }
    if subfolders and images:
        raise GsbaError(
            f"{folder}: holds both images ('{images[0].name}') and face folders "
            f"('{next(iter(subfolders.values())).name}'); keep one of them"
        )
    others = [p.name for p in entries if p not in images and p not in subfolders.values()]
    others = [name for name in others if name not in (_TIMES_FILE, FACTORY_FILE, EXTRACTED)]
    if others:
        _log.info("%s: ignored %d other entries: %s", folder, len(others), ", ".join(others[:5]))
    places = [folder, *(path for path in entries if path.name.lower() in FACES and path.is_dir())]
    # "2 TIFF and 1 WebP images", of unsupported formats, or ""
    paths = (path for place in places for path in entries_of(place))
    kinds = [UNSUPPORTED_FORMATS.get(path.suffix.lower()) for path in paths if path.name[0] != "."]
    counts = sorted(Counter(kind for kind in kinds if kind).items())
    *front, last = [f"{n} {kind}" for kind, n in counts] or [""]
    text = f"{', '.join(front)} and {last}" if front else last
    foreign = text and f"{text} image{'s' if sum(n for _, n in counts) > 1 else ''}"
    if foreign and (subfolders or images):
        _log.warning("%s: left out %s: convert them to JPEG, PNG, WebP or TIFF", folder, foreign)
    if subfolders:
        by_face = {
            face: images_by_name(folder, images_in(subfolders[face]))
            for face in FACES
            if face in subfolders
        }
        return "cube", *_cube_frames(folder, by_face)
    if not images:
        raise _no_images(folder, others, foreign)
    tagged = {path: m for path in images if (m := re.fullmatch(_TAGGED, path.stem))}
    tags = {match["face"].lower() for match in tagged.values()}
    if not tags.issuperset(_SIDE_FACES) and len(tagged) < len(images):
        found = images_by_name(folder, images)
        return "erp", (), {name: (path,) for name, path in found.items()}
    stray = next((path for path in images if path not in tagged), None)
    if stray:
        raise GsbaError(f"{folder}: '{stray.name}' lies among cube faces but names no face")
    by_face = {
        face: {m["name"]: path for path, m in tagged.items() if m["face"].lower() == face}
        for face in FACES
        if face in tags
    }
    return "cube", *_cube_frames(folder, by_face)


def _in_subfolders(folder: Path) -> str:
    """Where pictures are in folders of a folder, and what to do about it; "" = there are none."""
    folders = [path for path in entries_of(folder) if path.is_dir() and path.name[0] != "."]
    below = list(filter(images_in, folders))
    if len(below) < 2:
        return f"its pictures are in {below[0]}: give that folder" if below else ""
    names = ", ".join(path.name for path in below[:5]) + (", ..." if len(below) > 5 else "")
    paths = " ".join(shlex.quote(str(path)) for path in below[:3])
    paths += " ..." if below[3:] else ""
    return (
        f"its pictures are in {len(below)} folders ({names}): give one of them, or all as "
        f"recordings of one place (gsba refine {paths} --out RUN)"
    )


def _no_images(folder: Path, others: Sequence[str], foreign: str) -> GsbaError:
    """The refusal of a folder without pictures."""
    if foreign:
        return GsbaError(
            f"{folder}: no JPEG, PNG, WebP or TIFF images, but {foreign}: convert them first"
        )
    if below := _in_subfolders(folder):
        return GsbaError(f"{folder}: {below}")
    counts = Counter(Path(name).suffix.lower() or Path(name).name for name in others)
    held = ", ".join(f"{n} {kind}" for kind, n in sorted(counts.items())[:5]) or "nothing"
    return GsbaError(
        f"{folder}: no JPEG, PNG, WebP or TIFF images (it holds {held}); extract the video's "
        "frames there first"
    )


def _cube_frames(
    folder: Path, by_face: Mapping[str, Mapping[str, Path]]
) -> tuple[tuple[str, ...], dict[str, tuple[Path, ...]]]:
    """Faces present and each frame's images in that order; all frames have the same faces."""
    faces = tuple(by_face)
    names = set().union(*by_face.values())
    for face in dict.fromkeys((*_SIDE_FACES, *faces)):
        missing = sorted(names - set(by_face.get(face, ())), key=_natural)
        if missing:
            raise GsbaError(
                f"{folder}: frame '{missing[0]}' has no {face} face "
                f"({len(missing)} of {len(names)} frames lack it)"
            )
    return faces, {name: tuple(by_face[face][name] for face in faces) for name in names}


def _common_size(paths: Sequence[tuple[Path, ...]], layout: str) -> tuple[int, int]:
    """Width and height shared by all images, checked against the layout."""
    first = paths[0][0]
    width, height = image_size(first)
    for group in track(paths, "checking frames"):
        for path in group:
            header = image_header(path)
            w, h = header.size
            if layout == "erp" and not may_hold_two((w, h)):
                raise _no_panorama(path, header, _stacked(path, (w, h)))
            if layout == "cube" and (w != h or h == 0):
                raise GsbaError(f"{path}: is {w}x{h}; a cube face is square")
            if (w, h) != (width, height) and layout in ("fisheye", "eac"):
                raise GsbaError(
                    f"{path}: is {w}x{h}, but '{first.parent.name}/{first.name}' is "
                    f"{width}x{height}: both lenses' pictures are of one size; extract them again"
                )
            if (w, h) != (width, height):
                raise GsbaError(
                    f"{path}: is {w}x{h}, but '{first.name}' is {width}x{height}: frames of a "
                    "folder are of one size; move others, as thumbnails, out of it"
                )
    return width, height


def _stacked(path: Path, size: tuple[int, int]) -> str:
    """Name of a picture of 1:2 or 1:1 that holds two pictures one above the other; "" = unknown."""
    width, height = size
    if height not in (width, 2 * width):
        return ""
    try:
        grey = decode(path, size, gray=True, at_least=512)
    except GsbaError:
        return ""
    if height == 2 * width and two_circles([one_beside_other(grey)], path)[0]:
        return (
            ". It holds two fisheyes one above the other: save each as a picture of its own, in "
            "folders front/ and back/"
        )
    kind = unlike_panorama([grey])
    return f". It is {kind}: {REMEDIES[kind]}" if kind == OVER_UNDER else ""


def _no_panorama(path: Path, header: Header, more: str = "") -> GsbaError:
    """The refusal of an image that is not 2:1."""
    (w, h) = header.size
    turned = header.swapped and h == 2 * w
    why = f" as its EXIF orientation {header.orientation} shows it" if turned else ""
    what = ": remove that tag" if turned else more
    if abs(w - 2 * h) <= MAX_ROUNDING * w:
        what = f", and this is nearly so: if it is a whole panorama, scale it to {w}x{w // 2}"
    elif (w / h) in (6, 1 / 6, 3 / 2, 2 / 3, 4 / 3, 3 / 4):  # faces across and down a picture
        what += ". If it is a cube map, cut out its faces, as front/NAME.jpg and so on"
    return GsbaError(f"{path}: is {w}x{h}{why}; an equirectangular frame is 2:1{what}")


def _natural(name: str) -> tuple[list[tuple[str, int]], str]:
    """Sort key in which runs of digits count as numbers."""
    parts = re.split(r"([0-9]+)", name)
    keys = [(p, -1) if i % 2 == 0 else ("", int(p)) for i, p in enumerate(parts)]
    return keys, name
