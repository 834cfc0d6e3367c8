"""Positions that cameras write into pictures: the GPS directory of EXIF, in JPEG and PNG.

Exif 3.0 (CIPA DC-008), section 4.6: a TIFF structure in the APP1 segment of a JPEG, in the eXIf
chunk of a PNG. Only what positions need is read.
"""

import logging
import math
import struct
from pathlib import Path
from typing import BinaryIO

import numpy as np

from gsba.log import GsbaError, track
from gsba.read.gps import GpsFixes
from gsba.types import FrameSet

_log = logging.getLogger(__name__)

MIN_FIXES = 3
_GPS_DIRECTORY = 0x8825
_LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE, _ALTITUDE_REF, _ALTITUDE = range(1, 7)
_STATUS = 9
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 7: 1, 9: 4, 10: 8}  # bytes of a value by TIFF type
_MAX_ENTRIES = 512  # of a directory: more is damage
_PNG = b"\x89PNG\r\n\x1a\n"


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
    try:
        with path.open("rb") as file:
            tiff = _tiff_of(file)
    except OSError as error:
        raise GsbaError(f"{path}: cannot be read ({error.strerror})") from None
    if tiff is None:
        return None
    try:
        return _fix(_Tiff(tiff))
    except (struct.error, IndexError, KeyError, UnicodeDecodeError):
        raise ValueError(f"{path}: damaged EXIF data") from None


def _tiff_of(file: BinaryIO) -> bytes | None:
    """The TIFF structure in a JPEG or PNG, if there is one."""
    start = file.read(8)
    if start == _PNG:
        while len(head := file.read(8)) == 8:
            length, kind = struct.unpack(">I4s", head)
            if kind == b"eXIf":
                return file.read(length)
            file.seek(length + 4, 1)
        return None
    if not start.startswith(b"\xff\xd8"):
        return None
    file.seek(2)
    while len(head := file.read(4)) == 4 and head[0] == 0xFF:
        if head[1] == 0xFF:  # a fill byte
            file.seek(-3, 1)
            continue
        if head[1] in (0xDA, 0xD9):  # pixels begin
            return None
        length = int.from_bytes(head[2:], "big") - 2
        if head[1] == 0xE1:
            data = file.read(length)
            if data.startswith(b"Exif\0\0"):
                return data[6:]
        else:
            file.seek(max(length, 0), 1)
    return None


class _Tiff:
    """Directories of a TIFF structure."""

    def __init__(self, data: bytes) -> None:
        orders = {b"II": "<", b"MM": ">"}
        self.data, self.order = data, orders[data[:2]]
        magic, self.first = struct.unpack_from(self.order + "HI", data, 2)
        if magic != 42:
            raise KeyError(magic)

    def directory(self, offset: int) -> dict[int, tuple]:
        """Values of a directory by tag: numbers, (numerator, denominator) pairs or bytes."""
        (num,) = struct.unpack_from(self.order + "H", self.data, offset)
        if num > _MAX_ENTRIES:
            raise IndexError(num)
        found = {}
        for entry in range(num):
            at = offset + 2 + 12 * entry
            tag, kind, count = struct.unpack_from(self.order + "HHI", self.data, at)
            if kind in _SIZES and count <= len(self.data):
                found[tag] = self._values(kind, count, at + 8)
        return found

    def _values(self, kind: int, count: int, at: int) -> tuple:
        """Values in the entry itself, or where it points if they are longer than four bytes."""
        if _SIZES[kind] * count > 4:
            (at,) = struct.unpack_from(self.order + "I", self.data, at)
        if kind in (5, 10):
            letters = "I" if kind == 5 else "i"
            flat = struct.unpack_from(f"{self.order}{2 * count}{letters}", self.data, at)
            return tuple(zip(flat[::2], flat[1::2], strict=True))
        letters = {1: "B", 2: "c", 3: "H", 4: "I", 7: "c", 9: "i"}[kind]
        return struct.unpack_from(f"{self.order}{count}{letters}", self.data, at)


def _fix(tiff: _Tiff) -> tuple[float, float, float] | None:
    """What the GPS directory says, if it is valid."""
    main = tiff.directory(tiff.first)
    if _GPS_DIRECTORY not in main:
        return None
    gps = tiff.directory(main[_GPS_DIRECTORY][0])
    if not {_LATITUDE, _LONGITUDE} <= gps.keys() or _letter(gps, _STATUS) == "V":
        return None
    latitude, longitude = _degrees(gps[_LATITUDE]), _degrees(gps[_LONGITUDE])
    latitude *= -1 if _letter(gps, _LATITUDE_REF) == "S" else 1
    longitude *= -1 if _letter(gps, _LONGITUDE_REF) == "W" else 1
    valid = math.isfinite(latitude + longitude) and abs(latitude) <= 90 and abs(longitude) <= 180
    if not valid or latitude == longitude == 0:  # what cameras write before the first fix
        return None
    altitude = _ratio(gps[_ALTITUDE][0]) if _ALTITUDE in gps else math.nan
    below = gps.get(_ALTITUDE_REF, (0,))[0] in (1, b"\x01")
    return latitude, longitude, -altitude if below else altitude


def _degrees(parts: tuple) -> float:
    """Degrees of (degrees, minutes, seconds); a later part may be absent or 0/0."""
    values = [_ratio(part) for part in parts]
    values[1:] = [value if math.isfinite(value) else 0.0 for value in values[1:]]
    return sum(value / 60**k for k, value in enumerate(values[:3]))


def _ratio(part: tuple[int, int]) -> float:
    return part[0] / part[1] if part[1] else math.nan


def _letter(gps: dict[int, tuple], tag: int) -> str:
    return gps.get(tag, (b"",))[0].decode("ascii").upper()
