"""Trailers of Insta360: a real one to the number, made ones, damaged ones."""

import tracemalloc
from pathlib import Path

import insta360_files as made
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsba.containers.insta360 import Insta360Trailer, read_trailer
from gsba.imu.files import read_imu
from gsba.log import GsbaError

needs_real = pytest.mark.skipif(
    not made.REAL.is_file(), reason="../shared/data/real is not there: no file of a camera"
)
LENSES = made.ONE_R


def _read(path: Path, content: bytes) -> Insta360Trailer:
    path.write_bytes(content)
    found = read_trailer(path)
    assert found is not None
    return found


@needs_real
def test_a_real_file_to_the_number() -> None:
    found = read_trailer(made.REAL)
    assert found is not None and found.gyro is not None and found.exposures is not None
    assert found.version == 3
    assert (found.model, found.firmware) == ("Insta360 OneR", "v2.0.0_build11")
    assert found.lens_strings == (
        "2_1480.69_1517.57_1520.13_-0.186949_0.0336344_-179.227_1479.61_4553.12_1526.43_0.82149"
        "_0.0305849_0.894074_6080_3040_3105",
    )
    assert found.window is not None
    assert (found.window.source, found.window.size) == ((3040, 3040), (2880, 2880))
    assert found.first_frame_s == pytest.approx(309.468418) and not found.back_track_first
    assert found.readout_s == pytest.approx(0.02227798)
    gyro = found.gyro
    assert gyro.rates.shape == gyro.accelerations.shape == (1178, 3)
    assert np.median(np.diff(gyro.times)) == pytest.approx(1e-3, rel=1e-6)
    assert gyro.times[[0, -1]] == pytest.approx([-0.135, 1.040], abs=5e-4)
    # The first reading: u16 33475 32163 33163 32796 32618 33227 at 309334917 us.
    g = np.array([33475, 32163, 33163]) / 1024 - 32
    np.testing.assert_allclose(gyro.accelerations[0], 9.80665 * g)
    rates = (np.array([32796, 32618, 33227]) - 32768) / 16.384
    np.testing.assert_allclose(np.rad2deg(gyro.rates[0]), rates)
    assert gyro.times[0] == pytest.approx(309.334917 - 309.468418 - 0.0015, abs=1e-9)
    lengths = np.linalg.norm(gyro.accelerations, axis=1) / 9.80665
    assert np.median(lengths) == pytest.approx(1.0, abs=0.02)
    assert len(found.exposures.times) == 40
    np.testing.assert_allclose(found.exposures.durations, 0.0332, atol=5e-5)
    np.testing.assert_allclose(np.diff(found.exposures.times)[2:], 1 / 30, atol=2e-4)
    range_ms = 1e3 * found.exposures.durations.min(), 1e3 * found.exposures.durations.max()
    assert range_ms == pytest.approx((33.20, 33.24), abs=5e-3)
    assert found.gps is None and found.back_exposures is None  # its two fixes were made anonymous
    assert found.notes == ("GPS: 2 of 2 fixes are damaged or at 0, 0",)
    readings = read_imu(made.REAL)
    np.testing.assert_array_equal(readings.rates, gyro.rates)


@needs_real
def test_real_rates_turn_as_gravity_does() -> None:
    """Rates of the right scale and axes keep gravity still, which turns by 21 degrees in the chip's
    axes; that tells their unit, and that both sensors share right-handed axes."""
    found = read_trailer(made.REAL)
    rates, forces = found.gyro.rates, found.gyro.accelerations
    steps = 0.5 * (rates[1:] + rates[:-1]) * np.diff(found.gyro.times)[:, None]

    def wander(factors: list[float]) -> float:
        """Standard deviation of accelerations in a frame that turns by rates times factors."""
        world_R_imu, still = Rotation.identity(), [forces[0]]
        for step, force in zip(Rotation.from_rotvec(steps * factors), forces[1:], strict=True):
            world_R_imu = world_R_imu * step
            still.append(world_R_imu.apply(force))
        return float(np.linalg.norm(np.std(still, axis=0)))

    best = wander([1, 1, 1])
    for factor in (0.0, 0.5, 2.0, -1.0):
        assert wander([factor] * 3) > 1.2 * best
    for mirrored in ([-1, 1, 1], [1, -1, 1], [1, 1, -1]):
        assert wander(list(map(float, mirrored))) > 1.2 * best


