"""Panoramas out of pictures of two fisheyes: they show what the lenses saw, in all widths."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from plain_records import frames_of
from two_fisheyes import colours, made_pair, picture, write

from gsba.camera.sphere import erp_directions
from gsba.frames import raw_pairs
from gsba.frames.dual_fisheye import clear_of_seam, load_joined, load_raw, width_of
from gsba.frames.files import decode
from gsba.frames.pixels import load_erp
from gsba.types import FrameSet, PictureFormat

PAIR = made_pair()
WIDTHS = [416, 360, 302, 300, 210, 130]  # the first as dense as the pictures; not all by 4


def _frames(paths: list[tuple[Path, ...]]) -> FrameSet:
    width = width_of(PAIR)
    return frames_of(PictureFormat("fisheye", width, width // 2, fisheyes=PAIR), paths)


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> FrameSet:
    """One frame of two files, and the same side by side."""
    folder = tmp_path_factory.mktemp("pair")
    shown = [picture(lens) for lens in PAIR]
    front, back = (
        write(folder / name / "0.png", rgb)
        for name, rgb in zip(("front", "back"), shown, strict=True)
    )
    both = write(folder / "both.png", np.concatenate(shown, axis=1))
    return _frames([(front, back), (both, both)])


def _true(width: int) -> np.ndarray:
    """The panorama of the sphere, (width / 2, width, 3)."""
    return colours(erp_directions(width))


def test_the_widest_panorama_is_as_dense_as_the_pictures(frames: FrameSet) -> None:
    assert frames.format.width == WIDTHS[0]
    assert abs(frames.format.width / (2 * np.pi) - PAIR[1].focal) < 8 / (2 * np.pi)


@pytest.mark.parametrize("width", WIDTHS)
def test_panoramas_are_what_the_lenses_saw(frames: FrameSet, width: int) -> None:
    true, found = _true(width), load_joined(frames, 0, False, width)
    assert found.shape == (width // 2, width, 3) and found.dtype == np.uint8
    off = np.abs(found - true)
    assert off.mean() < 0.5  # of grey levels: 0.3 is what rounding to whole ones leaves
    ahead = np.cos(2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5))
    nearest = np.argsort(np.abs(ahead))[:8]  # columns on either side of both seams
    assert off[:, nearest].mean() < 1.6 * off.mean()


@pytest.mark.parametrize("width", WIDTHS)
def test_no_jump_on_the_seam(frames: FrameSet, width: int) -> None:
    """Steps from column to column are those of the sphere, from one lens to the other as well."""
    found = load_joined(frames, 0, True, width).astype(np.float64)
    weights = np.array([0.299, 0.587, 0.114])
    true = _true(width) @ weights
    steps, expected = (np.roll(image, -1, axis=1) - image for image in (found, true))
    off = np.abs(steps - expected).mean(axis=0)
    assert off.max() < 1.0  # 0.4 is rounding


def test_a_shifted_lens_does_jump(frames: FrameSet) -> None:
    """What the tests above measure is there to be seen."""
    blunt = [decode(path, (240, 240)) for path in frames.paths[0]]
    folder = frames.paths[0][0].parent
    aside = write(folder / "aside.png", np.roll(blunt[1], 4, axis=1))
    found = load_joined(_frames([(frames.paths[0][0], aside)]), 0, False, WIDTHS[0])
    assert np.abs(found - _true(WIDTHS[0])).mean() > 2


@pytest.mark.parametrize("gray", [False, True])
def test_side_by_side_is_the_same(frames: FrameSet, gray: bool) -> None:
    for one, other in zip(load_raw(frames, 0, gray), load_raw(frames, 1, gray), strict=True):
        assert one.shape[:2] == (240, 240) and one.ndim == (2 if gray else 3)
        np.testing.assert_array_equal(one, other)
    one, other = (load_joined(frames, f, gray, 300) for f in (0, 1))
    np.testing.assert_array_equal(one, other)


def test_side_by_side_is_decoded_once(frames: FrameSet, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Path] = []
    decode = raw_pairs.decode

    def counted(path: Path, *rest) -> np.ndarray:
        seen.append(path)
        return decode(path, *rest)

    monkeypatch.setattr(raw_pairs, "decode", counted)
    load_raw(frames, 1)
    assert seen == [frames.paths[1][0]]
    load_raw(frames, 0)
    assert seen[1:] == list(frames.paths[0])


def test_grey_is_that_of_the_colours(frames: FrameSet) -> None:
    colour, gray = (load_joined(frames, 0, how, 300) for how in (False, True))
    expected = cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY).astype(int)
    assert gray.shape == (150, 300) and np.abs(gray - expected).max() <= 3


def test_no_panorama_is_wider_than_the_pictures_are_dense(frames: FrameSet) -> None:
    assert load_erp(frames, 0).shape == (208, 416, 3)
    assert load_erp(frames, 0, width=1000).shape == (208, 416, 3)
    assert load_erp(frames, 0, gray=True, width=130).shape == (65, 130)


def test_the_seam_is_where_both_lenses_end() -> None:
    clear = clear_of_seam(180, made_pair())
    assert clear.shape == (180, 360) and not clear.flags.writeable
    columns = np.flatnonzero(~clear[90])
    np.testing.assert_array_equal(columns, [88, 89, 90, 91, 268, 269, 270, 271])
