"""Faces of one lens each, cut from frames of any layout."""

import numpy as np

from gsba.camera.views import ViewCutter
from gsba.frames.dual_fisheye import load_raw
from gsba.frames.pixels import load_erp
from gsba.frames.track_pairs import load_squares
from gsba.types import FrameSet


def cut(frames: FrameSet, f: int, cutter: ViewCutter) -> list[np.ndarray]:
    """Images (height, width, 3) uint8 RGB of each view of frame f.

    Args:
        frames: panoramas; raw pairs and equi-angular cube maps are cut in one step.
        cutter: the cutter for that frame.
    """
    kind = frames.format_of(f)
    if kind.fisheyes is not None:
        return list(cutter.cut_raw(load_raw(frames, f)))
    if kind.tracks is not None:
        return list(cutter.cut_squares(load_squares(frames, f), kind.correction))
    return cutter.cut(load_erp(frames, f))
