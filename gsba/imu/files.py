"""Files of inertial readings: a table, or a maker's recording.

Recordings of Insta360 are read by `gsba.containers`: it knows the layouts that `telemetry_parser`
knows, keeps the axes (the library mirrors those of some cameras), and neither ends the process nor
takes gigabytes over a damaged file. Other recordings are read by the library.

A table has a column of times, three of rates and optionally three of forces, separated by commas,
semicolons or blanks. Without a header these are, in this order, seconds, rad/s and m/s^2. A header
names columns (`t`, `gyro_x`, `acc_x`, ...), in any order among others, and may give units in
brackets (`gyro_x [deg/s]`).
"""

import re
from pathlib import Path

import numpy as np

from gsba.containers.insta360 import STANDARD_GRAVITY, read_trailer
from gsba.containers.telemetry import ask_telemetry_parser
from gsba.frames.times import read_lines
from gsba.imu.readings import Readings
from gsba.log import GsbaError, brief

_TABLES = (".csv", ".txt", ".tsv", ".dat")
_MIN_READINGS_HZ = 25.0  # readings per second: fewer do not resolve a readout of 10 to 30 ms
_MIN_READINGS = 10  # least number of readings
_DEGREE = np.pi / 180
_SECONDS_OF_UNIT = {"": 1.0, "s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_RAD_S_OF_UNIT = {"": 1.0, "rad/s": 1.0, "deg/s": _DEGREE, "dps": _DEGREE}
_M_S2_OF_UNIT = {"": 1.0, "m/s2": 1.0, "g": STANDARD_GRAVITY}
_COLUMN_PATTERNS = {
    "t": (r"t|time|timestamp", _SECONDS_OF_UNIT),
    "gyro": (
        r"(?:w|g|gyr|gyro|gyroscope|omega|w_rs_s|angular_velocity)[_. ]?([xyz])",
        _RAD_S_OF_UNIT,
    ),
    "acc": (
        r"(?:a|acc|accel|accelerometer|a_rs_s|linear_acceleration)[_. ]?([xyz])",
        _M_S2_OF_UNIT,
    ),
}
_DEFAULT_COLUMNS = ["t", *(f"gyro_{axis}" for axis in "xyz"), *(f"acc_{axis}" for axis in "xyz")]


def read_imu(path: Path) -> Readings:
    """Readings of a table, or of a maker's recording. GsbaError: the file cannot be read or used;
    the message names the line. Or `telemetry_parser` is needed and not installed."""
    path = Path(path)
    if path.suffix.lower() in _TABLES or not path.is_file():
        lines = [(line, _cells(text)) for line, text in read_lines(path)]
        # a header behind a #, which begins with the column of times
        with path.open(encoding="utf-8-sig") as file:
            first = file.readline().strip()
        named = _cells(first.lstrip("# "))
        timed = re.fullmatch(_COLUMN_PATTERNS["t"][0], _name_and_unit(named[0] if named else "")[0])
        header = (1, named) if first.startswith("#") and timed else None
        if lines and header is None and not _is_number(lines[0][1][0]):
            header = lines[0]
        if lines and header is not None and header[1] == lines[0][1]:
            lines = lines[1:]
        if not lines:
            raise GsbaError(f"{path}: holds no readings")
        if header is None and len(lines[0][1]) not in (4, 7):
            raise GsbaError(
                f"{path}:{lines[0][0]}: {len(lines[0][1])} columns; want t, gyro x y z [rad/s] and "
                "accelerometer x y z [m/s^2], or a header that names them"
            )
        names = _DEFAULT_COLUMNS[: len(lines[0][1])] if header is None else header[1]
        columns = _columns(f"{path}:{header[0]}" if header else str(path), names)
        values = np.empty((len(lines), len(columns)))
        for n, (line, cells) in enumerate(lines):
            if len(cells) != len(names):
                raise GsbaError(f"{path}:{line}: {len(cells)} values where {len(names)} are named")
            for k, (column, scale) in enumerate(columns):
                if not _is_number(cells[column]):
                    raise GsbaError(
                        f"{path}:{line}: '{brief(cells[column])}' is not a finite number"
                    )
                values[n, k] = float(cells[column]) * scale
        forces = values[:, 4:] if values.shape[1] == 7 else None
        where = [f"{line}" for line, _ in lines]
        return _checked(path, values[:, 0], values[:, 1:4], forces, where)
    return read_telemetry(path)


def read_telemetry(path: Path, lasting_s: float | None = None) -> Readings:
    """Readings stored in a maker's recording; those timed from the first frame that begin after its
    pictures' duration, seconds, are of another recording; None = not known. GsbaError: the file
    holds no usable readings, or `telemetry_parser` is needed and not installed."""
    trailer = read_trailer(path)
    if trailer is None:
        table = "a table (t, gyro x y z, accelerometer x y z)"
        rows = ask_telemetry_parser(path, "normalized_imu", "gyro", table)
        rows = [row for row in rows if row.get("gyro") is not None]
        times = np.array([1e-3 * row["timestamp_ms"] for row in rows], np.float64)
        rates = np.array([row["gyro"] for row in rows], np.float64).reshape(-1, 3) * _DEGREE
        forces = None
        if rows and all(row.get("accl") is not None for row in rows):
            forces = np.array([row["accl"] for row in rows], np.float64).reshape(-1, 3)
        return _checked(path, times, rates, forces, [f"reading {n + 1}" for n in range(len(rows))])
    if trailer.gyro is None:
        why = f" ({'; '.join(trailer.notes)})" if trailer.notes else ""
        raise GsbaError(f"{path}: its Insta360 trailer holds no gyro that can be read{why}")
    gyro = trailer.gyro
    begin, end = float(gyro.times[0]), float(gyro.times[-1])
    outside = lasting_s is not None and (end < 0 or begin > lasting_s)
    if trailer.has_frame_clock and outside:
        raise GsbaError(
            f"{path}: its gyro readings are from {begin:.3f} to {end:.3f} s after the first frame, "
            f"its pictures from 0 to {lasting_s:.3f} s: readings of another recording"
        )
    where = [f"reading {n + 1}" for n in range(len(gyro.times))]
    return _checked(path, gyro.times, gyro.rates, gyro.accelerations, where)


def _cells(text: str) -> list[str]:
    for mark in ",;\t":
        if mark in text:
            return [cell.strip() for cell in text.split(mark)]
    return text.split()


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False


def _columns(where: str, names: list[str]) -> list[tuple[int, float]]:
    """Column of t, of each axis of gyro and accelerometer, and the factor of its unit."""
    found: dict[str, tuple[int, float]] = {}
    for column, name in enumerate(names):
        plain, unit = _name_and_unit(name)
        for kind, (pattern, units) in _COLUMN_PATTERNS.items():
            match = re.fullmatch(pattern, plain)
            if match is None:
                continue
            key = "_".join([kind, *match.groups()])
            if unit not in units:
                known = ", ".join(filter(None, units))
                raise GsbaError(f"{where}: '{brief(name)}': want one of {known}")
            if key in found:
                raise GsbaError(f"{where}: two columns are {key}: leave one out")
            found[key] = column, units[unit]
    wanted = (
        _DEFAULT_COLUMNS if any(key.startswith("acc") for key in found) else _DEFAULT_COLUMNS[:4]
    )
    for key in wanted:
        if key not in found:
            raise GsbaError(f"{where}: no column is {key}: name them {', '.join(_DEFAULT_COLUMNS)}")
    return [found[key] for key in wanted]


def _name_and_unit(name: str) -> tuple[str, str]:
    """A column's name in lower case, and its unit in the spelling of the tables here."""
    match = re.fullmatch(r"([^\[(]*?)\s*(?:[\[(](.*)[\])])?", name.lower().strip())
    plain, unit = (match[1], match[2] or "") if match else (name, "?")
    for old, new in (("²", "2"), ("^2", "2"), ("s^-1", "/s"), ("s^-2", "/s2"), ("°", "deg")):
        unit = unit.replace(old, new)
    return plain, unit.replace(" ", "").replace("s-2", "/s2").replace("//", "/")


def _checked(
    path: Path, times: np.ndarray, rates: np.ndarray, forces: np.ndarray | None, where: list[str]
) -> Readings:
    """Readings, checked to be usable; `where` names each."""
    if len(times) < _MIN_READINGS:
        raise GsbaError(
            f"{path}: {len(times)} readings of a gyro; at least {_MIN_READINGS} are needed"
        )
    bad = np.flatnonzero(~np.isfinite(np.column_stack([times, rates])).all(axis=1))
    if len(bad):
        raise GsbaError(f"{path}:{where[bad[0]]}: holds a number that is not finite")
    late = np.flatnonzero(np.diff(times) <= 0)
    if len(late):
        raise GsbaError(
            f"{path}:{where[late[0] + 1]}: time {times[late[0] + 1]:.9g} does not come after "
            f"{times[late[0]]:.9g}; sort the file"
        )
    # rad/s: gyros saturate at 35, 2000 deg/s
    fast = np.flatnonzero(np.abs(rates).max(axis=1) > 40.0)
    if len(fast):
        raise GsbaError(
            f"{path}:{where[fast[0]]}: {np.abs(rates[fast[0]]).max():.4g} rad/s, which no gyro "
            "measures: if these are deg/s, name the unit in a header (gyro_x [deg/s], ...)"
        )
    every = float(np.median(np.diff(times)))
    if every > 1 / _MIN_READINGS_HZ:
        raise GsbaError(
            f"{path}: a reading every {every:.3g} s; {_MIN_READINGS_HZ:g} per second are needed: "
            "is t in another unit (t [ms])?"
        )
    return Readings(times, rates, forces)
