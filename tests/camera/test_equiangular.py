"""The equi-angular cube map: every direction is found where both tracks show it."""

import cv2
import numpy as np
import pytest
from cube_map_tracks import picture_tracks
from pixels import pixel_centres
from synthetic import unit
from two_fisheyes import colours

from gsba.camera.equiangular import (
    Grid,
    around_squares,
    is_equiangular,
    overlap_of,
    square_directions,
    square_pixels,
    squares,
)
from gsba.types import FACES

SIZES = [(96, 4), (90, 6), (64, 0)]  # pixels of a square, columns that stand twice


def _directions(seed: int) -> np.ndarray:
    """Unit directions (N, 3): all over the sphere, along all edges of the cube, on the seam."""
    rng = np.random.default_rng(seed)
    anywhere = rng.normal(size=(4000, 3))
    edges = rng.uniform(-1, 1, (6000, 3))
    rows, axes = np.arange(6000), rng.permuted(np.tile([0, 1, 2], (6000, 1)), axis=1)
    edges[rows[:, None], axes[:, :2]] = rng.choice([-1, 1], (6000, 2))
    edges[rows, axes[:, 0]] *= 1 + rng.normal(size=6000) * 0.02
    seam = rng.normal(size=(4000, 3)) * [1, 1, 0.02]
    found = np.concatenate([anywhere, edges, seam])
    return found / np.linalg.norm(found, axis=1, keepdims=True)


@pytest.mark.parametrize(("size", "overlap"), SIZES)
def test_grids_reproduce_a_smooth_sphere(size: int, overlap: int) -> None:
    """With what lies beyond their borders, squares are continuous everywhere."""
    directions = _directions(1)
    grid, faces = Grid(size), squares(picture_tracks(size, overlap, colours))
    u, v = grid.places(directions).astype(np.float32).T[:, None]
    shown = cv2.remap(around_squares(faces), u, v, cv2.INTER_CUBIC)[0]
    off = np.abs(shown - colours(directions))
    assert off.max() < 3.0 and off.mean() < 0.5  # grey levels: 0.3 is rounding


def test_doubled_columns_pass_from_one_lens_to_the_other() -> None:
    """The front lens sees 200, the back one 100, each as far as its picture goes."""
    size, overlap = 96, 8
    width, half = 3 * size + 2 * overlap, (size + overlap) // 2
    front = np.zeros((2, size, width), bool)
    front[0, :, half : width - half] = True
    front[1, :, :half] = front[1, :, width - half :] = True
    first, second = np.where(front, 200, 100).astype(np.uint8)
    faces = squares((first, second))
    pixels = pixel_centres(size, size)
    for n in range(len(FACES)):
        ahead = square_directions(pixels, n, size)
        largest = np.abs(ahead).max(axis=-1)
        angle = np.arctan(ahead[..., 2] / largest)  # from the seam, as side squares count it
        share = np.clip(0.5 + angle / (np.pi / 2 * overlap / size), 0, 1)
        np.testing.assert_allclose(faces[n], 100 + 100 * share, atol=0.51)


def test_squares_and_directions_are_inverse() -> None:
    directions = _directions(2)
    faces, pixels = square_pixels(5 * directions, 100)
    assert pixels.min() > -1e-9 and pixels.max() < 100 + 1e-9
    for n in range(len(FACES)):
        back = unit(square_directions(pixels[faces == n], n, 100))
        np.testing.assert_allclose(back, directions[faces == n], atol=1e-12)


def test_the_size_of_a_track_tells_its_overlap() -> None:
    """Of GoPro MAX at 5.6K and 3K, of MAX 2 with 8 and 10 bits, and of the first firmware."""
    known = {(4096, 1344): 32, (2272, 736): 32, (5888, 1920): 64, (5952, 1920): 96, (4032, 1344): 0}
    assert {size: overlap_of(*size) for size in known} == known
    assert all(is_equiangular(*size) for size in known)
    for size in [(3840, 1920), (1920, 1080), (1376, 1344), (2273, 736), (2274, 736), (0, 0)]:
        assert not is_equiangular(*size), size
