"""GPS fixes with their noise: CSV tables and GPX tracks, and their local level frame (WGS 84)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsba.config import GpsSettings
from gsba.frames.times import seconds
from gsba.log import GsbaError, brief

_A, _F = 6_378_137.0, 1 / 298.257223563  # WGS 84: semi-major axis in metres, flattening
_E2 = _F * (2 - _F)  # squared eccentricity
_MAX_ALTITUDE_M = 1e6  # no receiver works higher up
_MIN_ALTITUDES = 3  # with so many known altitudes, fixes without one are left out
_UNKNOWN_HEIGHT_SIGMA_M = 20.0  # of heights that are set to 0, as no altitudes are known
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
        keys: (G,) times in seconds on the frames' clock, distinct, in any order; or frames' names.
        geodetic: (G, 3) latitude, longitude (degrees), altitude (metres, NaN = not known). Fixes
            without an altitude are left out if at least three have one; else all altitudes are 0,
            with a sigma of 20 m.
        sigmas: (G, 3) standard deviations east, north and up, metres; None = the smallest that
            settings allow, see `sigmas_of`.
        settings: smallest noise of a fix.
    """
    geodetic = np.array(geodetic, np.float64).reshape(-1, 3)
    sigmas = sigmas_of(settings or GpsSettings(), np.full(len(geodetic), np.nan), sigmas)
    named = len(keys) > 0 and isinstance(keys[0], str)
    order = np.arange(len(keys))
    if not named:
        order = np.argsort(np.array(keys, np.float64), kind="stable")
        same = int(np.flatnonzero(np.diff(np.array(keys, np.float64)[order]) == 0)[0])
        one, other = int(order[same]), int(order[same + 1])
        raise GsbaError(
            f"{path} holds two positions at one time, {keys[one]!r} s: positions {one + 1} and "
            f"{other + 1}; remove one of them"
        )
    if not isinstance(keys[0], str):
        keys = [float(key) + settings.offset_s for key in keys]
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
    if abs(values[2]) > _MAX_ALTITUDE_M:
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