@pytest.mark.parametrize("directory", [False, True])
def test_what_is_appended_is_read_back(tmp_path: Path, directory: bool) -> None:
    records = made.usual_records()
    content = b"pictures" * 1000 + made.trailer(records, directory)
    found = _read(tmp_path / "v.insv", content)
    assert not found.notes and found.lens_strings == (LENSES,) and found.has_frame_clock
    np.testing.assert_allclose(found.gyro.times, 0.001 * np.arange(500) - 0.01, atol=1e-12)
    waves = 0.5 * np.sin(np.arange(500)[:, None] / 50 + [0, 1, 2])
    np.testing.assert_allclose(found.gyro.rates, waves, atol=np.deg2rad(0.5 / 16.384))
    expected = np.tile([0.6, -0.8, 0], (500, 1))
    np.testing.assert_allclose(found.gyro.accelerations / 9.80665, expected, atol=0.5 / 1024)
    np.testing.assert_allclose(found.exposures.times, 0.033333 * np.arange(15), atol=1e-12)
    np.testing.assert_allclose(found.exposures.durations, np.linspace(0.010, 0.020, 15))
    assert found.back_exposures is not None
    assert (found.gps.latitudes.tolist(), found.gps.longitudes.tolist()) == ([-10.5], [20.25])
    assert found.gps.unix_times.tolist() == [1_700_000_000.25]
    assert found.gps.altitudes.tolist() == [12.0]
    brief = read_trailer(tmp_path / "v.insv", telemetry=False)
    assert brief is not None and brief.model == found.model and brief.gyro is None


def test_older_cameras_write_milliseconds_and_units(tmp_path: Path) -> None:
    """Accelerations are in g as Insta360's SDK has them, or m/s^2: the numbers tell."""
    num = 200
    times, rates = 700 + 2 * np.arange(num), np.full((num, 3), 0.25)
    metadata = made.metadata(first_frame=1000, f62=0)
    for unit in (1.0, 9.80665):
        forces = np.tile([0.0, 0.0, unit], (num, 1))
        records = ((0, made.GYRO, made.scaled_gyro(times, rates, forces)), (1, 1, metadata))
        found = _read(tmp_path / "v.insv", made.trailer(records)).gyro
        np.testing.assert_allclose(found.times, (times - 1000) / 1000, atol=1e-12)
        np.testing.assert_allclose(found.rates, rates)
        np.testing.assert_allclose(found.accelerations[0], [0, 0, 9.80665])


def test_a_layout_that_is_not_stated_or_wrongly_so_is_told_by_the_numbers(tmp_path: Path) -> None:
    rates, forces = np.full((280, 3), 0.25), np.tile([0.0, 0.0, 1.0], (280, 1))
    raw = made.raw_gyro(5_000_000 + 1000 * np.arange(280), rates, forces)
    scaled = made.scaled_gyro(5000 + np.arange(280), rates, forces)
    for said in ({}, {62: 0}, {62: 1}):
        for record in (raw, scaled):
            records = ((0, made.GYRO, record), (1, 1, made.message({2: "X", **said})))
            found = _read(tmp_path / "v.insv", made.trailer(records))
            assert found.gyro is not None and not found.notes
            assert len(found.gyro.times) == 280
            np.testing.assert_allclose(np.diff(found.gyro.times), 1e-3)
            np.testing.assert_allclose(found.gyro.rates, 0.25, atol=1e-3)
            np.testing.assert_allclose(found.gyro.accelerations[:, 2], 9.80665, rtol=1e-3)
            assert found.gyro.times[0] == 0 and not found.has_frame_clock


@pytest.mark.parametrize("range_g", [8, 16, 32])
def test_a_range_that_is_not_stated_is_told_by_gravity(tmp_path: Path, range_g: int) -> None:
    rates, forces = np.zeros((100, 3)), np.tile([0.0, 32 / range_g, 0.0], (100, 1))
    record = made.raw_gyro(1000 * np.arange(100), rates, forces)
    records = ((0, made.GYRO, record), (1, 1, made.message({62: 1})))
    found = _read(tmp_path / "v.insv", made.trailer(records)).gyro
    np.testing.assert_allclose(found.accelerations[:, 1], 9.80665, rtol=1e-3)


def test_the_richest_calibration_comes_first(tmp_path: Path) -> None:
    fields = made.metadata(f54=made.X4_THIRD, f17="2_of_the_factory", f7=1_700_000_000_500, f80=1)
    found = _read(tmp_path / "v.insv", made.trailer(((1, 1, fields),)))
    assert found.lens_strings == (made.X4_THIRD, LENSES, "2_of_the_factory")
    assert found.created_unix_s == 1_700_000_000.5 and found.back_track_first


def test_readings_that_do_not_come_in_order_are_left_out(tmp_path: Path) -> None:
    times = 1000 * np.arange(100)
    times[50], times[10], times[70] = times[20], 1 << 40, 1 << 60
    record = made.raw_gyro(times, np.zeros((100, 3)), np.ones((100, 3)))
    found = _read(tmp_path / "v.insv", made.trailer(((0, 3, record), (1, 1, made.metadata()))))
    assert found.gyro is not None and len(found.gyro.times) == 97
    assert (np.diff(found.gyro.times) > 0).all()
    assert found.notes == ("gyro: 3 of 100 readings are damaged",)


