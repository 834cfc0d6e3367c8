"""GPS fixes with their noise: CSV tables and GPX tracks, and their local level frame (WGS 84)."""

import csv
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from gsba.config import GpsSettings
from gsba.frames.times import read_lines, seconds, stem_of
from gsba.log import GsbaError, brief

_A, _F = 6_378_137.0, 1 / 298.257223563  # WGS 84: semi-major axis in metres, flattening
_E2 = _F * (2 - _F)  # squared eccentricity
_COLUMNS = {
    "name": ("name", "frame", "image", "file", "filename"),
    "time": ("time", "timestamp", "t", "seconds"),
    "latitude": ("latitude", "lat"),
    "longitude": ("longitude", "lon", "lng", "long"),
    "altitude": ("altitude", "alt", "ele", "elevation", "height"),
    "dop": ("hdop", "dop", "pdop"),
    "dop_up": ("vdop",),
    "error": ("sigma", "accuracy", "horizontal_accuracy", "sigma_m"),
    "error_up": ("sigma_up", "vertical_accuracy", "sigma_up_m"),
}
_NOISE_COLUMNS = ("dop", "dop_up", "error", "error_up")
_HEADER_ADVICE = "give a header such as name,latitude,longitude,altitude or timestamp,lat,lon,alt"


@dataclass(frozen=True, slots=True)
class GpsFixes:
    """Positions on the ellipsoid, each with the name of a frame or with a time."""

    names: tuple[str, ...] | None  # (G,) names of frames; None = fixes have times
    timestamps: np.ndarray | None  # (G,) float64, seconds, ascending; None = fixes have names
    geodetic: np.ndarray  # (G, 3) float64: latitude, longitude (degrees), altitude (metres)
    sigmas: np.ndarray  # (G, 3) float64, standard deviations east, north and up, metres


def fixes_of(
    keys: Sequence[float] | Sequence[str] | np.ndarray,
    geodetic: np.ndarray,
    sigmas: np.ndarray | None = None,
    settings: GpsSettings | None = None,
) -> GpsFixes:
    """Fixes sorted by time, with altitudes known for all or for none.

    Args:
        keys: (G,) times in seconds, distinct, in any order, to which the settings' offset is added;
            or frames' names.
        geodetic: (G, 3) latitude, longitude (degrees), altitude (metres, NaN = not known). Fixes
            without an altitude are left out if at least three have one; else all altitudes are 0,
            with a sigma of 20 m.
        sigmas: (G, 3) standard deviations east, north and up, metres; None = the smallest that
            settings allow, see `sigmas_of`.
    """
    geodetic, settings = np.array(geodetic, np.float64).reshape(-1, 3), settings or GpsSettings()
    sigmas = sigmas_of(settings, np.full(len(geodetic), np.nan), sigmas)
    named = len(keys) > 0 and isinstance(keys[0], str)
    if named and settings.offset_s:
        raise GsbaError(
            f"--gps-offset {settings.offset_s:g} is added to times, but these positions are of "
            "frames by name: leave it out (--gps-offset 0 on export)"
        )
    order = np.arange(len(keys))
    if not named:
        order = np.argsort(np.array(keys, np.float64), kind="stable")
    high = np.isfinite(geodetic[order, 2])
    if high.all() or high.sum() >= 3:
        order = order[high]
    else:
        geodetic[:, 2], sigmas[:, 2] = 0.0, np.maximum(sigmas[:, 2], 20.0)  # no altitudes are known
    geodetic, sigmas = geodetic[order], sigmas[order]
    geodetic[:, 1] = np.unwrap(geodetic[:, 1], period=360)  # no jump at the date line
    if named:
        return GpsFixes(tuple(str(keys[int(i)]) for i in order), None, geodetic, sigmas)
    times = np.array(keys, np.float64)[order] + settings.offset_s
    return GpsFixes(None, times, geodetic, sigmas)


