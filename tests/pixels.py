"""Pixels of pictures, as arrays."""

import numpy as np


def pixel_centres(width: int, height: int) -> np.ndarray:
    """Centres (H, W, 2) of the pixels of a picture."""
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
