"""GPS positions in the EXIF data of images."""

import logging
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsba.config import GpsSettings
from gsba.frames.exif import GpsTag, read_exif
from gsba.log import GsbaError, track
from gsba.placement.gps import GpsFixes, fixes_of, sigmas_of
from gsba.types import FrameSet

_log = logging.getLogger(__name__)

MIN_FIXES = 3


def read_exif_gps(frames: FrameSet, settings: GpsSettings | None = None) -> GpsFixes:
    """Fixes of the frames whose images have GPS tags, by name.

    Frames without a valid fix are left out, and frames that repeat an earlier frame's fix (equal
    position and GPS timestamp). If at least three fixes have an altitude, fixes without one are
    left out, too; else unknown altitudes are 0.

    Raises:
        GsbaError: fewer than three frames have a fix, or an image cannot be read.
    """
    found: dict[str, GpsTag] = {}
    taken, damaged = set[tuple[float, float, float]](), 0
    for name, paths in zip(frames.names, track(frames.paths, "reading EXIF"), strict=True):
        tag, failed = _first_tag(paths)
        damaged += failed
        if tag is None:
            continue
        known = tag.latitude, tag.longitude, tag.unix_time
        if math.isnan(tag.unix_time) or known not in taken:
            found[name] = tag
        taken.add(known)
    if damaged:
        _log.warning("--gps exif: the EXIF data of %d images are damaged", damaged)
    if len(found) < MIN_FIXES:
        raise GsbaError(
            f"--gps exif: {len(found)} of {len(frames)} frames have GPS tags "
            f"('{frames.paths[0][0]}' is the first frame), and {MIN_FIXES} are needed: "
            "give positions as --gps FILE, CSV or GPX"
        )
    tags, settings = list(found.values()), settings or GpsSettings()
    geodetic = np.array([[tag.latitude, tag.longitude, tag.altitude] for tag in tags])
    dop, error = (np.array([getattr(tag, key) for tag in tags]) for key in ("dop", "error_m"))
    fixes = fixes_of(list(found), geodetic, sigmas_of(settings, dop, error_m=error), settings)
    _log.info("--gps exif: %d of %d frames have a position", len(fixes.geodetic), len(frames))
    return fixes


def _first_tag(paths: Sequence[Path]) -> tuple[GpsTag | None, int]:
    """Position of the first image of a frame that has one, and the number of damaged images."""
    damaged = 0
    for path in paths:
        try:
            tag = read_exif(path).gps
        except ValueError:
            damaged += 1
            continue
        if tag is not None:
            return tag, damaged
    return None, damaged
