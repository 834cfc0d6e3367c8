"""Trailer that Insta360 cameras append to their videos (`.insv`) and images (`.insp`).

From the end of the file, little-endian: 32 bytes of signature, before them the size of the trailer
and its version (u32 each), before these 32 bytes of unknown meaning. Records lie before that, each
followed by its format (u8), number (u8) and size (u32), or are listed in a directory, record 0.
Layout, fields and units follow OpenSpeleo/insta360-rs, docs/INSV_FORMAT.md, AdrianEddy's
telemetry-parser, src/insta360, and Insta360's SDK (rad/s and g); tested on a real file of a ONE R.
"""

import os
import struct
from collections.abc import Container, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from gsba.containers.protobuf import read_message
from gsba.log import GsbaError

_SIGNATURE = b"8db42d694ccc418790edff439fe026bf"
_HEADER = struct.Struct("<32xII32s")  # size of the trailer with this header, version, signature
_FOOTER = struct.Struct("<BBI")  # format, number, size of the record before it
_ENTRY = struct.Struct("<BBII")  # of the directory: number, format, size, start in the trailer
_VERSION = 3
_MAX_RECORDS = 256
_MAX_METADATA_BYTES = 8 << 20
_MAX_RECORD_BYTES = 1 << 29  # seven hours of a gyro at 1 kHz


class _Record(IntEnum):
    """Numbers of records."""

    DIRECTORY, METADATA, GYRO, EXPOSURES, GPS, BACK_EXPOSURES = 0, 1, 3, 4, 7, 12


class _Field(IntEnum):
    """Fields of the metadata."""

    MODEL, FIRMWARE, CREATED = 2, 3, 7
    FIRST_FRAME, READOUT_MS, WINDOW, GYRO_DELAY_MS = 24, 25, 27, 28
    RAW_GYRO, GYRO_RANGES, TRACK_ORDER = 62, 65, 80


_LENSES = 111, 54, 53, 5, 112, 56, 55, 17  # best first: current ones, then factory ones

_RAW = np.dtype([("time", "<i8"), ("values", "<u2", 6)])  # microseconds; 32768 is zero
_SCALED = np.dtype([("time", "<i8"), ("values", "<f8", 6)])  # milliseconds; g, rad/s
_SHUTTER = np.dtype([("time", "<i8"), ("duration", "<f8")])  # ticks of the gyro's clock; seconds
_FIX = np.dtype(
    [
        *(("seconds", "<i8"), ("milliseconds", "<u2"), ("state", "S1")),
        *(("latitude", "<f8"), ("north", "S1"), ("longitude", "<f8"), ("east", "S1")),
        *(("speed", "<f8"), ("course", "<f8"), ("altitude", "<f8")),
    ]
)
_RAW_ZERO, _RAW_FULL = 32768, 32768  # raw value of zero; difference of the end of the range
STANDARD_GRAVITY = 9.80665
_MIN_RATE_HZ, _MAX_RATE_HZ = 10.0, 20_000.0  # of gyro readings
_MAX_TICK = 1 << 53  # of the camera's clock: exact as float64
_YEAR_2100 = 4_102_444_800  # s since 1970: a larger creation time is in milliseconds


@dataclass(frozen=True, slots=True)
class GyroRecord:
    """Uncorrected readings of a gyro and an accelerometer in the axes of their chip.

    They contain the bias, and the chip's orientation in the camera is unknown.
    """

    times: np.ndarray  # (N,) float64, s on the clock of `Insta360Trailer`, strictly increasing
    rates: np.ndarray  # (N, 3) float64, rad/s
    accelerations: np.ndarray  # (N, 3) float64, m/s^2, about 9.8 long at rest


@dataclass(frozen=True, slots=True)
class ExposureRecord:
    """Exposure times of one lens's frames; the sensor's gain is not recorded."""

    times: np.ndarray  # (N,) float64, s on the clock of `Insta360Trailer`
    durations: np.ndarray  # (N,) float64, s


