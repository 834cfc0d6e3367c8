"""Arrays of patches and their sightings, as the kernels read and write them."""

from typing import NamedTuple

import numpy as np

# States of a sighting: aligned; without texture; masked; shifted too far; not converged in the
# allowed steps; uncorrelated.
ALIGNED, FLAT, MASKED, FAR, UNSTEADY, UNLIKE = 0, 1, 2, 3, 4, 5


class Templates(NamedTuple):
    """Patches cut from their reference frames, and precomputed terms of their alignment."""

    window: np.ndarray  # (n * n,) float64, weight of each pixel, at most 1
    prior: float  # weight of a deviation of the affine part, in grey values squared
    grey: np.ndarray  # (T, n * n) float32, weighted mean removed
    by_x: np.ndarray  # (T, n * n) float32, derivatives of grey
    by_y: np.ndarray  # (T, n * n) float32
    inverses: np.ndarray  # (T, 8, 8) float32, of the normal matrix of [shift, affine, gain, offset]
    states: np.ndarray  # (T,) uint8, ALIGNED where usable


class Sightings(NamedTuple):
    """Predicted sightings of templates, and the results of their alignment."""

    templates: np.ndarray  # (O,) int64, row of the template
    origins: np.ndarray  # (O, 3) float64, the template's plane patch, rig frame of the observing
    # frame
    spreads: np.ndarray  # (O, 3, 2) float64
    warps: np.ndarray  # (O, 6) float64, shift (2) and affine by columns (4): start, and result
    scores: np.ndarray  # (O,) float64, ZNCC
    variances: np.ndarray  # (O,) float64, of the residual, in the template's grey values
    states: np.ndarray  # (O,) uint8
