"""Names of the two files of one recording."""

from pathlib import Path

import pytest

from gsba.frames.lens_names import lens_files


@pytest.mark.parametrize(
    ("front", "back"),
    [
        ("VID_20240101_120000_00_001.insv", "VID_20240101_120000_10_001.insv"),
        ("a_10_b_00_c.mp4", "a_10_b_10_c.mp4"),  # the last mark counts
        ("GPFR1234.MP4", "GPBK1234.MP4"),
        ("GF011234.MP4", "GB011234.MP4"),
        ("gf011234.mp4", "gb011234.mp4"),
        ("GPFR7152_img1.jpg", "GPBK7152_img1.jpg"),
    ],
)
def test_either_file_names_both(front: str, back: str) -> None:
    folder = Path("somewhere_00_x")
    expected = folder / front, folder / back
    assert lens_files(folder / front) == lens_files(folder / back) == expected


@pytest.mark.parametrize(
    "name", ["walk.mp4", "GS010001.360", "GX010001.MP4", "00_1.insv", "GFX.mp4"]
)
def test_other_names_are_of_one_file(name: str) -> None:
    assert lens_files(Path("a_00_b") / name) is None
