"""Raw fisheyes of an export: each lens's picture in a file of its own, as trainers read it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from plain_records import frames_of
from two_fisheyes import made_pair, picture, write

from gsba.export.images import write_pictures
from gsba.export.pictures import Files
from gsba.export.raw import RawPictures
from gsba.types import FrameSet, PictureFormat

PAIR = made_pair(120)


def _frames(folder: Path, layout: str) -> tuple[FrameSet, list[np.ndarray]]:
    """One frame of two lenses, and their pictures."""
    shown = [picture(lens) for lens in PAIR]
    if layout == "beside":
        paths = (write(folder / "0.png", np.concatenate(shown, axis=1)),) * 2
    else:
        paths = (folder / f"0_00.{layout}", folder / f"0_10.{layout}")
        for path, pixels in zip(paths, shown, strict=True):
            Image.fromarray(pixels).save(path, **({"lossless": True} if layout == "webp" else {}))
    form = PictureFormat("fisheye", 240, 120, fisheyes=PAIR)
    return frames_of(form, [paths], names=["frame_0000"]), shown


@pytest.mark.parametrize("layout", ["png", "beside", "tif", "webp"])
def test_each_lens_has_a_picture_of_its_own(tmp_path: Path, layout: str) -> None:
    frames, shown = _frames(tmp_path, layout)
    suffix = "jpg" if layout == "webp" else "png"
    files = Files(tmp_path, "01", "out{view}{suffix}", "mask{view}.png")
    write_pictures(frames, [[RawPictures(files, link=True)]])
    for lens, wanted in enumerate(shown):
        read = pycolmap.Bitmap.read(tmp_path / f"out{lens}.{suffix}", True)
        found = read.to_array()
        assert found.shape == wanted.shape
        off = np.abs(found.astype(int) - wanted)
        assert off.mean() < 3 if layout == "webp" else off.max() == 0
        with Image.open(tmp_path / f"mask{lens}.png") as mask:
            assert mask.size == (120, 120)
    linked = layout == "png"
    assert (tmp_path / f"out0.{suffix}").samefile(frames.paths[0][0]) == linked


def test_masks_are_the_image_circles_of_each_frames_own_camera(tmp_path: Path) -> None:
    """Of frames without masks of their own, which share the encoded masks of their camera."""
    pairs = made_pair(120), made_pair(100)
    kinds = tuple(PictureFormat("fisheye", 2 * p[0].width, p[0].width, fisheyes=p) for p in pairs)
    paths = [
        tuple(write(tmp_path / f"{f}_{n}.png", picture(lens)) for n, lens in enumerate(pair))
        for f, pair in enumerate(pairs)
    ]
    frames = replace(frames_of(kinds[0], paths), formats=kinds, camera_of_frame=(0, 1))
    files = Files(tmp_path, "01", "out{name}{view}{suffix}", "mask{name}{view}.png")
    write_pictures(frames, [[RawPictures(files)] * 2])
    for f, pair in enumerate(pairs):
        with Image.open(tmp_path / f"mask{f}0.png") as mask:
            assert mask.size == (pair[0].width, pair[0].height)
