"""GPS fixes of tables, tracks, tags and videos, with the noise that these state."""

import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import insta360_files
import numpy as np
import pytest
from gopro_files import item, nest, words, write_mp4
from PIL import Image
from refusals import refused
from walk_on_earth import frame_set

from gsba.config import GpsSettings
from gsba.frames.recordings import combine
from gsba.log import GsbaError
from gsba.placement import fixes_of, fixes_of_frames, read_fixes, read_gps
from gsba.placement.frame_fixes import read_exif_gps
from gsba.placement.gps_video import read_video_gps
from gsba.types import FrameSet

LEAST = [3.0, 3.0, 5.0]


def _read(path: Path, text: str, **settings: float) -> np.ndarray:
    path.write_text(text)
    return read_gps(path, GpsSettings.model_validate(settings)).sigmas


def test_tables_state_their_noise(tmp_path: Path) -> None:
    path = tmp_path / "gps.csv"
    plain = _read(path, "t,lat,lon,alt\n1,48,11,500\n2,48,11,500\n")
    np.testing.assert_array_equal(plain, [LEAST, LEAST])
    dop = _read(path, "t,lat,lon,alt,hdop,vdop\n1,48,11,500,2,4\n2,48,11,500,.5,\n3,48,11,5,,0\n")
    np.testing.assert_allclose(dop, [[6, 6, 12], LEAST, LEAST])
    own = _read(path, "t,lat,lon,alt,accuracy,vertical_accuracy\n1,48,11,500,8,20\n2,48,11,5,.1,\n")
    np.testing.assert_allclose(own, [[8, 8, 20], LEAST])
    exact = _read(path, "t,lat,lon,alt,sigma\n1,48,11,500,.02\n", sigma_m=0.01, sigma_up_m=0.02)
    np.testing.assert_allclose(exact, [[0.02, 0.02, 0.04]])
    for cells, message in (("x", "error 'x' is not a number"), ("-1", "error -1 is negative")):
        with pytest.raises(GsbaError, match=rf"gps.csv:2: {message}"):
            _read(path, f"t,lat,lon,alt,sigma\n1,48,11,500,{cells}\n")


def test_tracks_state_their_noise(tmp_path: Path) -> None:
    points = "".join(
        f'<trkpt lat="48" lon="11"><ele>5</ele><time>2024-05-01T10:00:0{k}Z</time>{dop}</trkpt>'
        for k, dop in enumerate(
            ["", "<hdop>2</hdop><vdop>3</vdop><pdop>9</pdop>", "<pdop>2.5</pdop>"]
        )
    )
    text = f"<?xml version='1.0'?><gpx><trk><trkseg>{points}</trkseg></trk></gpx>"
    found = _read(tmp_path / "walk.gpx", text)
    np.testing.assert_allclose(found, [LEAST, [6, 6, 9], [7.5, 7.5, 12.5]])


def test_fixes_by_name_stay_with_a_recording_that_others_are_added_to(tmp_path: Path) -> None:
    alone, path = frame_set(4), tmp_path / "gps.csv"
    rows = [f"{name},48.000{n},11,500" for n, name in enumerate(alone.names)]
    path.write_text("\n".join(["name,latitude,longitude,altitude", *rows]))
    before = fixes_of_frames(str(path), alone)
    upper = replace(frame_set(5), paths=tuple((Path(f"upper{n}"),) for n in range(5)))
    both = combine({"ground": alone, "upper": upper})
    after = fixes_of_frames(str(path), both)
    np.testing.assert_array_equal(after.frames, before.frames)
    np.testing.assert_array_equal(after.positions, before.positions)
    table = path.read_text()
    for folder, first in (("pictures", 0), ("ground", 0), ("upper", 4)):
        path.write_text(table.replace("\nf", f"\n/walks/{folder}/f"))
        found = fixes_of_frames(str(path), both).frames
        assert found.tolist() == list(range(first, first + 4))


@pytest.mark.parametrize("begin", [0.0, 1.7e9])
def test_times_from_the_start_of_a_recording_are_not_those_of_another(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, begin: float
) -> None:
    """They placed frames of both; two cameras that show Unix time were carried along together."""
    one = replace(frame_set(4), timestamps=begin + 0.5 * np.arange(4))
    paths = tuple((Path(f"other{n}"),) for n in range(5))
    other = replace(frame_set(5), timestamps=begin + 0.5 * np.arange(5), paths=paths)
    both, path = combine({"one": one, "other": other}), tmp_path / "gps.csv"
    rows = [f"{begin + 0.5 * n},48.000{n},11,500" for n in range(4)]
    path.write_text("\n".join(["timestamp,latitude,longitude,altitude", *rows]))
    found = fixes_of_frames(str(path), both).frames.tolist()
    assert found == [0, 1, 2, 3, *(range(4, 8) if begin else [])]
    assert ("not of 'other', whose clock shows the same" in caplog.text) == (begin == 0)