@dataclass(frozen=True, slots=True)
class GpsRecord:
    """Fixes of a GPS receiver that are marked as valid."""

    unix_times: np.ndarray  # (N,) float64, s since 1970, UTC
    latitudes: np.ndarray  # (N,) float64, degrees, north positive
    longitudes: np.ndarray  # (N,) float64, degrees, east positive
    altitudes: np.ndarray  # (N,) float64, m; the file does not state their reference surface


@dataclass(frozen=True, slots=True)
class SensorWindow:
    """Recorded part of one lens's sensor, which is scaled to the size of the images."""

    source: tuple[int, int]  # width and height of the sensor, pixels of the sensor
    size: tuple[int, int]  # width and height of the part, pixels of the sensor
    shift: tuple[int, int]  # from the sensor's middle to the part's middle, pixels right, down


@dataclass(frozen=True, slots=True)
class Insta360Trailer:
    """Metadata and sensor records that an Insta360 camera appended to a file.

    Times are seconds since the first frame if `has_frame_clock`, else since the first reading.
    """

    version: int  # of the trailer's layout
    model: str  # e.g. "Insta360 X4"; "" = not stated
    firmware: str  # "" = not stated
    lens_strings: tuple[str, ...]  # calibrations by the maker, best first; see gsba.camera
    window: SensorWindow | None  # None = not stated
    back_track_first: bool  # True = the first of two video tracks is the back lens's
    first_frame_s: float | None  # time of the first frame on the camera's clock, s; None = unknown
    created_unix_s: float | None  # s since 1970; None = not stated
    readout_s: float | None  # from the first row of a frame to its last; None = not stated
    gyro: GyroRecord | None  # None = none, or not read
    exposures: ExposureRecord | None  # of the front lens; None = none, or not read
    back_exposures: ExposureRecord | None  # of the back lens; None = none, or not read
    gps: GpsRecord | None  # None = none, or not read
    notes: tuple[str, ...]  # damaged and left-out parts, one line each

    @property
    def has_frame_clock(self) -> bool:
        """True if times count from the first frame."""
        return self.first_frame_s is not None


def read_trailer(path: Path, telemetry: bool = True) -> Insta360Trailer | None:
    """Trailer of an Insta360 camera's file; None = the file has none.

    Only the trailer is read. Damaged parts are left out, with a note.

    Args:
        path: video or image.
        telemetry: also read gyro, exposures and GPS; the metadata is always read.

    Raises:
        GsbaError: the file cannot be read, or no record of a trailer of the known version can.
    """
    try:
        with path.open("rb") as file:
            return _read(path, file, telemetry)
    except OSError as error:
        raise GsbaError(f"{path}: cannot be read ({error.strerror})") from None


@dataclass(slots=True)
class _Contents:
    """Records of a trailer that were read so far, and notes on damaged ones."""

    records: dict[int, bytes] = field(default_factory=dict)  # number -> content
    notes: list[str] = field(default_factory=list)


def _read(path: Path, file: BinaryIO, telemetry: bool) -> Insta360Trailer | None:
    length = file.seek(0, os.SEEK_END)
    if length < _HEADER.size:
        return None
    size, version, signature = _HEADER.unpack(_bytes_at(file, length - _HEADER.size, _HEADER.size))
    if signature != _SIGNATURE:
        return None
    if version != _VERSION:
        note = (
            f"the Insta360 trailer has version {version}, and only version {_VERSION} is known: "
            "its gyro, exposures, positions and lenses are not read"
        )
        return _trailer(version, _Contents(notes=[note]))
    contents, start = _Contents(), length - size
    if not _HEADER.size <= size <= length:
        start = 0
        contents.notes.append(
            f"damaged: the trailer claims {size:,} of the file's {length:,} bytes"
        )
    wanted = {_Record.METADATA}
    if telemetry:
        wanted |= {_Record.GYRO, _Record.EXPOSURES, _Record.GPS, _Record.BACK_EXPOSURES}
    _find_records(file, start, length - _HEADER.size, wanted, contents)
    if not contents.records:
        raise GsbaError(f"{path}: its Insta360 trailer is damaged: no record can be read")
    return _trailer(version, contents)


def _bytes_at(file: BinaryIO, start: int, count: int) -> bytes:
    """Exactly `count` bytes of a file from offset `start`."""
    file.seek(start)
    found = file.read(count)
    if len(found) != count:
        raise OSError(0, "the file became shorter while it was read")
    return found