def sigmas_of(
    settings: GpsSettings,
    dop: np.ndarray,
    given: np.ndarray | None = None,
    *,
    dop_up: np.ndarray | None = None,
    error_m: np.ndarray | None = None,
    error_up_m: np.ndarray | None = None,
) -> np.ndarray:
    """Standard deviations (G, 3) of fixes east, north and up, metres, never below the settings'.

    The horizontal one is the receiver's error estimate, else the dilution of precision times the
    settings' noise. The vertical one is computed likewise from vertical values, else in proportion
    to the horizontal one. NaN is unknown in all arguments.

    Args:
        dop, dop_up: (G,) dilution of precision: horizontal (or of the position), and vertical.
        given: (G, 3) known standard deviations, metres; the settings bound them from below.
        error_m, error_up_m: (G,) error estimates of the receiver, metres.
    """
    least = np.array([settings.sigma_m, settings.sigma_m, settings.sigma_up_m])
    if given is not None:
        return np.fmax(np.broadcast_to(given, (len(dop), 3)), least)
    nothing = np.full(len(dop), np.nan)
    error_m, error_up_m, dop_up = (
        nothing if part is None else part for part in (error_m, error_up_m, dop_up)
    )
    across = np.fmax(np.where(np.isfinite(error_m), error_m, dop * settings.sigma_m), least[0])
    up = np.where(np.isfinite(error_up_m), error_up_m, dop_up * settings.sigma_m)
    up = np.where(np.isfinite(up), up, across * least[2] / least[0])
    return np.column_stack([across, across, np.fmax(up, least[2])])


def read_gps(path: Path, settings: GpsSettings | None = None) -> GpsFixes:
    """Fixes of a CSV table (decimal degrees, metres) or of a GPX track.

    A table's header names its columns: latitude and longitude, altitude if known, either the
    frame's name or the time in seconds on the frames' clock, and the noise of fixes: `hdop`,
    `vdop`, `pdop`, or `sigma`, `accuracy` and `sigma_up` in metres. Times of a GPX track are UTC
    and become Unix time; its `hdop`, `vdop` and `pdop` are read. Points that share a whole second
    are spread over it. The settings' offset is added to all times. Raises GsbaError: a line cannot
    be used; the message names it.
    """
    path, settings = Path(path), settings or GpsSettings()
    lines = read_lines(path)
    if not lines:
        raise GsbaError(f"{path} holds no positions")
    if lines[0][1].startswith("<"):
        return _read_gpx(path, settings)
    header = [cell.lower() for cell in _cells(path, *lines[0])]
    where = {
        key: next(header.index(name) for name in names if name in header)
        for key, names in _COLUMNS.items()
        if set(names) & set(header)
    }
    if not {"latitude", "longitude"} <= where.keys():
        what, advice = "has no columns of latitude and longitude", _HEADER_ADVICE
        if lines[0][1].startswith("$"):
            what, advice = "is an NMEA log", "convert it to GPX, as by gpsbabel"
        elif ";" in lines[0][1]:
            what, advice = "has semicolons between its columns", "use commas, and points in numbers"
        raise GsbaError(f"{path} {what}; {advice}")
    if not {"name", "time"} & where.keys():
        raise GsbaError(f"{path} has no column of frames' names or times; {_HEADER_ADVICE}")
    keys, rows, noise = [], [], []
    for number, line in lines[1:]:
        cells = _cells(path, number, line)
        if len(cells) != len(header):
            raise GsbaError(
                f"{path}:{number}: the line has {len(cells)} cells, the header {len(header)}"
            )
        found = {key: cells[column] for key, column in where.items()}
        place = f"{path}:{number}"
        rows.append(_position(found["latitude"], found["longitude"], found.get("altitude"), place))
        noise.append([_noise(found.get(key), key, place) for key in _NOISE_COLUMNS])
        named = "name" in where
        keys.append(_frame(found["name"]) if named else _number(found["time"], "time", place))
    if not rows:
        raise GsbaError(f"{path} holds no positions")
    return _checked_fixes(path, keys, rows, noise, settings)


def _frame(name: str) -> str:
    """A frame's name, behind that of the file's folder if it has one, as frames of recordings."""
    return "/".join([*name.replace("\\", "/").split("/")[-2:-1], stem_of(name)])


def _cells(path: Path, number: int, line: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line]))]
    except csv.Error as error:
        raise GsbaError(f"{path}:{number}: not a row of a CSV table ({error})") from None


