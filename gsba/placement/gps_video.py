"""GPS fixes that cameras record into their videos: Insta360 in the file's trailer, GoPro in packets
of about a second, as GPS5 (one DOP and state a packet) or GPS9 (one for each fix), unpacked by
`telemetry_parser`; see github.com/gopro/gpmf-parser."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsba.config import GpsSettings
from gsba.containers.insta360 import read_trailer
from gsba.containers.telemetry import ask_telemetry_parser
from gsba.log import GsbaError
from gsba.placement.gps import GpsFixes, fixes_of, sigmas_of

RECORDINGS = (".360", ".insv", ".lrv", ".mov", ".mp4", ".osv")
_FIX, _DOP, _UTC = "0x47505346", "0x47505350", "0x47505355"  # GPSF, GPSP (DOP * 100), GPSU (ms)
_GPS9 = "0x47505339"
_GPS9_RECORD = np.dtype([("values", ">i4", 7), ("dop", ">u2"), ("fix", ">u2")])
_FIX_2D, _FIX_3D = 2, 3  # states of the receiver: position without and with an altitude


def read_video_gps(path: Path, settings: GpsSettings | None = None) -> GpsFixes:
    """Fixes of a video of Insta360 or GoPro, with times in seconds on the video's clock; GsbaError
    if it holds none, or `telemetry_parser` is needed and not installed."""
    trailer = read_trailer(path)
    if trailer is None:
        return _of_gopro(path, settings)
    if trailer.gps is None:
        raise GsbaError(f"{path}: its Insta360 trailer holds no GPS; give positions as CSV or GPX")
    # Fixes with times since the recording's creation, or the first fix if that is implausible
    record, created_unix_s = trailer.gps, trailer.created_unix_s
    begin = float(record.unix_times[0])
    if created_unix_s is not None and -5.0 <= begin - created_unix_s <= 3600.0:
        begin = created_unix_s
    geodetic = np.column_stack([record.latitudes, record.longitudes, record.altitudes])
    return fixes_of(record.unix_times - begin, geodetic, settings=settings)


def _of_gopro(path: Path, settings: GpsSettings | None) -> GpsFixes:
    """Fixes with times in seconds after the first GPS packet.

    Fixes of a packet are spread evenly until the next one. Packets are timed by the camera
    (STMP), else by the receiver's UTC. Entries without a valid fix are left out.
    """
    groups = ask_telemetry_parser(path, "telemetry", "GPS", "a CSV or GPX file")
    packets = [packet for packet in map(_packet, groups) if packet is not None]
    if not packets:
        raise GsbaError(
            f"{path}: telemetry-parser finds no GPS in it; give positions as CSV or GPX"
        )
    starts = np.array([start for start, _ in packets], np.float64)
    starts -= starts[0]
    late = np.flatnonzero(~(np.diff(starts) > 0))
    if len(late):
        raise GsbaError(
            f"{path}: its GPS packet {late[0] + 1} is not later than packet {late[0]}; give "
            "positions as CSV or GPX"
        )
    lengths = np.diff(starts)
    lengths = np.append(lengths, lengths[-1] if len(lengths) else 1.0)
    times = np.concatenate(
        [
            start + length * np.arange(len(rows)) / max(len(rows), 1)
            for start, length, (_, rows) in zip(starts, lengths, packets, strict=True)
        ]
    )
    rows = np.concatenate([rows for _, rows in packets])
    locked = rows[:, 4] >= _FIX_2D
    locked &= np.isfinite(rows[:, :2]).all(axis=1) & (np.abs(rows[:, :2]) <= [90, 360]).all(axis=1)
    if not locked.any():
        raise GsbaError(f"{path}: its GPS receiver had no fix; give positions as CSV or GPX")
    settings, rows, times = settings or GpsSettings(), rows[locked], times[locked]
    geodetic = np.where(np.arange(3) < np.where(rows[:, 4:] >= _FIX_3D, 3, 2), rows[:, :3], np.nan)
    return fixes_of(times, geodetic, sigmas_of(settings, rows[:, 3]), settings)


def _packet(groups: Mapping[str, Mapping[str, Any]]) -> tuple[float, np.ndarray] | None:
    """Start in seconds and fixes (n, 5) of a packet; None = it has no fixes.

    Columns: latitude, longitude (degrees), altitude (metres), DOP (NaN = unknown), lock state.
    """
    tags = groups.get("GPS9") or groups.get("GPS")
    if not isinstance(tags, Mapping) or "Scale" not in tags:
        return None
    try:
        scale = np.array(tags["Scale"], np.float64)
        if _GPS9 in tags:
            raw = bytes(tags[_GPS9])[8:]  # bytes of key, type, size and repeat
            size = _GPS9_RECORD.itemsize
            found = np.frombuffer(raw[: len(raw) // size * size], _GPS9_RECORD)
            rows = found["values"] / scale[:7]
            dop, fix = found["dop"] / scale[7], found["fix"].astype(np.float64)
        else:
            rows = np.array(tags["Data"], np.float64).reshape(-1, 5) / scale
            dop = np.full(len(rows), float(tags.get(_DOP, np.nan)) / 100)
            fix = np.full(len(rows), float(tags.get(_FIX, _FIX_3D)))
        start = tags.get("TimestampUs")
        if start is not None:
            seconds = 1e-6 * float(start)
        elif _GPS9 in tags:
            seconds = float(rows[0, 5] * 86_400 + rows[0, 6])
        else:
            seconds = 1e-3 * float(tags[_UTC])
    except (KeyError, TypeError, ValueError, IndexError):
        return None
    return seconds, np.column_stack([rows[:, :3], np.where(dop > 0, dop, np.nan), fix])
