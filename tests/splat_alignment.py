"""Poses of all frames brought to a fixed splat, from coarse faces to fine ones."""

from collections.abc import Sequence

import gtsam
import numpy as np

from gsba import optimize
from gsba.bundle.optimizer import SolverOptions
from gsba.bundle.pose_variables import poses_of, values_of
from gsba.camera.views import ONE_EYE, Optics
from gsba.splat.alignment import capture, splat_block
from gsba.splat.backend import Backend
from gsba.splat.gaussians import Gaussians
from gsba.types import FrameSet

_SOLVER = SolverOptions(max_iterations=15, relative_tolerance=1e-5, absolute_tolerance=None)


def align_to_splat(
    splat: Gaussians,
    frames: FrameSet,
    poses: np.ndarray,
    near: float,
    backend: Backend,
    sizes: Sequence[int],
    optics: Optics = ONE_EYE,
) -> np.ndarray:
    """Poses (F, 4, 4) after alignment at each size of a face, pixels."""
    every = np.arange(len(frames))
    for size in sizes:
        block = splat_block(splat, capture(frames, every, size, optics), near, backend)
        found = optimize(gtsam.NonlinearFactorGraph(), values_of(poses), [block], _SOLVER)
        poses = poses_of(found.values, len(every))
    return poses