def local_from_geodetic(geodetic: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Metres east, north and up (G, 3) from an origin (3,), both latitude, longitude, altitude.

    Exact, through the earth-centred frame of WGS 84 (Torge and Mueller, Geodesy, 2012, 4.1).
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


def _read_gpx(path: Path, settings: GpsSettings) -> GpsFixes:
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # syntax, encoding
        raise GsbaError(f"{path} is neither a CSV table nor a GPX track ({error})") from None
    times, rows, noise = [], [], []
    for number, point in enumerate(root.iterfind(".//{*}trkpt"), 1):
        place = f"{path}: track point {number}"
        time = point.findtext("{*}time")
        if time is None:
            raise GsbaError(f"{place} has no time")
        try:
            stamp = datetime.fromisoformat(time.strip())
            times.append((stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)).timestamp())
        except (ValueError, OverflowError):
            raise GsbaError(f"{place}: '{brief(time)}' is not a time") from None
        height = point.findtext("{*}ele")
        rows.append(_position(point.get("lat", ""), point.get("lon", ""), height, place))
        dop = point.findtext("{*}hdop") or point.findtext("{*}pdop")
        up = point.findtext("{*}vdop")
        noise.append([_noise(dop, "hdop", place), _noise(up, "vdop", place), math.nan, math.nan])
    if not rows:
        kml = root.tag.endswith("}kml")
        what = "is KML, whose points have no times: give" if kml else "holds no track points of"
        raise GsbaError(f"{path} {what} a GPX track")
    return _checked_fixes(path, _spread(times), rows, noise, settings)


def _spread(times: list[float]) -> list[float]:
    """Times of a GPX track spread over whole seconds, where apps write no fraction."""
    if any(time % 1 for time in times):
        return times
    shares = Counter(times)
    seen = Counter[float]()
    spread = []
    for time in times:
        spread.append(time + seen[time] / shares[time])
        seen[time] += 1
    return spread


def _checked_fixes(
    path: Path,
    keys: list[float] | list[str],
    rows: list[list[float]],
    noise: list[list[float]],
    settings: GpsSettings,
) -> GpsFixes:
    """Fixes of a file; `noise` holds a row of `_NOISE_COLUMNS` for each."""
    first = dict[float | str, int]()  # position of each key
    for row, key in enumerate(keys, 1):
        if (before := first.setdefault(key, row)) != row:
            where = (
                f"of frame '{brief(key)}'" if isinstance(key, str) else f"at one time, {key!r} s"
            )
            raise GsbaError(
                f"{path} holds two positions {where}: positions {before} and {row}; remove one of "
                "them"
            )
    dop, dop_up, error, error_up = np.array(noise).T
    known = {"dop_up": dop_up, "error_m": error, "error_up_m": error_up}
    return fixes_of(keys, np.array(rows), sigmas_of(settings, dop, **known), settings)


def _position(latitude: str, longitude: str, altitude: str | None, place: str) -> list[float]:
    """Latitude and longitude, degrees, and altitude, metres; NaN if it is absent or empty."""
    values = [_number(latitude, "latitude", place), _number(longitude, "longitude", place)]
    if not (abs(values[0]) <= 90 and abs(values[1]) <= 360):
        raise GsbaError(
            f"{place}: latitude {values[0]}, longitude {values[1]} are out of range (degrees)"
        )
    values.append(_number(altitude, "altitude", place) if altitude else math.nan)
    # no receiver works higher up
    if abs(values[2]) > 1e6:
        raise GsbaError(f"{place}: altitude {values[2]:g} is out of range (metres)")
    return values


def _noise(text: str | None, what: str, place: str) -> float:
    """Value of a DOP or a standard deviation; NaN if it is absent, empty, or 0 for "unknown"."""
    value = _number(text, what, place) if text and text.strip() else math.nan
    if value < 0:
        raise GsbaError(f"{place}: {what} {value:g} is negative")
    return value or math.nan


def _number(text: str, what: str, place: str) -> float:
    try:
        value = seconds(text) if what == "time" else float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise GsbaError(f"{place}: {what} '{brief(text)}' is not a number")
    return value
