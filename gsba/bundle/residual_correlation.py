"""Residuals that err together within a frame, by which covariances of independent ones grow."""

import logging

import numpy as np

from factors.robust import RobustLoss
from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.shared_parameters import weighted_at
from gsba.bundle.tracks import map_runs
from gsba.camera.rig import cells_of
from gsba.types import Keypoints, Solution, Tracks

logger = logging.getLogger(__name__)

_CELLS_PER_SIDE = 3  # of 30 degrees
_CELLS = 6 * _CELLS_PER_SIDE**2


def variance_ratio(solution: Solution, keypoints: Keypoints, context: AdjustmentContext) -> float:
    """Variance of poses over that which residuals independent of one another give, at least 1.

    A codec, denoising or a lens that is modelled roughly shifts neighbouring points of a frame
    alike. Gradients by the frame's pose are summed over cells of directions. The sums' covariance
    over that of independent observations is the ratio: a cluster-robust ("sandwich") covariance,
    Liang and Zeger, Biometrika 73(1), 1986. The median over frames, each with the mean of its six
    parameters, is returned; what shifts whole frames alike shows in none of them.
    """
    points_world, num_frames = solution.landmarks.points_world, len(solution.world_T_rigs)

    def work(points: slice, rows: slice, some: Tracks) -> tuple[np.ndarray, ...]:
        return _gradients(points_world[points], some, keypoints, solution, context.solver.loss)

    gradients = np.zeros((num_frames, _CELLS, 6))
    information, alone = np.zeros((2, num_frames, 6, 6))
    for found in map_runs(work, solution.landmarks.tracks, context.num_threads):
        for target, more in zip((gradients, information, alone), found, strict=True):
            target += more
    usable = solution.observations() >= 100  # of a frame
    if np.count_nonzero(usable) < 3:
        return 1.0
    together = np.einsum("fci,fcj->fij", gradients[usable], gradients[usable])
    inverses = np.linalg.pinv(information[usable], hermitian=True)
    squares = [np.sum(inverses * one, axis=(1, 2)) for one in (together, alone[usable])]
    ratios = squares[0] / np.maximum(squares[1], 1e-300)
    ratio = max(float(np.median(ratios)), 1.0)
    logger.debug("residuals of a frame err together: sigmas of poses times %.2f", ratio**0.5)
    return ratio


def _gradients(
    points_world: np.ndarray,
    tracks: Tracks,
    keypoints: Keypoints,
    solution: Solution,
    loss: RobustLoss,
) -> tuple[np.ndarray, ...]:
    """Of observations of points (J, 3), without what moves of the points take up: gradients by
    poses summed in each cell (F, C, 6), information on poses (F, 6, 6), and the sum of each
    observation's gradient times itself (F, 6, 6)."""
    frames, numbers, num_frames = tracks.frames, tracks.points, len(solution.world_T_rigs)
    seen = weighted_at(points_world, tracks, keypoints, solution, loss)
    residuals = np.einsum("oij,oj->oi", seen.roots, seen.residuals)
    by_pose, by_point = seen.roots @ seen.by_pose, seen.roots @ seen.by_point
    information = np.zeros((len(points_world), 3, 3))
    np.add.at(information, numbers, np.swapaxes(by_point, 1, 2) @ by_point)
    covariances = np.linalg.pinv(information, rcond=1e-12, hermitian=True)
    # residuals' covariance once their points are solved for, in units of independent ones
    left = np.eye(2) - by_point @ covariances[numbers] @ np.swapaxes(by_point, 1, 2)
    projected = np.swapaxes(by_pose, 1, 2) @ left
    each = np.einsum("oij,oj->oi", projected, residuals)
    gradients = np.zeros((num_frames, _CELLS, 6))
    information, alone = np.zeros((2, num_frames, 6, 6))
    cells = cells_of(keypoints.bearings_rig[seen.rows], _CELLS_PER_SIDE)
    np.add.at(gradients, (frames, cells), each)
    np.add.at(information, frames, projected @ by_pose)
    np.add.at(alone, frames, each[:, :, None] * each[:, None, :])
    return gradients, information, alone
