"""Trailers as Insta360 cameras append them, made from numbers; and where a real one lies."""

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

REAL = Path(__file__).parents[2] / "shared/data/real/insv_one_r/sample.insv"
SIGNATURE = b"8db42d694ccc418790edff439fe026bf"
ONE_R = (
    "2_1480.5_1517.5_1520.1_-0.187_0.034_-179.227_1479.6_4553.1_1526.4_0.821_0.031_0.894"
    "_6080_3040_3105"
)
X4_THIRD = (
    "2_1.94817_4623.81_4623.4_3987.5_3012.7_0.329_0.379_90.493_0.0_0.0_0.0_0.38634348_1.30296624"
    "_-3.93261027_-0.00147663_0.00045841_16000_6000_71_1.94817_4608.23_4606.91_11995.24_3019.82"
    "_-0.199_0.408_89.661_-0.000292_-7.3e-05_-0.03132_0.3855471_1.32885373_-4.07654667_-0.00139833"
    "_0.00011861_16000_6000_71_197632"
)
METADATA, GYRO, EXPOSURES, GPS, BACK_EXPOSURES = 1, 3, 4, 7, 12
Records = Sequence[tuple[int, int, bytes]]  # format, number, content


def varint(value: int) -> bytes:
    """A number as protobuf has it, two's complement of 64 bits."""
    value, out = value & ((1 << 64) - 1), bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def message(values: Mapping[int, int | float | str | bytes]) -> bytes:
    """A protobuf message of its fields."""
    out = b""
    for number, value in values.items():
        if isinstance(value, int):
            out += varint(number << 3) + varint(value)
        elif isinstance(value, float):
            out += varint(number << 3 | 1) + struct.pack("<d", value)
        else:
            content = value.encode() if isinstance(value, str) else value
            out += varint(number << 3 | 2) + varint(len(content)) + content
    return out


def metadata(
    lenses: str = ONE_R, first_frame: int | None = 5_000_000, **more: int | float | str | bytes
) -> bytes:
    """Metadata of a camera with raw gyro readings; `more` as f24=..., by number."""
    values: dict[int, int | float | str | bytes] = {
        **{1: "IAB000", 2: "Insta360 OneR", 3: "v2.0.0", 5: lenses, 25: 22.5, 62: 1},
        **{19: message({1: 2880, 2: 2880}), 65: message({1: 32, 2: 2000})},
        27: message({1: 3040, 2: 3040, 3: 2880, 4: 2880}),
    }
    if first_frame is not None:
        values[24] = first_frame
    return message(values | {int(name[1:]): value for name, value in more.items()})


def raw_gyro(times_us: np.ndarray, rates: np.ndarray, forces_g: np.ndarray) -> bytes:
    """Readings (N) in rad/s and g, of ranges of 2000 deg/s and 32 g."""
    rows = np.zeros(len(times_us), [("time", "<i8"), ("values", "<u2", 6)])
    rows["time"] = times_us
    both = np.column_stack([1024 * forces_g, 16.384 * np.rad2deg(rates)])
    rows["values"] = np.rint(both).astype(int) + 32768
    return rows.tobytes()


def scaled_gyro(times_ms: np.ndarray, rates: np.ndarray, forces: np.ndarray) -> bytes:
    """Readings (N) as older cameras write them."""
    rows = np.zeros(len(times_ms), [("time", "<i8"), ("values", "<f8", 6)])
    rows["time"], rows["values"] = times_ms, np.column_stack([forces, rates])
    return rows.tobytes()


def exposures(times: np.ndarray, durations: np.ndarray) -> bytes:
    """Exposures (N) at ticks of the camera's clock."""
    rows = np.zeros(len(times), [("time", "<i8"), ("duration", "<f8")])
    rows["time"], rows["duration"] = times, durations
    return rows.tobytes()


def fix(unix_s: int, latitude: float, longitude: float, state: bytes = b"A") -> bytes:
    """A fix of a GPS receiver, at 12 m, 1.5 m/s, 90 degrees."""
    place = struct.pack("<dc", abs(latitude), b"S" if latitude < 0 else b"N")
    place += struct.pack("<dc", abs(longitude), b"W" if longitude < 0 else b"E")
    return struct.pack("<qHc", unix_s, 250, state) + place + struct.pack("<3d", 1.5, 90.0, 12.0)


def trailer(records: Records, directory: bool = False, version: int = 3) -> bytes:
    """What is appended to a file: records as a chain, or with gaps and a directory."""
    body, entries = b"", b""
    for form, number, content in records:
        entries += struct.pack("<BBII", number, form, len(content), len(body))
        body += content + struct.pack("<BBI", form, number, len(content))
        body += b"\xaa" * 100 if directory else b""
    if directory:
        body += entries + bytes(10) + struct.pack("<BBI", 0, 0, len(entries) + 10)
    size = len(body) + 72
    return body + bytes(32) + struct.pack("<II", size, version) + SIGNATURE


def usual_records(
    num: int = 500, first_frame: int | None = 5_000_000, lenses: str = ONE_R
) -> Records:
    """Half a second of readings at 1 kHz from 10 ms before the first frame, and all else."""
    times = 4_990_000 + 1000 * np.arange(num)
    rates = 0.5 * np.sin(np.arange(num)[:, None] / 50 + [0, 1, 2])
    forces = np.tile([0.6, -0.8, 0.0], (num, 1))
    shutter = exposures(5_000_000 + 33_333 * np.arange(15), np.linspace(0.010, 0.020, 15))
    return (
        (0, GPS, fix(1_700_000_000, -10.5, 20.25) + fix(1_700_000_001, 10.5, -20.25, b"V")),
        (0, EXPOSURES, shutter),
        (0, BACK_EXPOSURES, shutter),
        (0, GYRO, raw_gyro(times, rates, forces)),
        (0, 2, b"a picture"),
        (1, METADATA, metadata(lenses, first_frame)),
    )
