"""The observations of a block as its kernels read them."""

from typing import NamedTuple

import numpy as np

BEARING, REPROJECTION = 0, 1  # kinds of measurement


class Observations(NamedTuple):
    """All observations of a block, sorted by landmark, then frame."""

    offsets: np.ndarray  # (J + 1,) int64: landmark j owns rows offsets[j]:offsets[j + 1]
    frames: np.ndarray  # (O,) int32, row of the poses
    kinds: np.ndarray  # (O,) uint8, BEARING or REPROJECTION
    families: np.ndarray  # (O,) uint8, whose cost it counts to
    measurements: np.ndarray  # (O, 3): unit bearing, rig frame | u, v in pixels, row of cameras
    whiteners: np.ndarray  # (O, 3): [s00, s01, s11] of the upper triangular 2x2 sqrt information
    cameras: np.ndarray  # (C, 12): [rig_R_face row-major (9), focal, principal u, v in pixels]
    loss: int  # code of the robust loss
    loss_scale: float
