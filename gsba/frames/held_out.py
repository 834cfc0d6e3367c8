"""Panoramas held out of the training of splats, on which splats are evaluated."""

import numpy as np

from gsba.types.records import spread_rows

HOLD_OUT_EVERY = 8  # one panorama of so many: the interval of splat benchmarks and trainers


def held_out_rows(num: int, every: int = HOLD_OUT_EVERY, at_least: int = 0) -> np.ndarray:
    """Rows (H,) of `num` frames to hold out, evenly spread: one of each `every` begun, or more."""
    return spread_rows(num, min(max(-(-num // every), at_least), num))