def test_altitudes_are_all_or_none() -> None:
    geodetic = np.array([[48, 11, np.nan], [48, 11, 500.0], [48, 11, 501], [48, 11, 502]])
    some = fixes_of([3.0, 1, 2, 0], geodetic)
    assert some.timestamps is not None
    np.testing.assert_array_equal(some.timestamps, [0, 1, 2])
    np.testing.assert_array_equal(some.geodetic[:, 2], [502, 500, 501])
    none = fixes_of(["a", "b"], geodetic[:2])
    assert none.names == ("a", "b")
    np.testing.assert_array_equal(none.geodetic[:, 2], [0, 0])
    np.testing.assert_array_equal(none.sigmas[:, 2], [20, 20])


def test_frames_between_fixes_know_less(tmp_path: Path) -> None:
    """Half a second from fixes 1 s apart: an eighth of a metre more; 6 s apart 4.5; 20 s: none."""
    path = tmp_path / "gps.csv"
    rows = [f"{t},48,{11 + 1e-5 * t:.6f},500" for t in (0, 1, 7, 27)]
    path.write_text("\n".join(["t,lat,lon,alt", *rows]))
    frames = replace(frame_set(4), timestamps=np.array([0.5, 1.0, 4.0, 17.0]))
    settings = GpsSettings(sigma_m=5.0, sigma_up_m=8.0)
    found = fixes_of_frames(str(path), frames, settings)
    np.testing.assert_array_equal(found.frames, [0, 1, 2])
    np.testing.assert_allclose(found.sigmas[:, 0], np.hypot(5, [0.125, 0, 4.5]))
    np.testing.assert_allclose(found.sigmas[:, 2], np.hypot(8, [0.125, 0, 4.5]))
    east = found.positions[:, 0]
    np.testing.assert_allclose(np.diff(east) / np.diff(frames.timestamps[:3]), 0.746, atol=1e-3)


def _tagged(folder: Path, stamps: Sequence[float]) -> FrameSet:
    """Pictures whose fixes are of these seconds of a minute."""
    base = frame_set(len(stamps))
    paths = []
    for k, (name, second) in enumerate(zip(base.names, stamps, strict=True)):
        exif = Image.Exif()
        place = (48.0, 8.0, 0.1 * second)
        exif[0x8825] = {1: "N", 2: place, 3: "E", 4: (11.0, 30.0, 0.0), 6: 520.0}
        exif[0x8825] |= {7: (10.0, 0.0, second), 29: "2024:05:01", 11: 2.0 if k % 2 else 0.5}
        path = folder / f"{name}.jpg"
        Image.fromarray(np.full((8, 16, 3), 90, np.uint8)).save(path, exif=exif)
        paths.append((path,))
    return replace(base, paths=tuple(paths))


def test_a_fix_that_pictures_repeat_counts_once(tmp_path: Path) -> None:
    found = read_exif_gps(_tagged(tmp_path, [0.0, 1.0, 1.0, 1.0, 2.0]))
    assert found.names == ("frame_0000", "frame_0001", "frame_0004")
    np.testing.assert_allclose(found.sigmas, [LEAST, [6, 6, 10], LEAST])


def _device(tags: bytes, first_us: int | None) -> bytes:
    stamp = b"" if first_us is None else item("STMP", "J", 8, struct.pack(">Q", first_us))
    name = item("DVNM", "c", 1, b"MAX ")
    return nest("DEVC", item("DVID", "L", 4, words(1)), name, nest("STRM", stamp, tags))


def _gps5(start: float, count: int, state: int = 3, stamped: bool = True) -> bytes:
    """A packet of fixes `count` a second: latitude 48 + t / 1e5, DOP 2.5."""
    times = start + np.arange(count) / count
    rows = np.column_stack(
        [480_000_000 + 100 * times, *np.tile([[115_000_000], [520_000], [1], [1]], count)]
    )
    utc = f"2405011000{int(start):02d}.{round(1000 * (start % 1)):03d}".encode()
    tags = item("GPSF", "L", 4, struct.pack(">I", state)) + item("GPSU", "U", 16, utc)
    tags += item("GPSP", "S", 2, struct.pack(">H", 250))
    tags += item("SCAL", "l", 4, struct.pack(">5i", 10**7, 10**7, 1000, 1000, 100))
    tags += item("GPS5", "l", 20, rows.round().astype(">i4").tobytes())
    return _device(tags, round(1e6 * (start + 0.3)) if stamped else None)


def _gps9(start: float, count: int) -> bytes:
    """The same as later cameras write it; the first fix is flat."""
    data = b""
    for k in range(count):
        t = start + k / count
        place = round(480_000_000 + 100 * t), 115_000_000, 520_000, 1, 1
        state = 2 if start == 0 and k == 0 else 3
        data += struct.pack(">7i2H", *place, 8887, round(1000 * (36000 + t)), 400, state)
    tags = item("TYPE", "c", 1, b"lllllllSS")
    tags += item("SCAL", "l", 4, struct.pack(">9i", 10**7, 10**7, 1000, 1000, 100, 1, 1000, 100, 1))
    return _device(tags + item("GPS9", "?", 32, data), None)


