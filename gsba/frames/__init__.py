"""Captured frames on disk: found, timed, and read as panoramas or faces.

Takes a folder of panoramas, raw fisheyes, tracks of a cube map or cube faces, times and masks.
Gives a `FrameSet`, and loads its pixels and masks on demand.
"""

from gsba.frames.cubemap import cut, native_rig, rig_for
from gsba.frames.masks import levels_of, load_mask, load_weights
from gsba.frames.panorama import Greys, load_grey
from gsba.frames.pixels import load_erp, load_faces
from gsba.frames.scan import scan
from gsba.frames.times import check_fps

__all__ = [
    "Greys",
    "check_fps",
    "cut",
    "levels_of",
    "load_erp",
    "load_faces",
    "load_grey",
    "load_mask",
    "load_weights",
    "native_rig",
    "rig_for",
    "scan",
]
