"""Videos as Insta360 cameras write them: pictures made here, with trailers behind them."""

import json
import logging
from dataclasses import replace
from pathlib import Path

import insta360_files as made
import numpy as np
import pytest
from command import fails, run_gsba
from two_fisheyes import picture
from video_files import encode, steady

from gsba.camera.factory_lenses import FactoryCalibration, parse_factory_lenses
from gsba.config import VideoSettings
from gsba.frames.factory_start import FACTORY_FILE
from gsba.frames.scan import scan
from gsba.log import GsbaError
from gsba.pipeline.inputs import read_gyro
from gsba.video import extract

av = pytest.importorskip("av", reason="PyAV is not installed")

SIDE, NUM = 144, 12
EVERY = VideoSettings(every=3, standing_deg=0)
KNOWN = FactoryCalibration(made.ONE_R, "Insta360 OneR", (3040, 3040), (2880, 2880))
PAIR = parse_factory_lenses(KNOWN).pairs((SIDE, SIDE))[0]
FRONT, BACK = (picture(lens) for lens in PAIR)
BOTH = np.concatenate([FRONT, BACK], axis=1)
TRAILER = made.trailer(made.usual_records())


def _video(path: Path, *tracks: np.ndarray, trailer: bytes = b"") -> Path:
    """A video of NUM equal frames at 30 fps in each track, and what is appended to it."""
    shown = [([pixels] * NUM, steady(NUM)) for pixels in tracks]
    return encode(path, *shown, container_format="mp4", trailer=trailer)


def _name(folder: Path, lens: str) -> Path:
    return folder / f"VID_20240101_120000_{lens}_001.insv"


def _check(video: Path, out: Path, back_first: bool = False) -> None:
    """Frames of a video start from the lenses of its trailer, and it has its gyro."""
    extract(video, out, EVERY)
    found = scan(out).format.fisheyes
    known = parse_factory_lenses(replace(KNOWN, back_first=back_first))
    assert found == known.pairs((SIDE, SIDE))[0]
    gyro = read_gyro(None, video)
    assert gyro is not None and len(gyro.timestamps) == 500
    assert gyro.timestamps[0] == pytest.approx(-0.010)


def test_two_tracks(tmp_path: Path) -> None:
    _check(_video(_name(tmp_path, "00"), FRONT, BACK, trailer=TRAILER), tmp_path / "frames")


def test_two_tracks_in_the_other_order(tmp_path: Path) -> None:
    """As the file states it."""
    records = (*made.usual_records()[:-1], (1, 1, made.metadata(f80=1)))
    video = _video(_name(tmp_path, "00"), BACK, FRONT, trailer=made.trailer(records, True))
    _check(video, tmp_path / "frames", back_first=True)


@pytest.mark.parametrize("given", ["00", "10"])
@pytest.mark.parametrize("holding", [("00",), ("10",), ("00", "10")])
def test_two_files_of_which_either_holds_the_trailer(
    tmp_path: Path, given: str, holding: tuple[str, ...]
) -> None:
    for lens, pixels in (("00", FRONT), ("10", BACK)):
        _video(_name(tmp_path, lens), pixels, trailer=TRAILER if lens in holding else b"")
    _check(_name(tmp_path, given), tmp_path / "frames")


def test_side_by_side(tmp_path: Path) -> None:
    _check(_video(tmp_path / "v.insv", BOTH, trailer=TRAILER), tmp_path / "frames")


@pytest.mark.parametrize("level", [40, 200])
def test_its_name_says_that_it_is_raw_where_no_circle_shows(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, level: int
) -> None:
    """Dim or bright all over: no black corners, or nothing in them."""
    plain = np.full((SIDE, 2 * SIDE, 3), level, np.uint8)
    video = _video(tmp_path / "v.insv", plain, trailer=TRAILER)
    caplog.set_level(logging.INFO)
    extract(video, tmp_path / "frames", EVERY)
    assert "raw, two fisheyes side by side, by its suffix" in caplog.text
    assert scan(tmp_path / "frames").format.layout == "fisheye"
    extract(video.rename(tmp_path / "v.mp4"), tmp_path / "panoramas", EVERY)
    assert not (tmp_path / "panoramas/front").exists()
    assert not (tmp_path / "panoramas" / FACTORY_FILE).exists()


