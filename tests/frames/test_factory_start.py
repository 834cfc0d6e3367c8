"""Raw frames that start from the maker's calibration: beside frames, or within pictures."""

import json
import logging
from pathlib import Path

import cv2
import insta360_files as made
import numpy as np
import pytest
from refusals import refused
from two_fisheyes import picture, write

from gsba.camera.factory_lenses import FactoryCalibration, parse_factory_lenses
from gsba.camera.fisheye import Pair, rotation_of
from gsba.frames.factory_start import FACTORY_FILE, write_factory_calibration
from gsba.frames.files import decode
from gsba.frames.scan import scan

SIDE, NUM = 240, 3
KNOWN = FactoryCalibration(made.ONE_R, "Insta360 OneR", (3040, 3040), (2880, 2880))
WINDOWED, WHOLE = parse_factory_lenses(KNOWN).pairs((SIDE, SIDE))


def _write(folder: Path, front: np.ndarray, back: np.ndarray) -> None:
    for number in range(NUM):
        write(folder / f"front/{number}.png", front)
        write(folder / f"back/{number}.png", back)


def _start(folder: Path, **more) -> Pair:
    found = scan(folder, fps=1, **more)
    assert found.format.layout == "fisheye" and found.format.fisheyes is not None
    return found.format.fisheyes


@pytest.mark.parametrize(
    ("true", "said"),
    [
        (WINDOWED, "directions 1.5 degrees, rotation between lenses 1.5), which both"),
        (WHOLE, "the whole sensor in the picture"),
    ],
)
def test_images_tell_which_part_of_the_sensor_they_show(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, true: Pair, said: str
) -> None:
    _write(tmp_path, *map(picture, true))
    write_factory_calibration(tmp_path, KNOWN)
    caplog.set_level(logging.INFO)
    assert _start(tmp_path) == true
    assert said in caplog.text and "which both lenses' rims confirm" in caplog.text
    assert "ignored" not in caplog.text


def test_images_tell_that_somebody_turned_them(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    front, back = map(picture, WINDOWED)
    _write(tmp_path, front, np.rot90(back))
    write_factory_calibration(tmp_path, KNOWN)
    found = _start(tmp_path)[1]
    between = rotation_of(WINDOWED[1]).T @ rotation_of(found)
    np.testing.assert_allclose(abs(between[:2, :2]), [[0, 1], [1, 0]], atol=1e-9)
    assert "the back lens turned by" in caplog.text


@pytest.mark.parametrize("level", [0, 90])
def test_images_that_tell_nothing_leave_the_usual_reading(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, level: int
) -> None:
    plain = np.full((SIDE, SIDE, 3), level, np.uint8)
    _write(tmp_path, plain, plain)
    write_factory_calibration(tmp_path, KNOWN)
    assert _start(tmp_path) == WINDOWED
    assert "unconfirmed by images" in caplog.text


@pytest.mark.parametrize("dark", [False, True])
def test_pictures_as_the_camera_wrote_them(tmp_path: Path, dark: bool) -> None:
    """JPEG with both lenses side by side, and a trailer."""
    both = np.concatenate([picture(lens) for lens in WINDOWED], axis=1)
    for number in range(NUM):
        pixels = both // 32 if dark else both
        write(tmp_path / f"{number}.jpg", pixels).rename(tmp_path / f"IMG_00_{number}.insp")
        with (tmp_path / f"IMG_00_{number}.insp").open("ab") as file:
            file.write(made.trailer(((1, 1, made.metadata()),)))
    assert _start(tmp_path) == WINDOWED
    read = decode(tmp_path / "IMG_00_1.insp", (2 * SIDE, SIDE))
    assert abs(read.astype(int) - pixels).mean() < 3


def test_a_calibration_that_is_given_goes_first(tmp_path: Path) -> None:
    _write(tmp_path, *map(picture, WINDOWED))
    (tmp_path / FACTORY_FILE).write_text("damaged, but not asked for")
    camera = {"width": SIDE, "height": SIDE, "f": 70.0, "cx": 120.0, "cy": 120.0, "k": [0] * 4}
    behind = np.diag([-1.0, 1, -1, 1]).tolist()
    lenses = {
        "front": camera | {"rig_T_lens": np.eye(4).tolist()},
        "back": camera | {"rig_T_lens": behind},
    }
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({"unit": "m", "lenses": lenses}))
    assert _start(tmp_path, calibration=path)[0].focal == 70.0


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        '{"text": 3}',
        '{"text": "2_1", "camera": "", "sensor": 4, "window": null}',
        "[" * 100_000,
    ],
)
def test_a_damaged_file_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    _write(tmp_path, *map(picture, WINDOWED))
    (tmp_path / FACTORY_FILE).write_text(text)
    refused(rf"{FACTORY_FILE}: is damaged: remove it", scan, tmp_path, fps=1)


def test_pictures_of_other_cameras_do_not_change(tmp_path: Path) -> None:
    """JPEG named so without a trailer: what they are is told by their circles."""
    both = np.concatenate([picture(lens) for lens in WINDOWED], axis=1)
    for number in range(NUM):
        encoded = cv2.imencode(".jpg", both[..., ::-1])[1].tobytes()
        (tmp_path / f"{number}.insp").write_bytes(encoded)
    assert _start(tmp_path) != WINDOWED
