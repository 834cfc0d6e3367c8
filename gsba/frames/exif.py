"""EXIF tags of pictures: when, where and by which camera they were taken. Read by Pillow, without
pixels."""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone
from enum import IntEnum
from pathlib import Path
from typing import Any

from gsba.log import GsbaError


class _Tag(IntEnum):
    """Tags of Exif 3.0 (CIPA DC-008), section 4.6.5."""

    MAKE, MODEL = 0x010F, 0x0110
    EXIF_DIRECTORY, GPS_DIRECTORY = 0x8769, 0x8825
    TAKEN, OFFSET, SUBSECOND = 0x9003, 0x9011, 0x9291
    FOCAL_35MM, LENS = 0xA405, 0xA434


class _PositionTag(IntEnum):
    """Tags of the GPS directory, section 4.6.6."""

    LATITUDE_REF, LATITUDE, LONGITUDE_REF, LONGITUDE, ALTITUDE_REF, ALTITUDE = range(1, 7)
    TIME, STATUS, DOP, DATE, ERROR = 7, 9, 11, 29, 31


@dataclass(frozen=True, slots=True)
class GpsTag:
    """The position in the GPS directory of a picture."""

    latitude: float  # degrees
    longitude: float  # degrees
    altitude: float  # metres; NaN = not given
    dop: float  # dilution of precision; NaN = not given
    error_m: float  # horizontal accuracy, metres, by the receiver; NaN = not given
    unix_time: float  # seconds, when the fix was taken; NaN = not given


@dataclass(frozen=True, slots=True)
class ExifTags:
    """Time and place of a picture, as far as its tags give them."""

    taken: float | None  # seconds since 1970, local time unless `zoned`; None = not given
    zoned: bool  # True if the tags name the time zone, so that `taken` is Unix time
    subsecond: bool  # True if `taken` has a fraction of a second
    gps: GpsTag | None  # None = no valid position
    camera: str = ""  # maker and model; "" = not given
    focal_35mm: float = math.nan  # focal length in millimetres of a camera with 35 mm film and the
    # same diagonal field of view; NaN = not given
    lens: str = ""  # model of the lens; "" = not given


def read_exif(path: Path) -> ExifTags:
    """Tags of a JPEG, PNG, WebP or TIFF picture.

    Raises:
        ValueError: the EXIF data are damaged.
        GsbaError: the file cannot be read.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)  # Pillow reports damage as warnings
            with Image.open(path) as picture:  # reads no pixels
                exif = picture.getexif()
                shot, gps = exif.get_ifd(_Tag.EXIF_DIRECTORY), exif.get_ifd(_Tag.GPS_DIRECTORY)
    except UnidentifiedImageError:
        raise GsbaError(f"{path}: cannot be read as a picture") from None
    except OSError as error:
        raise GsbaError(f"{path}: cannot be read ({error.strerror or error})") from None
    except Exception:  # the parser raises errors of many types
        raise ValueError(f"{path}: damaged EXIF data") from None
    try:
        named = [text for text in (_text(exif, _Tag.MAKE), _text(exif, _Tag.MODEL)) if text]
        focal = _number(shot, _Tag.FOCAL_35MM)
        lens = _text(shot, _Tag.LENS)
        return ExifTags(*_taken(shot), _gps_tag(gps), " ".join(named), focal, lens)
    except (TypeError, IndexError, AttributeError, ZeroDivisionError):
        raise ValueError(f"{path}: damaged EXIF data") from None


def _taken(tags: Mapping[int, Any]) -> tuple[float | None, bool, bool]:
    """Time of DateTimeOriginal with its fraction; whether zone and fraction are given."""
    try:
        moment = datetime.strptime(_text(tags, _Tag.TAKEN), "%Y:%m:%d %H:%M:%S")
    except ValueError:  # absent, or blank as written by cameras without a clock
        return None, False, False
    zone = _zone(_text(tags, _Tag.OFFSET))
    digits = _text(tags, _Tag.SUBSECOND)
    fraction = float(f"0.{digits}") if digits.isascii() and digits.isdigit() else None
    whole = moment.replace(tzinfo=zone or UTC).timestamp()
    return whole + (fraction or 0.0), zone is not None, fraction is not None


def _zone(text: str) -> timezone | None:
    """Time zone of "+02:00"; None = not given."""
    try:
        offset = datetime.strptime(text, "%z").utcoffset()
    except ValueError:
        return None
    return None if offset is None or abs(offset) > timedelta(hours=14) else timezone(offset)


def _gps_tag(gps: Mapping[int, Any]) -> GpsTag | None:
    """The position of a GPS directory, if it is valid."""
    if (
        not {_PositionTag.LATITUDE, _PositionTag.LONGITUDE} <= gps.keys()
        or _text(gps, _PositionTag.STATUS).upper() == "V"
    ):
        return None
    latitude, longitude = (
        _sexagesimal(gps[_PositionTag.LATITUDE]),
        _sexagesimal(gps[_PositionTag.LONGITUDE]),
    )
    latitude *= -1 if _text(gps, _PositionTag.LATITUDE_REF).upper() == "S" else 1
    longitude *= -1 if _text(gps, _PositionTag.LONGITUDE_REF).upper() == "W" else 1
    valid = math.isfinite(latitude + longitude) and abs(latitude) <= 90 and abs(longitude) <= 180
    if not valid or latitude == longitude == 0:  # cameras write zeros before the first fix
        return None
    altitude = _number(gps, _PositionTag.ALTITUDE, -math.inf)
    below = gps.get(_PositionTag.ALTITUDE_REF) in (1, b"\x01")
    unix_time = math.nan
    try:
        day = datetime.strptime(_text(gps, _PositionTag.DATE), "%Y:%m:%d").replace(tzinfo=UTC)
        unix_time = day.timestamp() + 3600 * _sexagesimal(gps[_PositionTag.TIME])
    except (ValueError, KeyError):
        pass
    return GpsTag(
        latitude,
        longitude,
        -altitude if below else altitude,
        _number(gps, _PositionTag.DOP),
        _number(gps, _PositionTag.ERROR),
        unix_time,
    )


def _number(tags: Mapping[int, Any], tag: int, low: float = 0.0) -> float:
    """A finite number above `low`; NaN = not given, or unknown, which 0/0 and 0 stand for."""
    value = float(tags.get(tag, math.nan))
    return value if math.isfinite(value) and value > low else math.nan


def _sexagesimal(parts: Sequence[Any]) -> float:
    """Value in the first unit of (degrees or hours, minutes, seconds); later parts may be 0/0."""
    values = [float(part) for part in parts]
    values[1:] = [value if math.isfinite(value) else 0.0 for value in values[1:]]
    return sum(value / 60**k for k, value in enumerate(values[:3]))


def _text(tags: Mapping[int, Any], tag: int) -> str:
    value = tags.get(tag, "")
    if isinstance(value, bytes):
        value = value.decode("ascii", "replace")
    return str(value).strip("\0 ")
