"""Positions from satellites: CSV tables and GPX tracks, and their local level frame (WGS 84)."""

import csv
import math
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from gsba.frames.times import read_lines, seconds, stem_of
from gsba.log import GsbaError, brief

_A, _F = 6_378_137.0, 1 / 298.257223563  # WGS 84: half axis in metres, flattening
_E2 = _F * (2 - _F)
_HIGHEST_M = 1e6  # no receiver works higher up
_COLUMNS = {
    "name": ("name", "frame", "image", "file", "filename"),
    "time": ("time", "timestamp", "t", "seconds"),
    "latitude": ("latitude", "lat"),
    "longitude": ("longitude", "lon", "lng", "long"),
    "altitude": ("altitude", "alt", "ele", "elevation", "height"),
}
_WANT = "want a header such as name,latitude,longitude,altitude or timestamp,lat,lon,alt"


@dataclass(frozen=True, slots=True)
class GpsFixes:
    """Positions on the ellipsoid, each of a frame or of a time."""

    names: tuple[str, ...] | None  # (G,) frames' names, or None: they are of times
    timestamps: np.ndarray | None  # (G,) float64, seconds, ascending; None: they are of frames
    geodetic: np.ndarray  # (G, 3) float64: latitude, longitude (degrees), altitude (metres)


def read_gps(path: Path) -> GpsFixes:
    """Fixes of a CSV table (decimal degrees, metres) or of a GPX track.

    A table's header names its columns: latitude and longitude, altitude if known (else 0), and
    either the frame's name or the time in seconds on the frames' clock. A GPX track's times are
    UTC, as Unix time.

    Raises:
        GsbaError: with the line that cannot be used.
    """
    path = Path(path)
    lines = read_lines(path)
    if not lines:
        raise GsbaError(f"{path}: holds no positions")
    if lines[0][1].startswith("<"):
        return _read_gpx(path)
    header = [cell.lower() for cell in _cells(path, *lines[0])]
    where = {
        key: next(header.index(name) for name in names if name in header)
        for key, names in _COLUMNS.items()
        if set(names) & set(header)
    }
    if not {"latitude", "longitude"} <= where.keys():
        raise GsbaError(f"{path}: names no latitude and longitude; {_WANT}")
    if not {"name", "time"} & where.keys():
        raise GsbaError(f"{path}: says neither frame nor time of its positions; {_WANT}")
    names, times, fixes = [], [], []
    for number, line in lines[1:]:
        cells = _cells(path, number, line)
        if len(cells) != len(header):
            raise GsbaError(f"{path}:{number}: {len(cells)} cells under {len(header)} columns")
        place = f"{path}:{number}"
        values = [
            _number(cells[where[key]], key, place) if key in where else 0.0
            for key in ("latitude", "longitude", "altitude")
        ]
        fixes.append(_checked(values, place))
        if "name" in where:
            names.append(stem_of(cells[where["name"]]))
        else:
            times.append(_number(cells[where["time"]], "time", place))
    if not fixes:
        raise GsbaError(f"{path}: holds no positions")
    if "name" in where:
        return GpsFixes(tuple(names), None, np.array(fixes))
    return _in_order(path, np.array(times), np.array(fixes))


def _cells(path: Path, number: int, line: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line]))]
    except csv.Error as error:
        raise GsbaError(f"{path}:{number}: not a row of a CSV table ({error})") from None


def local_from_geodetic(geodetic: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Metres east, north and up (G, 3) of an origin (3,), of latitude, longitude, altitude (G, 3).

    Exact: by way of the earth-centred frame of WGS 84 (Torge and Mueller, Geodesy, 2012, 4.1).
    """
    latitude, longitude = np.deg2rad(origin[:2])
    s, c, sl, cl = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    local_R_earth = np.array([[-sl, cl, 0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]])
    return (_earth_centred(geodetic) - _earth_centred(origin)) @ local_R_earth.T


def _earth_centred(geodetic: np.ndarray) -> np.ndarray:
    latitude, longitude = np.deg2rad(geodetic[..., 0]), np.deg2rad(geodetic[..., 1])
    altitude = geodetic[..., 2]
    normal = _A / np.sqrt(1 - _E2 * np.sin(latitude) ** 2)
    x = (normal + altitude) * np.cos(latitude) * np.cos(longitude)
    y = (normal + altitude) * np.cos(latitude) * np.sin(longitude)
    z = (normal * (1 - _E2) + altitude) * np.sin(latitude)
    return np.stack([x, y, z], axis=-1)


def _read_gpx(path: Path) -> GpsFixes:
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # syntax, encoding
        raise GsbaError(f"{path}: neither a CSV table nor a GPX track ({error})") from None
    times, fixes = [], []
    for number, point in enumerate(root.iterfind(".//{*}trkpt"), 1):
        place = f"{path}: track point {number}"
        time, elevation = point.findtext("{*}time"), point.findtext("{*}ele")
        if time is None:
            raise GsbaError(f"{place} has no time")
        try:
            stamp = datetime.fromisoformat(time.strip())
            times.append((stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)).timestamp())
        except (ValueError, OverflowError):
            raise GsbaError(f"{place}: '{brief(time)}' is not a time") from None
        values = [_number(point.get(key, ""), key, place) for key in ("lat", "lon")]
        values.append(0.0 if elevation is None else _number(elevation, "ele", place))
        fixes.append(_checked(values, place))
    if not fixes:
        raise GsbaError(f"{path}: the GPX file holds no track points")
    return _in_order(path, np.array(times), np.array(fixes))


def _in_order(path: Path, times: np.ndarray, fixes: np.ndarray) -> GpsFixes:
    order = np.argsort(times, kind="stable")
    if np.any(np.diff(times[order]) <= 0):
        raise GsbaError(f"{path}: holds two positions at one time")
    fixes = fixes[order]
    fixes[:, 1] = np.unwrap(fixes[:, 1], period=360)  # the date line is no jump
    return GpsFixes(None, times[order], fixes)


def _number(text: str, what: str, place: str) -> float:
    try:
        value = seconds(text) if what == "time" else float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise GsbaError(f"{place}: {what} '{brief(text)}' is not a number")
    return value


def _checked(values: list[float], place: str) -> list[float]:
    if not (abs(values[0]) <= 90 and abs(values[1]) <= 360):
        raise GsbaError(f"{place}: {values[0]}, {values[1]} is no latitude and longitude")
    if not abs(values[2]) <= _HIGHEST_M:
        raise GsbaError(f"{place}: {values[2]:g} is no altitude in metres")
    return values