def test_circles_that_are_given_are_not_looked_for(tmp_path: Path) -> None:
    """Where a video is followed, too; the pictures tell nothing else of the lenses."""
    plain = np.full((SIDE, 2 * SIDE, 3), 200, np.uint8)
    video = _video(tmp_path / "v.insv", plain)
    given = "--circle", f"{SIDE / 2},{SIDE / 2},{SIDE / 2}"
    extract(video, tmp_path / "frames", EVERY)
    refine = "refine", video, "--out", tmp_path / "run"
    track = "track", video, "--out", tmp_path / "walk.tum"
    mask = "mask", tmp_path / "frames", "--out", tmp_path / "masks"
    for call in (refine, track, mask):
        found = run_gsba("-q", *call)
        fails(found, "show no bright circle")
        assert ("of a cube" in found.stderr) == (call is mask)  # a video holds no faces in folders
        fails(run_gsba("-q", *call, *given), "overlap at the rims does not determine")


def test_another_extraction_leaves_no_lenses_behind(tmp_path: Path) -> None:
    first = _video(tmp_path / "first.insv", FRONT, BACK, trailer=TRAILER)
    extract(first, tmp_path / "frames", EVERY)
    tree = json.loads((tmp_path / "frames" / FACTORY_FILE).read_text())
    assert tree["text"] == made.ONE_R and tree["camera"] == "Insta360 OneR"
    extract(_video(tmp_path / "second.mp4", FRONT, BACK), tmp_path / "frames", EVERY, replace=True)
    assert not (tmp_path / "frames" / FACTORY_FILE).exists()


def test_a_gyro_of_another_recording_is_left_alone_in_a_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    other = made.trailer(made.usual_records(first_frame=4_000_000))  # its readings begin later
    video = _video(tmp_path / "v.insv", FRONT, BACK, trailer=other)
    caplog.set_level(logging.INFO)
    assert read_gyro(None, video) is None
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == 1 and lines[0].startswith("no gyro: ")
    assert "from 0.990 to 1.489 s" in lines[0] and "of another recording" in lines[0]


@pytest.mark.parametrize("spoiled", ["lenses", "middle", "end"])
def test_a_damaged_trailer_loses_no_pictures(tmp_path: Path, spoiled: str) -> None:
    """Without lenses by the maker those of the circles are taken, as for other cameras."""
    lenses = made.ONE_R.replace("3040", "oops") if spoiled == "lenses" else made.ONE_R
    content = bytearray(made.trailer(made.usual_records(lenses=lenses)))
    if spoiled == "middle":
        content[-80:-72] = b"\xff" * 8
    video = _video(tmp_path / "v.insv", FRONT, BACK, trailer=bytes(content))
    if spoiled == "end":
        video.write_bytes(video.read_bytes()[:-9])
    extract(video, tmp_path / "frames", EVERY)
    assert not (tmp_path / "frames" / FACTORY_FILE).exists()
    assert sorted(path.name for path in (tmp_path / "frames/back").iterdir())[-1] == "000009.jpg"


def test_black_pictures_are_refused_in_one_line(tmp_path: Path) -> None:
    black = np.zeros((SIDE, 2 * SIDE, 3), np.uint8)
    video = _video(tmp_path / "v.insv", black, trailer=TRAILER)
    with pytest.raises(GsbaError, match=r"v\.insv: its frames are black .*lenses were not covered"):
        extract(video, tmp_path / "frames", EVERY)
    assert not list((tmp_path / "frames").iterdir())


@pytest.mark.skipif(not made.REAL.is_file(), reason="../shared/data/real is not there")
def test_a_real_file_is_refused_for_its_darkness_and_its_gyro_is_listed(tmp_path: Path) -> None:
    asked = ["refine", made.REAL, "--no-trajectory", "--out", tmp_path / "run"]
    result = run_gsba(*asked)
    lines = result.output.strip().splitlines()
    assert result.exit_code == 1 and "its frames are black" in lines[-1]
    assert any("sample.insv: gyro, 1178 readings at 1000 Hz" in line for line in lines)
