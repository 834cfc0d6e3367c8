"""The gyro of a GoPro recording: a track of telemetry written here as the camera writes it.

Sources: GoPro, gpmf-parser (README: keys, types and nesting of GPMF); ISO/IEC 14496-12 for MP4.
"""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from gsba.imu.files import read_imu

pytest.importorskip("telemetry_parser", reason="telemetry-parser is not installed")

RATE = 200  # readings per second
GYRO_SCALE, ACC_SCALE = 900, 400  # of whole numbers, per rad/s and per m/s^2


def _item(key: str, kind: bytes, size: int, repeat: int, content: bytes) -> bytes:
    """A key, the type of its values, their size and number, and themselves, to four bytes."""
    head = key.encode() + kind + bytes([size]) + struct.pack(">H", repeat)
    return head + content + bytes(-len(content) % 4)


def _nest(key: str, *items: bytes) -> bytes:
    content = b"".join(items)
    return _item(key, b"\0", 1, len(content), content)


def _stream(key: str, unit: bytes, scale: int, values: np.ndarray) -> bytes:
    whole = np.round(values * scale).astype(">i2").tobytes()
    return _nest(
        "STRM",
        _item("SIUN", b"c", len(unit), 1, unit),
        _item("SCAL", b"s", 2, 1, struct.pack(">h", scale)),
        _item(key, b"s", 6, len(values), whole),
    )


def _payload(rates: np.ndarray, forces: np.ndarray) -> bytes:
    """A second of telemetry."""
    return _nest(
        "DEVC",
        _item("DVID", b"L", 4, 1, struct.pack(">I", 1)),
        _item("DVNM", b"c", 1, 9, b"GoPro Max"),
        _stream("ACCL", b"m/s2", ACC_SCALE, forces),
        _stream("GYRO", b"rad/s", GYRO_SCALE, rates),
    )


def _box(kind: str, *parts: bytes) -> bytes:
    content = b"".join(parts)
    return struct.pack(">I", 8 + len(content)) + kind.encode() + content


def _words(*values: int) -> bytes:
    return struct.pack(f">{len(values)}I", *values)


def _write_mp4(path: Path, samples: Sequence[bytes], milliseconds: int) -> None:
    """A file of one track of telemetry, each sample of a duration."""
    num, total = len(samples), milliseconds * len(samples)
    start = _box("ftyp", b"mp41", _words(0), b"mp41")
    starts = np.cumsum([len(start) + 8, *map(len, samples[:-1])]).tolist()
    matrix = _words(0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000)
    table = _box(
        "stbl",
        _box("stsd", _words(0, 1), _box("gpmd", bytes(6), b"\0\1", _words(0))),
        _box("stts", _words(0, 1, num, milliseconds)),
        _box("stsc", _words(0, 1, 1, 1, 1)),
        _box("stsz", _words(0, 0, num, *map(len, samples))),
        _box("stco", _words(0, num, *starts)),
    )
    place = _box("dinf", _box("dref", _words(0, 1), _box("url ", _words(1))))
    media = _box(
        "mdia",
        _box("mdhd", _words(0, 0, 0, 1000, total, 0)),
        _box("hdlr", _words(0), b"mhlrmeta", bytes(12), b"\x0bGoPro MET  \0"),
        _box("minf", _box("gmhd", _box("gmin", bytes(16))), place, table),
    )
    head = _box("tkhd", _words(15, 0, 0, 1, 0, total), bytes(16), matrix, bytes(8))
    film = _box(
        "mvhd", _words(0, 0, 0, 1000, total, 0x10000), b"\1\0", bytes(10), matrix, bytes(28)
    )
    moov = _box("moov", film, _box("trak", head, media))
    path.write_bytes(start + _box("mdat", *samples) + moov)


def test_a_recording_gives_its_gyro(tmp_path: Path) -> None:
    """In rad/s and m/s^2, on the clock of its pictures."""
    times = np.arange(3 * RATE) / RATE
    rates = np.stack([np.sin(times), 0.5 * np.cos(3 * times), 0.2 * times], axis=1)
    forces = np.array([0.3, 9.7, -0.4]) + 0 * rates
    seconds = [_payload(rates[k : k + RATE], forces[k : k + RATE]) for k in (0, RATE, 2 * RATE)]
    _write_mp4(tmp_path / "GS010001.360", seconds, 1000)
    found = read_imu(tmp_path / "GS010001.360")
    np.testing.assert_allclose(found.timestamps, times, atol=1e-6)
    np.testing.assert_allclose(found.rates, rates, atol=1 / GYRO_SCALE)
    assert found.forces is not None
    np.testing.assert_allclose(found.forces, forces, atol=1 / ACC_SCALE)
