"""What `gsba info` says of footage: layouts, times, sensors, and the line that refines it."""

import json
import shlex
import shutil
import sys
from pathlib import Path

import cv2
import insta360_files as made
import numpy as np
import pytest
from command import run_gsba, succeed
from PIL import Image
from two_fisheyes import made_pair, picture
from video_files import encode, steady

from gsba.frames.scan import scan
from gsba.inspection import Inspection, footage, inspect
from gsba.log import GsbaError

REAL = Path(__file__).parents[3] / "shared/data/real"
WIDTH = 128


def _facts(found: Inspection) -> dict[str, str]:
    return dict(found.facts)


def _panoramas(folder: Path, num: int = 4) -> Path:
    folder.mkdir()
    rng = np.random.default_rng(3)
    for n in range(num):
        pixels = rng.integers(60, 250, (WIDTH // 2, WIDTH, 3), np.uint8)
        exif = Image.Exif()
        exif[271], exif[272] = "GoPro", "GoPro Max"
        exif.get_ifd(0x8769)[0x9003] = f"2024:05:01 10:00:{n:02d}"
        exif.get_ifd(0x8825).update({1: "N", 2: (48.0, 10.0, n), 3: "E", 4: (11.0, 30.0, 0.0)})
        Image.fromarray(pixels).save(folder / f"pano{n}.jpg", exif=exif)
    return folder


def test_a_run_tells_its_result_or_how_to_go_on(plain_run: Path, tmp_path: Path) -> None:
    found = inspect(plain_run)
    verdict = json.loads((plain_run / "report.json").read_text())["verdict"]["sentence"]
    assert _facts(found)["verdict"] == verdict and not found.problem
    assert found.command == shlex.join(["gsba", "view", str(plain_run)])
    copy = Path(shutil.copytree(plain_run, tmp_path / "stopped"))
    (copy / "report.json").unlink()
    stopped = inspect(copy)
    assert "not finished: the call that began it, with the same options" in _facts(stopped)["run"]
    assert not stopped.command  # one without its options would be another run


def test_panoramas_with_tags(tmp_path: Path) -> None:
    found = inspect(_panoramas(tmp_path / "tour"))
    assert _facts(found) == {
        "camera": "GoPro GoPro Max",
        "layout": f"stitched panoramas, files of {WIDTH}x{WIDTH // 2}",
        "frames": "4, one every 1 s, 3 s",
        "GPS": "4 of 4 frames have a position (--gps exif)",
    }
    assert not found.problem
    assert found.command == shlex.join(["gsba", "refine", str(tmp_path / "tour")])


def test_data_whose_reader_is_absent_are_not_checked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "telemetry_parser", None)
    (tmp_path / "walk.mp4").write_bytes(bytes(64))
    for known, name in ((footage._gyro, "gyro"), (footage._gps, "GPS")):
        wanted = f"not checked: reading its {name} needs telemetry-parser: pip install"
        assert known(tmp_path / "walk.mp4").startswith(wanted)


def test_raw_pairs_and_their_lenses(tmp_path: Path) -> None:
    for name, lens in zip(("front", "back"), made_pair(), strict=True):
        (tmp_path / name).mkdir()
        for n in range(3):
            path = tmp_path / name / f"{n}.png"
            cv2.imwrite(str(path), np.ascontiguousarray(picture(lens)[..., ::-1]))
    facts = _facts(inspect(tmp_path))
    assert facts["layout"] == "raw, two fisheyes a frame, files of 240x240"
    assert facts["frames"] == "3, in the order of their names: they have no times"
    lenses = scan(tmp_path, order_suffices=True).format.fisheyes
    assert lenses is not None
    for name, lens in zip(("front lens", "back lens"), lenses, strict=True):
        assert facts[name].startswith(f"focal length {lens.focal:.1f} px")


def test_what_would_be_refused_says_why(tmp_path: Path) -> None:
    two = inspect(_panoramas(tmp_path / "two", 2))
    assert "at least 3 are needed" in two.problem and not two.command
    assert "refused: " in two.text()
    one = inspect(tmp_path / "two/pano0.jpg")
    assert _facts(one)["size"] == f"{WIDTH}x{WIDTH // 2}" and "is one image" in one.problem


def test_neither_footage_nor_there(tmp_path: Path) -> None:
    for name in ("notes.txt", "GS01.36P"):
        (tmp_path / name).write_text("hello")
    refused = ("notes.txt", "no video, image or folder"), ("GS01.36P", "GoPro .36P is not read")
    for name, why in (*refused, ("nowhere", "no such file")):
        with pytest.raises(GsbaError, match=why):
            inspect(tmp_path / name)


def test_a_video_with_all_that_its_maker_appends(tmp_path: Path) -> None:
    pytest.importorskip("av", reason="PyAV is not installed")
    path = tmp_path / "VID_20240101_120000_00_001.insv"
    both = np.concatenate([picture(lens) for lens in made_pair(144)], axis=1)
    trailer = made.trailer(made.usual_records())
    encode(path, ([both] * 12, steady(12)), container_format="mp4", trailer=trailer)
    found = inspect(path)
    facts = _facts(found)
    assert facts["camera"] == "Insta360 OneR, firmware v2.0.0"
    assert facts["layout"] == "raw, two fisheyes, side by side of 288x144"
    assert facts["frames"] == "12, 30 a second, 0.4 s"
    assert facts["gyro"] == "500 readings at 1000 Hz with accelerometer"
    assert facts["GPS"].startswith("1 fix")
    assert facts["exposures"] == "15, 10 to 20 ms"
    assert facts["calibration"].startswith("by the maker")
    assert found.command == f"gsba refine {path}"


def test_the_command_prints_text_or_json(tmp_path: Path) -> None:
    folder = _panoramas(tmp_path / "tour")
    shown = succeed("--quiet", "info", folder)
    assert f"gsba refine {folder}" in shown.stdout
    tables = json.loads(run_gsba("info", "--json", folder).stdout)
    assert tables[0]["facts"]["camera"] == "GoPro GoPro Max"
    nowhere = run_gsba("info", tmp_path / "nowhere")
    assert nowhere.exit_code == 1 and "no such file" in nowhere.stderr


@pytest.mark.skipif(not REAL.is_dir(), reason="shared/data/real is absent")
@pytest.mark.parametrize(
    ("name", "layout"),
    [
        ("fusion_wood", "raw, two fisheyes a frame"),
        ("max_eac", "equi-angular cube map"),
        ("max_eac/STITCHED", "stitched panoramas"),
        ("gear360_atv/1280_720_2500k.mp4", "raw, two fisheyes, side by side"),
        ("insv_one_r/sample.insv", "raw, two fisheyes, side by side"),
    ],
)
def test_real_footage_is_told(name: str, layout: str) -> None:
    assert _facts(inspect(REAL / name))["layout"].startswith(layout)


def test_one_raw_still_shows_its_layout_and_circles(tmp_path: Path) -> None:
    front, back = (picture(lens) for lens in made_pair())
    cases = {
        "one.png": (front, "raw, one fisheye", ["lens circle"]),
        "beside.png": (
            np.concatenate([front, back], 1),
            "raw, two fisheyes side by side",
            ["left circle", "right circle"],
        ),
        "stacked.png": (
            np.concatenate([front, back]),
            "raw, two fisheyes one above the other",
            ["upper circle", "lower circle"],
        ),
    }
    for name, (pixels, layout, circles) in cases.items():
        cv2.imwrite(str(tmp_path / name), np.ascontiguousarray(pixels[..., ::-1]))
        facts = _facts(inspect(tmp_path / name))
        assert facts["layout"] == layout
        assert all(facts[circle].startswith("radius 1") for circle in circles)
