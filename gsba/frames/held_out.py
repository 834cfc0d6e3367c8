"""Panoramas held out of the training of splats, on which splats are evaluated."""

import numpy as np

HOLD_OUT_EVERY = 8  # one panorama of so many: the interval of splat benchmarks and trainers


def held_out_rows(num: int, every: int = HOLD_OUT_EVERY, at_least: int = 0) -> np.ndarray:
    """Rows (H,) of `num` frames to hold out, evenly spread: one of each `every` begun, or more."""
    count = min(max(-(-num // every), at_least), num)
    return (2 * np.arange(count) + 1) * num // max(2 * count, 1)