@pytest.mark.parametrize("content", [b"", b"short", bytes(5000), made.SIGNATURE[1:]])
def test_other_files_have_no_trailer(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "v.mp4"
    path.write_bytes(content)
    assert read_trailer(path) is None
    with pytest.raises(GsbaError, match="cannot be read"):
        read_trailer(tmp_path / "missing.insv")


def test_another_version_is_a_note(tmp_path: Path) -> None:
    path = tmp_path / "v.insv"
    path.write_bytes(made.trailer(made.usual_records(), version=2))
    found = read_trailer(path)
    assert found is not None and (found.version, found.gyro, found.lens_strings) == (2, None, ())
    assert found.notes[0].startswith("the Insta360 trailer has version 2, and only version 3 is")


def test_damage_leaves_what_can_still_be_read(tmp_path: Path) -> None:
    """A footer in the middle is damaged: records behind it are read, those before it are not."""
    records = made.usual_records()
    content = bytearray(made.trailer(records))
    end_of_gyro = sum(len(record) + 6 for _, _, record in records[:4])
    content[end_of_gyro - 6] = 77  # no format
    found = _read(tmp_path / "v.insv", bytes(content))
    assert found.model == "Insta360 OneR" and found.gyro is None and found.exposures is None
    assert found.notes == (f"damaged: {end_of_gyro:,} bytes of the trailer cannot be read",)
    with pytest.raises(GsbaError, match=r"v\.insv: its Insta360 trailer holds no gyro.*damaged: "):
        read_imu(tmp_path / "v.insv")


def test_a_damaged_directory_leaves_the_records_next_to_it(tmp_path: Path) -> None:
    records = made.usual_records()
    content = bytearray(made.trailer(records, directory=True).replace(b"\xaa" * 100, b""))
    found = _read(tmp_path / "v.insv", bytes(content))  # its offsets are too large now
    assert found.model == "Insta360 OneR" and found.gyro is not None
    assert sum("would lie outside" in note or "is not where" in note for note in found.notes) == 4


@pytest.mark.parametrize("first_frame", [-1, 1 << 60, -(1 << 63)])
def test_a_first_frame_at_no_time(tmp_path: Path, first_frame: int) -> None:
    content = made.trailer(made.usual_records(first_frame=first_frame))
    found = _read(tmp_path / "v.insv", content)
    assert not found.has_frame_clock and found.gyro is not None and found.gyro.times[0] == 0


def test_a_size_beyond_the_file_hides_nothing(tmp_path: Path) -> None:
    content = bytearray(made.trailer(made.usual_records()))
    content[-40:-36] = b"\xff" * 4
    found = _read(tmp_path / "v.insv", bytes(content))
    assert found.gyro is not None and len(found.gyro.times) == 500
    assert any("claims 4,294,967,295 of the file's" in note for note in found.notes)


def _tolerated(path: Path, content: bytes) -> bool:
    """Whether a file's trailer is read, or refused in one line."""
    with path.open("r+b") as file:  # file systems wait for the disk if a file is written anew
        file.write(content)
        file.truncate()
    try:
        found = read_trailer(path)
    except GsbaError as error:
        assert "\n" not in str(error) and str(path) in str(error)
        return False
    assert found is None or "\n" not in "".join(found.notes)
    return found is not None


@pytest.mark.parametrize("directory", [False, True])
def test_a_trailer_cut_anywhere(tmp_path: Path, directory: bool) -> None:
    """The file ends early, or its middle is missing: at odd bytes too, within its own memory."""
    path, whole = tmp_path / "v.insv", made.trailer(made.usual_records(num=12), directory)
    path.touch()
    tracemalloc.start()
    for at in range(0, len(whole), 3):
        assert not _tolerated(path, whole[:at])  # its end is what it is known by
        _tolerated(path, whole[at:])
        _tolerated(path, whole[: at // 2] + whole[at:])
    assert tracemalloc.get_traced_memory()[1] < 4 << 20
    tracemalloc.stop()


@pytest.mark.parametrize("directory", [False, True])
def test_bytes_changed_anywhere(tmp_path: Path, directory: bool) -> None:
    rng, path = np.random.default_rng(7), tmp_path / "v.insv"
    whole = np.frombuffer(made.trailer(made.usual_records(num=12), directory), np.uint8)
    path.touch()
    tracemalloc.start()
    for number in range(600):
        spoiled = whole.copy()
        count = int(rng.integers(1, 8))
        behind = int(rng.choice([32, 110, 600, len(whole)]))  # more of the fields that lead on
        places = len(whole) - 32 - rng.integers(0, behind, count)
        spoiled[np.maximum(places, 0)] = rng.choice([0, 1, 127, 128, 255, number & 255], count)
        _tolerated(path, spoiled.tobytes())
    assert tracemalloc.get_traced_memory()[1] < 4 << 20
    tracemalloc.stop()
