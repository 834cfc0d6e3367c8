"""Facts about an image, or about a folder of frames."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsba.camera.fisheye import lens_names
from gsba.frames.exif import ExifTags, read_exif
from gsba.frames.files import decode, image_size
from gsba.frames.image_circles import find_circle
from gsba.frames.panorama_checks import unlike_panorama
from gsba.frames.scan import scan
from gsba.frames.side_by_side import cut, one_beside_other, recognise, two_circles
from gsba.inspection.footage import Facts, Found, spoken_seconds
from gsba.log import GsbaError
from gsba.types import FrameSet

_LAYOUTS = {
    "erp": "stitched panoramas",
    "fisheye": "raw, two fisheyes a frame",
    "cube": "faces of a cube",
    "eac": "equi-angular cube map, two images a frame",
}


def of_folder(folder: Path) -> Found:
    """Facts about a folder of frames."""
    try:
        frames = scan(folder, order_suffices=True)
    except GsbaError as error:
        return Found((), str(error))
    tags = [tag for paths in frames.paths if (tag := _tags(paths[0])) is not None]
    return Found((*_camera(tags), *_about(frames), *_positions(tags, len(frames))))


def of_picture(path: Path) -> Found:
    """Facts about one image, which alone cannot be refined."""
    size = image_size(path)
    tags = _tags(path)
    facts = (
        *_camera([tags] if tags else []),
        ("size", f"{size[0]}x{size[1]}"),
        *_shown(path, size),
    )
    return Found(facts, f"{path} is one image: give the folder of all images of the place")


def _shown(path: Path, size: tuple[int, int]) -> Facts:
    """Layout of one image, and its image circles."""
    width, height = size
    grey = decode(path, size, gray=True)
    if height == 2 * width and two_circles([one_beside_other(grey)], path)[0]:
        halves = grey[:width], grey[width:]
        return (
            ("layout", "raw, two fisheyes one above the other"),
            *_circles(halves, "upper", "lower"),
        )
    found = recognise([grey], size, path).lens_size
    if found is not None:
        return (
            ("layout", "raw, two fisheyes side by side"),
            *_circles(cut(grey, found), "left", "right"),
        )
    if width == 2 * height:
        kind = unlike_panorama([grey])
        return (("layout", kind or "stitched panorama"),)
    circle = find_circle([grey]).circle if max(size) <= 1.1 * min(size) else None
    if circle is None:
        return (("layout", "no panorama (2:1), and no image circles are found"),)
    return (("layout", "raw, one fisheye"), *_circles([grey], "lens"))


def _circles(lenses: Sequence[np.ndarray], *names: str) -> Facts:
    """Image circle of each lens's picture (h, w) uint8."""
    facts = []
    for name, picture in zip(names, lenses, strict=True):
        circle = find_circle([picture]).circle
        text = "not found"
        if circle is not None:
            text = f"radius {circle.radius:.0f} px around ({circle.x:.0f}, {circle.y:.0f})"
        facts.append((f"{name} circle", text))
    return tuple(facts)


def _about(frames: FrameSet) -> Facts:
    """Layout, number, times and lenses."""
    first = frames.paths[0][0]
    width, height = image_size(first)
    layout, num = _LAYOUTS[frames.format.layout], len(frames.format.fisheyes or ())
    layout = f"raw, {num} fisheyes a frame" if num > 2 else layout
    facts = [("layout", f"{layout}, files of {width}x{height}")]
    count = str(len(frames))
    if frames.timed:
        span = float(frames.timestamps[-1] - frames.timestamps[0])
        step = float(np.median(np.diff(frames.timestamps)))
        facts.append(("frames", f"{count}, one every {step:.3g} s, {spoken_seconds(span)}"))
    else:
        facts.append(("frames", f"{count}, in the order of their names: they have no times"))
    lenses = frames.format.fisheyes or ()
    titles = {"front": "front lens", "back": "back lens"}
    names = [titles.get(name, name) for name in lens_names(len(lenses))]
    for name, lens in zip(names, lenses, strict=True):
        x, y = lens.principal
        at = f"focal length {lens.focal:.1f} px, principal point ({x:.1f}, {y:.1f})"
        facts.append((name, f"{at} in {lens.width}x{lens.height}"))
    return tuple(facts)


def _tags(path: Path) -> ExifTags | None:
    try:
        return read_exif(path)
    except ValueError:  # damaged tags
        return None


def _camera(tags: list[ExifTags]) -> Facts:
    named = [tag.camera for tag in tags if tag.camera]
    return (("camera", max(set(named), key=named.count)),) if named else ()


def _positions(tags: list[ExifTags], num: int) -> Facts:
    located = sum(tag.gps is not None for tag in tags)
    return (("GPS", f"{located} of {num} frames have a position (--gps exif)"),) if located else ()
