"""Equirectangular masks: white = use."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsba.log import GsbaError
from gsba.read.corrected import straightened
from gsba.read.images import IMAGE_SUFFIXES, decode, image_size, is_image
from gsba.types import FrameSet


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
        GsbaError: a missing or unreadable mask, or one of another size.
    """
    if masks is None:
        return (None,) * len(names)
    if masks.is_dir():
        by_name = {_frame_name(path): path for path in sorted(masks.iterdir()) if is_image(path)}
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
    return tuple(path.absolute() for path in paths)


def load_mask(frames: FrameSet, f: int) -> np.ndarray | None:
    """ERP mask of frame f, (H, 2H) bool, True = use; None if the frame has none.

    Where the frames have a correction, it is applied.
    """
    path = frames.mask_paths[f]
    if path is None:
        return None
    size = (frames.width, frames.height) if frames.layout == "erp" else image_size(path)
    values = decode(path, size, gray=True)
    if values.max() == 1:
        raise GsbaError(f"{path}: mask holds 0 and 1; write 255 where pixels are to be used")
    usable = values > 127
    return straightened(usable, frames.correction) if frames.correction else usable


def _frame_name(path: Path) -> str:
    """`NAME` of `NAME.png` and of `NAME.jpg.png`."""
    inner = Path(path.stem)
    return inner.stem if inner.suffix.lower() in IMAGE_SUFFIXES else path.stem
