"""Patches are aligned to a small part of a pixel, as OpenCV aligns them, or named as lost."""

import cv2
import numpy as np
import pytest
from scipy import ndimage

from gsba.odometry.lucas_kanade import LEVELS, WINDOW, align_patches, pyramid

SIZE = 256


def _pair(shift: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """A smooth texture, and the same moved by `shift` pixels (u, v)."""
    rng = np.random.default_rng(3)
    texture = cv2.GaussianBlur(rng.normal(size=(SIZE, SIZE)), (0, 0), 2.5)
    texture = 128 + 45 * texture / texture.std()
    moved = ndimage.shift(texture, shift[::-1], order=5)
    return tuple(np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in (texture, moved))


def _grid() -> np.ndarray:
    u, v = np.meshgrid(np.linspace(60, SIZE - 60, 9), np.linspace(60, SIZE - 60, 9))
    return np.stack([u.ravel(), v.ravel()], axis=1) + 0.3


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.37, -0.81), (6.4, -9.7)])
def test_a_shift_is_found_to_a_small_part_of_a_pixel(shift: tuple[float, float]) -> None:
    one, other = _pair(shift)
    starts = _grid()
    ends, aligned, difference = align_patches(pyramid(one), pyramid(other), starts, starts, LEVELS)
    assert aligned.mean() > 0.95
    off = np.linalg.norm(ends - starts - shift, axis=1)[aligned]
    assert np.median(off) < 0.02
    assert np.quantile(off, 0.9) < 0.05
    assert difference[aligned].mean() < 3.0


def test_patches_go_where_those_of_opencv_go() -> None:
    one, other = _pair((2.6, 1.3))
    starts = _grid()
    ends, aligned, _ = align_patches(pyramid(one), pyramid(other), starts, starts, LEVELS)
    given = starts.astype(np.float32)[:, None]
    theirs, status, _ = cv2.calcOpticalFlowPyrLK(
        one, other, given, given.copy(), winSize=(WINDOW + 1,) * 2, maxLevel=LEVELS
    )
    both = aligned & (status[:, 0] > 0)
    assert both.mean() > 0.95
    assert np.median(np.linalg.norm(ends - theirs[:, 0], axis=1)[both]) < 0.05


def test_bare_patches_and_those_beyond_the_border_are_lost() -> None:
    one, other = _pair((0.5, 0.5))
    one[:100] = 90
    starts = np.array([[128.0, 50.0], [3.0, 180.0], [128.0, 180.0]])
    _, aligned, _ = align_patches(pyramid(one), pyramid(other), starts, starts, LEVELS)
    assert aligned.tolist() == [False, False, True]


def test_nothing_to_align_is_no_error() -> None:
    one, other = _pair((0.5, 0.5))
    ends, aligned, difference = align_patches(
        pyramid(one), pyramid(other), np.zeros((0, 2)), np.zeros((0, 2)), LEVELS
    )
    assert ends.shape == (0, 2)
    assert not len(aligned)
    assert not len(difference)