def _find_records(
    file: BinaryIO, start: int, end: int, wanted: Container[int], contents: _Contents
) -> None:
    """Read wanted records backwards from the end, or at the offsets of a directory."""
    at = end
    for _ in range(_MAX_RECORDS):
        if at <= start:
            return
        if at - start < _FOOTER.size:
            break
        form, number, size = _FOOTER.unpack(_bytes_at(file, at - _FOOTER.size, _FOOTER.size))
        first = at - _FOOTER.size - size
        if first < start or form > 2:
            break
        binary = form == 0  # 1 = protobuf
        is_directory = binary and number == _Record.DIRECTORY and size and not size % _ENTRY.size
        if is_directory and _read_listed(file, start, first, size, wanted, contents):
            return  # such files have gaps between records, which cannot be read backwards
        if number in wanted:
            _add(file, first, size, number, contents)
        at = first
    contents.notes.append(f"damaged: {at - start:,} bytes of the trailer cannot be read")


def _read_listed(
    file: BinaryIO, start: int, at: int, size: int, wanted: Container[int], contents: _Contents
) -> bool:
    """Read records that a directory of `size` bytes at offset `at` lists; True if all are valid."""
    before = len(contents.notes)
    listed = _bytes_at(file, at, min(size, _MAX_RECORDS * _ENTRY.size))
    for number, form, count, offset in _ENTRY.iter_unpack(listed):
        first = start + offset
        if number not in wanted:
            continue
        if first + count + _FOOTER.size > at:
            contents.notes.append(f"damaged: record {number} would lie outside of the trailer")
            continue
        if _FOOTER.unpack(_bytes_at(file, first + count, _FOOTER.size)) != (form, number, count):
            contents.notes.append(f"damaged: record {number} is not where the directory has it")
            continue
        _add(file, first, count, number, contents)
    return len(contents.notes) == before


def _add(file: BinaryIO, start: int, size: int, number: int, contents: _Contents) -> None:
    """Read a record, unless one with this number was read before."""
    if number in contents.records or not size:
        return
    if size > (_MAX_METADATA_BYTES if number == _Record.METADATA else _MAX_RECORD_BYTES):
        contents.notes.append(f"damaged: record {number} claims {size:,} bytes")
        return
    contents.records[number] = _bytes_at(file, start, size)


def _trailer(version: int, contents: _Contents) -> Insta360Trailer:
    """Trailer from its records."""
    records, notes = contents.records, contents.notes
    values, whole = read_message(records.get(_Record.METADATA, b""))
    if not whole:
        notes.append("damaged: the end of the metadata cannot be read")
    found = values.get(_Field.RAW_GYRO)
    raw = bool(found) if isinstance(found, int) else None
    found = _gyro(records.get(_Record.GYRO, b""), raw, values, notes)
    scaled_ms = raw is False if found is None else found.milliseconds
    tick_s = 1e-3 if scaled_ms else 1e-6
    start = first_frame = values.get(_Field.FIRST_FRAME)
    if not isinstance(first_frame, int) or not 0 <= first_frame < _MAX_TICK:
        start = first_frame = None
    delay_s = 1e-3 * (_real(values, _Field.GYRO_DELAY_MS) or 0.0)
    if start is None and found is not None:
        start, delay_s = found.ticks[0], 0.0
    readout_ms = _real(values, _Field.READOUT_MS)
    gyro = None
    if found is not None and start is not None:
        times = (found.ticks - start) * tick_s - delay_s
        gyro = GyroRecord(times, found.rates, found.accelerations)
    return Insta360Trailer(
        version=version,
        model=_text(values, _Field.MODEL),
        firmware=_text(values, _Field.FIRMWARE),
        lens_strings=tuple(text for key in _LENSES if (text := _text(values, key, 4096))),
        window=_window(values),
        back_track_first=values.get(_Field.TRACK_ORDER) == 1,
        first_frame_s=None if first_frame is None else first_frame * tick_s,
        created_unix_s=_creation_time(values),
        readout_s=1e-3 * readout_ms if readout_ms is not None and 0 < readout_ms < 1e3 else None,
        gyro=gyro,
        exposures=_exposures(records.get(_Record.EXPOSURES, b""), start, tick_s, "front", notes),
        back_exposures=_exposures(
            records.get(_Record.BACK_EXPOSURES, b""), start, tick_s, "back", notes
        ),
        gps=_gps(records.get(_Record.GPS, b""), notes),
        notes=tuple(notes),
    )


