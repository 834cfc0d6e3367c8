"""Times that cameras write into pictures: read where they are times of the frames, else said."""

import logging
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsba.frames.exif import read_exif
from gsba.frames.scan import scan
from gsba.frames.times import NoTimesError

PIXELS = Image.fromarray(np.full((8, 16, 3), 90, np.uint8))
START = 1714557600.0  # 2024-05-01 10:00:00 UTC


def _picture(
    path: Path, taken: str | None, fraction: str | None = None, zone: str | None = None
) -> Path:
    exif = Image.Exif()
    tags = {0x9003: taken, 0x9291: fraction, 0x9011: zone}
    exif[0x8769] = {tag: text for tag, text in tags.items() if text is not None}
    PIXELS.save(path, exif=exif)
    return path


def _folder(folder: Path, times: list[str | None], zone: str | None = None) -> Path:
    """Pictures a, b, ... taken at "10:00:00.25" and so on."""
    folder.mkdir()
    for letter, time in zip("abcdefgh", times, strict=False):
        whole, _, fraction = (time or "").partition(".")
        taken = None if time is None else f"2024:05:01 {whole}"
        _picture(folder / f"{letter}.jpg", taken, fraction or None, zone)
    return folder


def test_times_with_their_fractions(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "gsba")
    times: list[str | None] = ["10:00:00.25", "10:00:00.75", "10:00:02.050", "10:00:03"]
    frames = scan(_folder(tmp_path / "frames", times))
    assert frames.timed and frames.names == ("a", "b", "c", "d")
    np.testing.assert_allclose(frames.timestamps, START + np.array([0.25, 0.75, 2.05, 3]))
    assert "frame times are those of EXIF, local time, as no time zone is given" in caplog.text


def test_a_time_zone_makes_unix_time(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "gsba")
    times: list[str | None] = ["10:00:00", "10:00:01", "10:00:02"]
    frames = scan(_folder(tmp_path / "frames", times, "+02:00"))
    np.testing.assert_allclose(frames.timestamps, START - 7200 + np.arange(3))
    assert "frame times are those of EXIF, Unix time, in whole seconds" in caplog.text


@pytest.mark.parametrize(
    ("times", "why"),
    [
        (
            ["10:00:00", "10:00:00", "10:00:01"],
            "'a' and 'b' have the same one: they are whole seconds",
        ),
        (["10:00:00.5", "10:00:00.5", "10:00:01.0"], "'a' and 'b' have the same one;"),
        (["10:00:02", "10:00:01", "10:00:03"], "'a' and 'b' are in another order by them"),
        (["10:00:00", None, "10:00:02"], "2 of 3 frames have one, not 'b'"),
    ],
)
def test_why_they_are_no_times(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, times: list[str | None], why: str
) -> None:
    folder = _folder(tmp_path / "frames", times)
    with pytest.raises(NoTimesError, match=f"EXIF times are not used: {why}.*$"):
        scan(folder)
    caplog.set_level(logging.INFO, "gsba")
    frames = scan(folder, order_suffices=True)
    assert not frames.timed and frames.names == ("a", "b", "c")
    assert f"EXIF times are not used: {why}" in caplog.text


def test_other_sources_go_first(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "frames", ["10:00:00", "10:00:01", "10:00:02"])
    np.testing.assert_array_equal(scan(folder, fps=4).timestamps, np.arange(3) / 4)
    table = tmp_path / "times.csv"
    table.write_text("a,7\nb,8\nc,9\n")
    np.testing.assert_array_equal(scan(folder, table).timestamps, [7, 8, 9])
    for k, path in enumerate(sorted(folder.iterdir())):
        path.rename(folder / f"{1.5 * k + 1:.2f}.jpg")
    np.testing.assert_array_equal(scan(folder).timestamps, [1, 2.5, 4])


def test_pictures_without_or_with_broken_tags_are_as_before(tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    folder.mkdir()
    for letter in "abc":
        PIXELS.save(folder / f"{letter}.png")
    with pytest.raises(NoTimesError) as failure:
        scan(folder)
    assert "EXIF" not in str(failure.value)
    for text in ("0000:00:00 00:00:00", "    :  :     :  :  ", "yesterday"):
        assert read_exif(_picture(tmp_path / "odd.jpg", text, "x")).taken is None
    odd = read_exif(_picture(tmp_path / "odd.jpg", "2024:05:01 10:00:00", "5 ", "+99:99"))
    assert odd.taken == START + 0.5 and odd.subsecond and not odd.zoned


def test_gps_tags_say_how_good_they_are(tmp_path: Path) -> None:
    exif = Image.Exif()
    position = {1: "N", 2: (48.0, 8.0, 0.0), 3: "E", 4: (11.0, 30.0, 0.0), 6: 520.0}
    exif[0x8825] = position | {7: (10.0, 0.0, 2.5), 11: 2.5, 29: "2024:05:01", 31: 7.0}
    PIXELS.save(tmp_path / "a.jpg", exif=exif)
    tag = read_exif(tmp_path / "a.jpg").gps
    assert (tag.dop, tag.error_m, tag.unix_time) == (2.5, 7.0, START + 2.5)
    exif[0x8825] = position
    PIXELS.save(tmp_path / "b.jpg", exif=exif)
    tag = read_exif(tmp_path / "b.jpg").gps
    assert tag is not None and np.isnan([tag.dop, tag.error_m, tag.unix_time]).all()
