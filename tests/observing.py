"""Reconstructions with some of their observations alone."""

from dataclasses import replace

import numpy as np

from gsba.types import Reconstruction


def observing(whole: Reconstruction, rows: np.ndarray, **changes: object) -> Reconstruction:
    """A reconstruction with some of its observations, rows (N,) int or bool, and other changes."""
    names = [f"observation_{name}" for name in ("points", "frames", "bearings", "sigmas")]
    return replace(whole, **{name: getattr(whole, name)[rows] for name in names} | changes)
