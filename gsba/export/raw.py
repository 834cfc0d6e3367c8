"""Raw fisheyes of an export, as they are, with masks of what their circles hold."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from gsba.camera.fisheye import Pair, rotation_of, unproject
from gsba.camera.sphere import erp_from_bearings
from gsba.disk import write_image
from gsba.export.images import of_all_frames, pass_on
from gsba.frames.dual_fisheye import load_raw
from gsba.frames.files import goes_out_as_it_is
from gsba.frames.masks import load_mask
from gsba.log import GsbaError
from gsba.types import Fisheye, FrameSet

LENSES = ("front", "back")
SEEN_DEG = 95.0  # from a lens's axis: further out, circles end and calibrations with them


def raw_lenses(frames: FrameSet) -> Pair:
    """The lenses of raw pairs.

    Raises:
        GsbaError: the frames are none.
    """
    if frames.fisheyes is None:
        raise GsbaError("--images fisheye is for runs on raw fisheyes: these frames are stitched")
    return frames.fisheyes


def write_raw(
    frames: FrameSet,
    image_path: Callable[[int, int], Path],
    mask_path: Callable[[int, int], Path],
    link: bool = False,
    seen_deg: float = SEEN_DEG,
) -> None:
    """Copy both pictures of every frame, and write masks of where they show something.

    Pictures side by side in one image, and those that trainers misread, are written anew.

    Args:
        frames: raw pairs.
        image_path: file of the image, by frame index and lens.
        mask_path: file of the mask (PNG, 0 = ignore, 255 = use).
        link: hard links instead of copies.
        seen_deg: from a lens's axis, beyond which masks leave its picture out.
    """
    shown = [_shown(lens, seen_deg) for lens in raw_lenses(frames)]

    def write(f: int) -> None:
        mask, sources = load_mask(frames, f), frames.paths[f]
        paths = [image_path(f, lens) for lens in range(len(sources))]
        if sources[0] != sources[1] and all(map(goes_out_as_it_is, sources, paths)):
            for source, path in zip(sources, paths, strict=True):
                pass_on(source, path, link)
        else:
            for path, picture in zip(paths, load_raw(frames, f), strict=True):
                write_image(path, picture)
        for lens, (seen, directions) in enumerate(shown):
            used = seen if mask is None else seen & _at(mask, directions)
            write_image(mask_path(f, lens), used.astype(np.uint8) * 255)

    of_all_frames(write, len(frames))


def _shown(lens: Fisheye, seen_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Where a lens's picture is to be used, (h, w) bool, and in which directions, (h, w, 3)."""
    pixels = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    directions = unproject(lens, np.stack(pixels, axis=-1))
    ahead = directions @ rotation_of(lens)[:, 2]
    return ahead > np.cos(np.deg2rad(seen_deg)), directions.astype(np.float32)


def _at(mask: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """A panorama's mask (H, 2 H) bool in directions (h, w, 3)."""
    height, width = mask.shape
    places = np.minimum(erp_from_bearings(directions, width, height), (width - 1, height - 1))
    columns, rows = np.moveaxis(places, -1, 0).astype(int)
    return mask[rows, columns]
