"""Masks of exported images: where readers look for them, and images painted where they hide."""

from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Literal

import numpy as np

Paint = Literal["files", "alpha", "black"]  # mask files alone; or images are painted, too


@dataclass(frozen=True, slots=True)
class MaskStyle:
    """Paths and values of a dataset's masks, and whether its images are painted by them."""

    paint: str = "files"  # one of Paint
    path: str = ""  # pattern of a mask's path, by `folder` and `stem` of its image; "" = by format
    hidden: int = 0  # value of pixels to ignore; those to use have 255 less this

    @property
    def paints(self) -> bool:
        """True if images are painted."""
        return self.paint != "files"

    def path_beside(self, image: str) -> str:
        """Path of the mask of an image, where `path` gives it."""
        path = PurePosixPath(image)
        return self.path.format(folder=path.parent, stem=path.stem)

    def painted(self, image: np.ndarray, used: np.ndarray) -> np.ndarray:
        """Image (h, w, 3) uint8, black where it is not used (h, w) bool; with `alpha` it has a
        fourth channel, 0 = ignore, 255 = use."""
        black = image * used[..., None]
        if self.paint == "black":
            return black
        return np.dstack([black, used.astype(np.uint8) * np.uint8(255)])

    def drawn(self, used: np.ndarray) -> np.ndarray:
        """Content (h, w) uint8 of a mask file for pixels to use (h, w) bool."""
        values = np.array([self.hidden, 255 - self.hidden], np.uint8)
        return values[used.astype(np.uint8)]


MASK_FILES = MaskStyle()  # mask files alone, as most readers want them
