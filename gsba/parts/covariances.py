"""Covariances of a map in parts: selected inversion, from the cuts into the parts."""

from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from factors import RobustLoss
from gsba.parts.divided_system import DividedSystem
from gsba.store.shards import Workers
from gsba.types import JointErrors


@threadpool_limits.wrap(limits=1, user_api="blas")
def divided_covariances(
    folder: Path,
    workers: Workers,
    loss: RobustLoss,
    num_draws: int = 0,
    seed: int = 0,
    scratch: Path | None = None,
) -> tuple[np.ndarray, JointErrors]:
    """Marginal covariances of the poses of a map in parts, where it starts.

    As `gsba.bundle.optimizer.marginal_covariances`, which it equals within rounding where that
    factorizes; the errors drawn are other ones of the same distribution.

    Args:
        folder: of the map, from `folder.PartsWriter`, which was to `tie` neighbouring frames.
        num_draws: errors drawn of all poses at once, D.
        scratch: folder of the workers' own files; None = they have none.

    Returns:
        (F, 6, 6) float64, [rotation rad, translation], rig frame, and joint errors. NaN for one
        that nothing constrains, and for all where the rest is singular (the gauge is not fixed).

    Raises:
        GsbaError: the disk is full or damaged, or workers fail again and again.
    """
    system = DividedSystem(folder, workers, loss, scratch)
    num = system.num_frames
    steps = np.column_stack([np.arange(num - 1), np.arange(1, num)])
    found = system.covariances(steps, num_draws, seed)
    if found is None:
        nothing = np.full((num_draws, num, 6), np.nan, np.float32)
        return np.full((num, 6, 6), np.nan), JointErrors(np.full((num - 1, 6, 6), np.nan), nothing)
    inverse, between, drawn = found
    return inverse[:num], JointErrors(between, drawn[:, :num])
