"""Medians of pictures: those of numpy."""

import numpy as np
import pytest

from gsba.masks.fixed_structure import median_picture


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.float32, np.float64])
@pytest.mark.parametrize("num", [1, 2, 3, 7, 20, 31, 32, 33])
def test_medians_are_those_of_numpy(num: int, dtype: type) -> None:
    """Equal to the last bit, of even and odd numbers, with equal values among them."""
    rng = np.random.default_rng(num)
    pictures = np.rint(rng.normal(100, 20, (num, 90, 101, 3))).clip(0, 255).astype(dtype)
    found, expected = median_picture(pictures), np.median(pictures, axis=0)
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)