@dataclass(frozen=True, slots=True)
class _Ticks:
    """Readings of a gyro, on the camera's clock."""

    ticks: np.ndarray  # (N,) int64, strictly increasing
    milliseconds: bool  # True = ticks are milliseconds, else microseconds
    rates: np.ndarray  # (N, 3) float64, rad/s
    accelerations: np.ndarray  # (N, 3) float64, m/s^2


def _gyro(
    record: bytes, raw: bool | None, values: Mapping[int, Any], notes: list[str]
) -> _Ticks | None:
    """Readings of a record, in the layout that the metadata states, or else in the other one."""
    if not record:
        return None
    ranges = read_message(values.get(_Field.GYRO_RANGES, b""))[0]
    for is_raw in (False, True) if raw is False else (True, False):
        layout = _RAW if is_raw else _SCALED
        rows = np.frombuffer(record, layout, len(record) // layout.itemsize)
        ticks, (forces, turns) = rows["time"], np.split(rows["values"], 2, axis=1)
        if is_raw:
            # A raw value of 32768 is zero, and 32768 more is the end of the range in the metadata:
            # 1024 a g for 32 g, 16.384 a deg/s for 2000 deg/s.
            stated_g, stated_deg_s = (
                float(found)
                if isinstance(found := ranges.get(key), int) and 0 < found < 1e5
                else None
                for key in (1, 2)
            )
            of_full = (forces.astype(np.float64) - _RAW_ZERO) / _RAW_FULL
            if stated_g is None and len(of_full):
                length = float(np.median(np.linalg.norm(of_full, axis=1)))
                # the range of accelerometers that gives about 1 g
                stated_g = float(min((8, 16, 32), key=lambda g: abs(np.log(max(g * length, 1e-9)))))
            full_rate = np.deg2rad(stated_deg_s or 2000.0)
            forces = of_full * (stated_g or 1.0)
            turns = (turns.astype(np.float64) - _RAW_ZERO) / _RAW_FULL * full_rate
        with np.errstate(invalid="ignore", over="ignore"):
            # 70 rad/s are twice what gyros of 2000 deg/s measure.
            fine = np.isfinite(rows["values"]).all(axis=1) & (abs(turns) < 70.0).all(axis=1)
        fine &= _near_others(ticks)
        later = np.maximum.accumulate(np.where(fine, ticks, -1))
        fine[1:] &= ticks[1:] > later[:-1]
        kept, step_s = int(fine.sum()), 1e-6 if is_raw else 1e-3
        # a record with fewer usable rows is damaged
        if kept < max(2, 0.5 * len(rows)):
            continue
        rate_hz = 1 / (float(np.median(np.diff(ticks[fine]))) * step_s)
        if not _MIN_RATE_HZ <= rate_hz <= _MAX_RATE_HZ:
            continue
        if kept < len(rows):
            notes.append(f"gyro: {len(rows) - kept:,} of {len(rows):,} readings are damaged")
        forces = forces[fine]
        length = float(np.median(np.linalg.norm(forces, axis=1)))
        if is_raw or length <= np.sqrt(STANDARD_GRAVITY):  # g: in m/s^2 they are far longer than 1
            forces = forces * STANDARD_GRAVITY
        return _Ticks(ticks[fine], not is_raw, turns[fine].astype(np.float64), forces)
    notes.append(f"gyro: {len(record):,} bytes of an unknown layout")
    return None


def _near_others(ticks: np.ndarray) -> np.ndarray:
    """Plausible times (N,) bool, near the readings' median; times (N,) int64."""
    sound = (ticks >= 0) & (ticks < _MAX_TICK)
    if sound.sum() < 2:
        return sound
    step = float(np.median(abs(np.diff(ticks[sound]))))
    # Readings lie within four times their number times the median step.
    return sound & (abs(ticks - np.median(ticks[sound])) <= 4.0 * len(ticks) * step)


def _exposures(
    record: bytes, start: Any, tick_s: float, lens: str, notes: list[str]
) -> ExposureRecord | None:
    """Exposures of a record, with times since `start` ticks; None = there are none."""
    rows = np.frombuffer(record, _SHUTTER, len(record) // _SHUTTER.itemsize)
    with np.errstate(invalid="ignore"):
        fine = (rows["duration"] > 0) & (rows["duration"] < 100.0)
    fine &= (rows["time"] >= 0) & (rows["time"] < _MAX_TICK)
    if not len(rows):
        return None
    if not fine.all():
        notes.append(f"exposures of the {lens} lens: {(~fine).sum():,} of {len(rows):,} damaged")
    if not fine.any():
        return None
    ticks = rows["time"][fine]
    start = ticks[0] if start is None else start
    return ExposureRecord((ticks - start) * tick_s, rows["duration"][fine].astype(np.float64))


def _gps(record: bytes, notes: list[str]) -> GpsRecord | None:
    """Fixes that are marked as valid and are not at 0, 0; None = there are none."""
    rows = np.frombuffer(record, _FIX, len(record) // _FIX.itemsize)
    rows = rows[rows["state"] == b"A"]
    latitudes, longitudes = abs(rows["latitude"]), abs(rows["longitude"])
    with np.errstate(invalid="ignore"):
        fine = (latitudes <= 90) & (longitudes <= 180) & (latitudes + longitudes > 0)
    others = np.column_stack([rows[key] for key in ("speed", "course", "altitude")])
    fine &= np.isfinite(others).all(axis=1)
    if not fine.all():
        notes.append(f"GPS: {(~fine).sum():,} of {len(rows):,} fixes are damaged or at 0, 0")
    if not fine.any():
        return None
    rows = rows[fine]
    return GpsRecord(
        unix_times=rows["seconds"] + 1e-3 * rows["milliseconds"],
        latitudes=np.where(rows["north"] == b"S", -abs(rows["latitude"]), rows["latitude"]),
        longitudes=np.where(rows["east"] == b"W", -abs(rows["longitude"]), rows["longitude"]),
        altitudes=rows["altitude"].astype(np.float64),
    )


def _text(values: Mapping[int, Any], key: int, most: int = 200) -> str:
    """Printable text of a field, at most `most` characters; "" = none."""
    found = values.get(key)
    text = found.decode("utf-8", "replace") if isinstance(found, bytes) else ""
    return "".join(filter(str.isprintable, text[:most])).strip()


def _real(values: Mapping[int, Any], key: int) -> float | None:
    """Finite floating-point number of a field; None = none."""
    found = values.get(key)
    return found if isinstance(found, float) and np.isfinite(found) else None


def _size(values: Mapping[int, Any], across: int, down: int) -> tuple[int, int] | None:
    """Width and height from two fields; None = not stated."""
    width, height = values.get(across), values.get(down)
    if not isinstance(width, int) or not isinstance(height, int):
        return None
    return (width, height) if 0 < width < 1 << 16 and 0 < height < 1 << 16 else None


def _window(values: Mapping[int, Any]) -> SensorWindow | None:
    inner = read_message(values.get(_Field.WINDOW, b""))[0]
    source, size = _size(inner, 1, 2), _size(inner, 3, 4)
    if source is None or size is None or size[0] > source[0] or size[1] > source[1]:
        return None
    right, down = (found if isinstance(found := inner.get(key, 0), int) else 0 for key in (5, 6))
    if abs(right) > source[0] or abs(down) > source[1]:
        return None
    return SensorWindow(source, size, (right, down))


def _creation_time(values: Mapping[int, Any]) -> float | None:
    """Creation time in seconds since 1970, of a field in seconds or milliseconds; None = none."""
    found = values.get(_Field.CREATED)
    if not isinstance(found, int) or found <= 0 or found > 1000 * _YEAR_2100:
        return None
    return float(found) if found < _YEAR_2100 else 1e-3 * found
