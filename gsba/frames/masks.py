"""Equirectangular masks: white = use, black = do not use, light grey = use with less weight."""

import functools
import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsba.camera.straighten import straightened
from gsba.frames.dual_fisheye import clear_of_seam
from gsba.frames.files import decode, image_size, is_image
from gsba.frames.times import stem_of
from gsba.log import GsbaError
from gsba.types import FrameSet

logger = logging.getLogger(__name__)

_MAX_UNUSED_LEVEL = 127  # highest grey level of unused pixels


def find_masks(
    masks: Path | None, names: Sequence[str], erp_size: tuple[int, int] | None
) -> tuple[Path | None, ...]:
    """Mask file of each frame.

    Args:
        masks: one image for all frames, or a folder with `NAME.png` or `NAME.jpg.png` for each.
        names: (F,) frame names without extension.
        erp_size: width and height that masks must have; None (cube frames) = any, as long as 2:1.

    Returns:
        (F,) paths, all None without masks.

    Raises:
        GsbaError: a mask is missing, unreadable or of another size.
    """
    if masks is None:
        return (None,) * len(names)
    if masks.is_dir():
        by_name = {stem_of(path.stem): path for path in sorted(masks.iterdir()) if is_image(path)}
        missing = [name for name in names if name not in by_name]
        if missing:
            raise GsbaError(
                f"{masks}: no mask for frame '{missing[0]}' ({len(missing)} of {len(names)} "
                "missing); a mask folder holds NAME.png for every frame"
            )
        paths = tuple(by_name[name] for name in names)
    else:
        paths = (masks,) * len(names)
    for path in dict.fromkeys(paths):
        w, h = image_size(path)
        if erp_size and (w, h) != erp_size:
            raise GsbaError(f"{path}: mask is {w}x{h}, but frames are {erp_size[0]}x{erp_size[1]}")
        if w != 2 * h:
            raise GsbaError(f"{path}: mask is {w}x{h}; masks are equirectangular, 2:1")
    if masks.is_file():
        size = image_size(masks)
        rows = (np.arange(size[1]) + 0.5) / size[1]
        levels = _levels_in(masks, size, masks.stat().st_mtime_ns)
        unused = (levels <= _MAX_UNUSED_LEVEL).mean(axis=1)
        hidden = float(np.average(unused, weights=np.sin(np.pi * rows)))
        if hidden == 1:
            raise GsbaError(f"{masks}: the mask hides all of each picture: 255 = use, 0 = ignore")
        if hidden > 0.6:  # of the sphere: carriers and their riders hide up to half
            logger.warning(
                "%s hides %.0f %% of each picture (255 = use, 0 = ignore): invert it if it is to "
                "hide the rest",
                masks,
                100 * hidden,
            )
    return tuple(path.absolute() for path in paths)


def load_mask(frames: FrameSet, f: int) -> np.ndarray | None:
    """ERP mask of frame f, (H, 2H) bool, True = use; None if the frame has none.

    Where the frames have a correction, it is applied.
    """
    kind = frames.format_of(f)
    levels = _load_levels(frames, f)
    if levels is None:
        return None
    usable = levels > _MAX_UNUSED_LEVEL
    return straightened(usable, kind.correction) if kind.correction else usable


def load_usable(frames: FrameSet, f: int) -> np.ndarray | None:
    """Mask like that of `load_mask`, without the seams between raw lenses."""
    kind = frames.format_of(f)
    mask = load_mask(frames, f)
    if kind.fisheyes is None:
        return mask
    clear = clear_of_seam(kind.height, kind.fisheyes)
    return clear if mask is None else mask & clear


def load_weights(frames: FrameSet, f: int) -> np.ndarray | None:
    """Weights (H, 2H) float32 of the pixels of frame f, 0..1; None if the frame has no mask.

    0 is where `load_mask` is False; above, they grow with the grey level to 1 at white.
    """
    kind = frames.format_of(f)
    levels = _load_levels(frames, f)
    if levels is None:
        return None
    usable = levels > _MAX_UNUSED_LEVEL
    if kind.correction:
        usable, levels = (straightened(image, kind.correction) for image in (usable, levels))
    above = np.maximum(levels, _MAX_UNUSED_LEVEL + 1) - np.float32(_MAX_UNUSED_LEVEL)
    return np.where(usable, above / (255 - _MAX_UNUSED_LEVEL), 0).astype(np.float32)


def levels_of(weights: np.ndarray) -> np.ndarray:
    """Grey levels (H, 2H) uint8 of a mask file with these weights (H, 2H) 0..1, or bool."""
    above = np.maximum(np.rint((255 - _MAX_UNUSED_LEVEL) * weights.astype(np.float32)), 1)
    return np.where(weights > 0, _MAX_UNUSED_LEVEL + above, 0).astype(np.uint8)


def _load_levels(frames: FrameSet, f: int) -> np.ndarray | None:
    """Grey levels (H, 2H) uint8 of the mask file."""
    kind = frames.format_of(f)
    path = frames.mask_paths[f]
    if path is None:
        return None
    size = (kind.width, kind.height) if kind.panoramic else image_size(path)
    written = path.stat().st_mtime_ns if path.exists() else None
    return _levels_in(path, size, written)


@functools.lru_cache(maxsize=1)
def _levels_in(path: Path, size: tuple[int, int], written: int | None) -> np.ndarray:
    """Grey levels of a file written at that time: a mask shared by all frames is decoded once."""
    values = decode(path, size, gray=True)
    if values.max() == 1:
        raise GsbaError(f"{path}: mask holds 0 and 1; write 255 for pixels to be used")
    values.setflags(write=False)
    return values
