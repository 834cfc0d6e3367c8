"""Covariances of poses whose observations err together within a frame."""

from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
from scipy.stats import chi2
from synthetic import RIG, World, drifted, make_world, unit

from gsba.bundle import adjustment, residual_correlation
from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.families import Bearings, Families
from gsba.bundle.trajectory_prior import TrajectoryPrior
from gsba.config import RefineSettings
from gsba.geometry import furthest
from gsba.types import Solution

SIGMA = 5e-4  # radians
SEEDS = range(8)
FRAME = 5


def _world(seed: int) -> World:
    return make_world(seed, num_points=2000, sigma_rad=SIGMA, false_share=0.0)


def _shifted(world: World, seed: int) -> World:
    """Bearings of a frame that are within some 10 degrees of one another are shifted alike."""
    rng = np.random.default_rng(seed)
    bearings, starts = world.keypoints.bearings_rig.copy(), world.keypoints.starts
    for first, last in pairwise(starts):
        centres = unit(rng.normal(size=(150, 3)))
        nearest = np.argmax(bearings[first:last] @ centres.T, axis=1)
        bearings[first:last] += rng.normal(0, SIGMA, centres.shape)[nearest]
    return replace(world, keypoints=replace(world.keypoints, bearings_rig=unit(bearings)))


def _squared_error_and_ratio(world: World) -> tuple[float, float]:
    """Squared error of a frame over its covariance; the ratio of variances."""
    settings, coarse = RefineSettings(), drifted(world.world_T_rigs, np.random.default_rng(0), 0.1)
    families = Families((Bearings(), TrajectoryPrior(coarse, settings.priors)))
    context = AdjustmentContext(families, RIG, settings, 1)
    start = Solution.without_points(coarse)
    solved = adjustment.adjust(world.tracks, world.keypoints, start, context, (40.0, 8.0, 8.0))
    covariances, _ = adjustment.pose_covariances(solved, world.keypoints, context)
    ends = [
        [gtsam.Pose3(poses[0]).between(gtsam.Pose3(poses[FRAME])), furthest(poses[:, :3, 3])[1]]
        for poses in (world.world_T_rigs, solved.world_T_rigs)
    ]
    (true, length), (found, own) = ends
    found = gtsam.Pose3(found.rotation(), found.translation() * length / own)
    error = gtsam.Pose3.Logmap(true.between(found))
    squared = error @ np.linalg.solve(covariances[FRAME], error)
    ratio = residual_correlation.variance_ratio(solved, world.keypoints, context)
    return float(squared), ratio


def test_independent_residuals_leave_covariances_as_they_are() -> None:
    assert max(_squared_error_and_ratio(_world(seed))[1] for seed in SEEDS[::2]) < 1.15


def test_errors_of_residuals_that_err_together_are_as_large_as_claimed() -> None:
    """Sums of squared errors follow chi-square with the ratio, and not without it."""
    found = [_squared_error_and_ratio(_shifted(_world(seed), seed)) for seed in SEEDS]
    squared, ratios = np.array(found).T
    low, high = chi2.ppf([1e-3, 1 - 1e-3], 6 * len(SEEDS))
    assert squared.sum() > high
    assert low < (squared / ratios).sum() < high
