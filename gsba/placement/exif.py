"""Positions that cameras write into pictures: the GPS directory of EXIF, in JPEG and PNG."""

import logging
import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsba.log import GsbaError, track
from gsba.placement.gps import GpsFixes
from gsba.types import FrameSet

_log = logging.getLogger(__name__)

MIN_FIXES = 3
_GPS_DIRECTORY = 0x8825  # its tags: Exif 3.0 (CIPA DC-008), section 4.6
_LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE, _ALTITUDE_REF, _ALTITUDE = range(1, 7)
_STATUS = 9


def read_exif_gps(frames: FrameSet) -> GpsFixes:
    """Fixes of the frames whose pictures have GPS tags, by name.

    A frame without a valid fix is passed over. Where at least three have an altitude, frames
    without are passed over too; else unknown altitudes are 0.

    Raises:
        GsbaError: fewer than three frames have one, or a picture cannot be read.
    """
    found: dict[str, tuple[float, float, float]] = {}
    damaged = 0
    for name, paths in zip(frames.names, track(frames.paths, "reading EXIF"), strict=True):
        for path in paths:
            try:
                fix = gps_of(path)
            except ValueError:
                damaged += 1
                continue
            if fix is not None:
                found[name] = fix
                break
    if damaged:
        _log.warning("--gps exif: the EXIF data of %d pictures are damaged", damaged)
    if len(found) < MIN_FIXES:
        raise GsbaError(
            f"--gps exif: {len(found)} of {len(frames)} frames have GPS tags "
            f"('{frames.paths[0][0]}' is the first frame), and {MIN_FIXES} are needed: "
            "give positions as --gps FILE, CSV or GPX"
        )
    geodetic = np.array(list(found.values()))
    high = np.isfinite(geodetic[:, 2])
    enough = high if high.sum() >= MIN_FIXES else np.ones(len(found), bool)
    if enough is not high:
        geodetic[:, 2] = np.nan_to_num(geodetic[:, 2])
    geodetic[:, 1] = np.unwrap(geodetic[:, 1], period=360)  # the date line is no jump
    names = [name for name, use in zip(found, enough, strict=True) if use]
    _log.info("--gps exif: %d of %d frames have a position", len(names), len(frames))
    return GpsFixes(tuple(names), None, geodetic[enough])


def gps_of(path: Path) -> tuple[float, float, float] | None:
    """Latitude and longitude (degrees) and altitude (metres, NaN = unknown) of a picture.

    None where it has none, or the receiver says that it had lost the satellites.

    Raises:
        ValueError: EXIF data that are damaged.
        GsbaError: the file cannot be read.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)  # which is how Pillow reports damage
            with Image.open(path) as picture:  # reads no pixels
                gps = picture.getexif().get_ifd(_GPS_DIRECTORY)
    except UnidentifiedImageError:
        raise GsbaError(f"{path}: is no picture that can be read") from None
    except OSError as error:
        raise GsbaError(f"{path}: cannot be read ({error.strerror or error})") from None
    except Exception:  # of the parser, each in its own words
        raise ValueError(f"{path}: damaged EXIF data") from None
    try:
        return _fix(gps)
    except (TypeError, IndexError, AttributeError):
        raise ValueError(f"{path}: damaged EXIF data") from None


def _fix(gps: Mapping[int, Any]) -> tuple[float, float, float] | None:
    """What the GPS directory says, if it is valid."""
    if not {_LATITUDE, _LONGITUDE} <= gps.keys() or _letter(gps, _STATUS) == "V":
        return None
    latitude, longitude = _degrees(gps[_LATITUDE]), _degrees(gps[_LONGITUDE])
    latitude *= -1 if _letter(gps, _LATITUDE_REF) == "S" else 1
    longitude *= -1 if _letter(gps, _LONGITUDE_REF) == "W" else 1
    valid = math.isfinite(latitude + longitude) and abs(latitude) <= 90 and abs(longitude) <= 180
    if not valid or latitude == longitude == 0:  # what cameras write before the first fix
        return None
    altitude = float(gps.get(_ALTITUDE, math.nan))
    below = gps.get(_ALTITUDE_REF) in (1, b"\x01")
    return latitude, longitude, -altitude if below else altitude


def _degrees(parts: Sequence[Any]) -> float:
    """Degrees of (degrees, minutes, seconds); a later part may be absent or 0/0."""
    values = [float(part) for part in parts]
    values[1:] = [value if math.isfinite(value) else 0.0 for value in values[1:]]
    return sum(value / 60**k for k, value in enumerate(values[:3]))


def _letter(gps: Mapping[int, Any], tag: int) -> str:
    return str(gps.get(tag, "")).strip("\0 ").upper()
