"""The gyro of a GoPro recording: a track of telemetry written here as the camera writes it."""

import struct
from pathlib import Path

import numpy as np
import pytest
from gopro_files import item, nest, words, write_mp4

from gsba.imu.files import read_imu

pytest.importorskip("telemetry_parser", reason="telemetry-parser is not installed")

RATE = 200  # readings per second
GYRO_SCALE, ACC_SCALE = 900, 400  # of whole numbers, per rad/s and per m/s^2


def _stream(key: str, unit: bytes, scale: int, values: np.ndarray) -> bytes:
    whole = np.round(values * scale).astype(">i2").tobytes()
    return nest(
        "STRM",
        item("SIUN", "c", len(unit), unit),
        item("SCAL", "s", 2, struct.pack(">h", scale)),
        item(key, "s", 6, whole),
    )


def _payload(rates: np.ndarray, forces: np.ndarray) -> bytes:
    """A second of telemetry."""
    return nest(
        "DEVC",
        item("DVID", "L", 4, words(1)),
        item("DVNM", "c", 1, b"GoPro Max"),
        _stream("ACCL", b"m/s2", ACC_SCALE, forces),
        _stream("GYRO", b"rad/s", GYRO_SCALE, rates),
    )


def test_a_recording_gives_its_gyro(tmp_path: Path) -> None:
    """In rad/s and m/s^2, on the clock of its pictures."""
    times = np.arange(3 * RATE) / RATE
    rates = np.stack([np.sin(times), 0.5 * np.cos(3 * times), 0.2 * times], axis=1)
    forces = np.array([0.3, 9.7, -0.4]) + 0 * rates
    seconds = [_payload(rates[k : k + RATE], forces[k : k + RATE]) for k in (0, RATE, 2 * RATE)]
    write_mp4(tmp_path / "GS010001.360", seconds)
    found = read_imu(tmp_path / "GS010001.360")
    np.testing.assert_allclose(found.timestamps, times, atol=1e-6)
    np.testing.assert_allclose(found.rates, rates, atol=1 / GYRO_SCALE)
    assert found.forces is not None
    np.testing.assert_allclose(found.forces, forces, atol=1 / ACC_SCALE)
