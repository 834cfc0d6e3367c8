"""Pictures to localise: panoramas of the run's camera."""

from pathlib import Path

import numpy as np

from gsba.frames.files import decode, image_size
from gsba.log import GsbaError


def load_panorama(path: Path) -> np.ndarray:
    """A panorama (H, 2H, 3) uint8 RGB.

    Raises:
        GsbaError: the file cannot be read, or is no 2:1 image.
    """
    width, height = image_size(path)
    if width != 2 * height:
        raise GsbaError(f"{path}: is {width}x{height}; a panorama is 2:1")
    return decode(path, (width, height))