@pytest.mark.parametrize("stamped", [True, False])
def test_gopro_videos_hold_fixes_on_their_clock(tmp_path: Path, stamped: bool) -> None:
    pytest.importorskip("telemetry_parser", reason="telemetry-parser (gsba[imu]) is not there")
    states = [0, 3, 3, 2]
    packets = [_gps5(float(k), 18, state, stamped) for k, state in enumerate(states)]
    found = read_fixes(str(write_mp4(tmp_path / "GS01.360", packets)))
    assert found is not None and found.timestamps is not None
    times = np.arange(18, 54) / 18  # no fix yet in the first second, none with height in the last
    np.testing.assert_allclose(found.timestamps, times, atol=1e-6)
    np.testing.assert_allclose(found.geodetic[:, 0], 48 + 1e-5 * times, atol=1.1e-7)
    np.testing.assert_allclose(found.geodetic[:, 1:], np.tile([11.5, 520], (36, 1)))
    np.testing.assert_allclose(found.sigmas, np.tile([7.5, 7.5, 12.5], (36, 1)))


def test_later_gopros_rate_each_fix(tmp_path: Path) -> None:
    pytest.importorskip("telemetry_parser", reason="telemetry-parser (gsba[imu]) is not there")
    found = read_fixes(str(write_mp4(tmp_path / "a.mp4", [_gps9(0.0, 10), _gps9(1.0, 10)])))
    assert found is not None and found.timestamps is not None
    np.testing.assert_allclose(found.timestamps, np.arange(1, 20) / 10, atol=1e-6)
    np.testing.assert_allclose(found.sigmas[:, 0], 12)


def test_videos_without_fixes_are_one_line(tmp_path: Path) -> None:
    pytest.importorskip("telemetry_parser", reason="telemetry-parser (gsba[imu]) is not there")
    lost = write_mp4(tmp_path / "lost.mp4", [_gps5(float(k), 18, 0) for k in range(3)])
    refused(r"lost\.mp4: its GPS receiver had no fix", read_fixes, str(lost))
    crossed = write_mp4(tmp_path / "crossed.mp4", [_gps5(1.0, 18), _gps5(0.0, 18)])
    refused("packet 1 is not later than packet 0", read_fixes, str(crossed))
    none = write_mp4(tmp_path / "none.mp4", [_device(item("GYRO", "s", 6, bytes(60)), 0)] * 2)
    refused("finds no GPS in it", read_fixes, str(none))
    whole = lost.read_bytes()
    for cut in range(0, len(whole), 37):
        (tmp_path / "cut.mp4").write_bytes(whole[:cut])
        refused(r"cut\.mp4: ", read_fixes, str(tmp_path / "cut.mp4"))


def test_fixes_of_insta360_are_on_the_clock_of_the_video(tmp_path: Path) -> None:
    """Since the recording was created; since the first fix where the camera's date is wrong."""
    path = tmp_path / "VID_20240101_120000_00_001.insv"
    fixes = b"".join(insta360_files.fix(1_700_000_004 + n, -10.5, 20.25) for n in range(3))
    for created, begins in ((1_700_000_000, 4.25), (1_400_000_000, 0.0)):
        metadata = insta360_files.metadata(f7=created)
        records = ((0, insta360_files.GPS, fixes), (1, insta360_files.METADATA, metadata))
        path.write_bytes(b"pictures" + insta360_files.trailer(records))
        found = read_video_gps(path)
        assert found.timestamps is not None
        np.testing.assert_allclose(found.timestamps, begins + np.arange(3))
        np.testing.assert_allclose(found.geodetic, [[-10.5, 20.25, 12.0]] * 3)
    path.write_bytes(b"pictures" + insta360_files.trailer(records[1:]))
    refused("holds no GPS", read_video_gps, path)


def test_the_offset_of_a_clock_counts_in_videos_and_never_for_names(tmp_path: Path) -> None:
    path, late = tmp_path / "VID_20240101_120000_00_001.insv", GpsSettings(offset_s=-2.5)
    fixes = b"".join(insta360_files.fix(1_700_000_000 + n, -10.5, 20.25) for n in range(3))
    path.write_bytes(b"pictures" + insta360_files.trailer([(0, insta360_files.GPS, fixes)]))
    found = read_fixes(str(path), None, late)
    assert found is not None and found.timestamps is not None
    np.testing.assert_allclose(found.timestamps, np.arange(3) - 2.5)
    names = tmp_path / "names.csv"
    names.write_text("name,lat,lon\na,48,11\nb,48,11.001\nc,48,11.002\n")
    refused("--gps-offset -2.5 is added to times", read_fixes, str(names), None, late)


def test_points_of_a_gpx_track_that_share_seconds_are_spread(tmp_path: Path) -> None:
    points = "".join(
        f'<trkpt lat="48" lon="{11 + 1e-5 * n}"><time>2024-05-01T10:00:0{n // 3}Z</time></trkpt>'
        for n in range(6)
    )
    path = tmp_path / "a.gpx"
    path.write_text(f'<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk>{points}</trk></gpx>')
    times = read_gps(path).timestamps
    np.testing.assert_allclose(times - times[0], np.arange(6) / 3, atol=1e-6)
    shifted = read_gps(path, GpsSettings(offset_s=-3600)).timestamps
    assert shifted is not None and shifted[0] == times[0] - 3600
