"""Fit of pictures' poses, and of the cameras they share, to known points; with covariances."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from factors import RobustLoss
from gsba.bundle.optimizer import marginal_covariances, optimize
from gsba.bundle.pose_variables import X
from gsba.camera.projections import Projection
from gsba.config import SolverSettings
from gsba.localization.known_points import K, KnownPointBlock, PointSightings, num_parameters
from gsba.types.records import with_rows

GATE_SIGMAS = 3.5  # of an inlier's residual
COARSE = (8.0,)  # scales of the loss, round by round, standard deviations, of a first fit
FINE = (2.0, 1.0)  # of the last one
_KNOWN_NOISE = 2.0  # scale of the loss from which on residuals tell of the noise
_MEDIAN_OF_SQUARES = 1.3863  # of a chi-square distribution with two degrees of freedom
_MAX_POSITION_SIGMA = 0.05  # of a determined position, in median distances of points
_MIN_NOISE = 0.5  # of keypoints, in their own standard deviations
_SOLVER = SolverSettings(max_iterations=20, relative_tolerance=1e-5, absolute_tolerance=1e-2)


@dataclass(frozen=True, slots=True)
class CameraPrior:
    """Prior on the parameters of a camera."""

    step: np.ndarray  # (K,) step from the initial projection to the one expected
    sigmas: np.ndarray  # (K,) standard deviations of its parameters


@dataclass(frozen=True, slots=True)
class PoseFit:
    """Poses of pictures, and cameras, fitted together."""

    world_T_rigs: np.ndarray  # (P, 4, 4) float64, map units
    covariances: np.ndarray  # (P, 6, 6), tangent [rotation rad, translation], NaN = not determined
    inliers: tuple[np.ndarray, ...]  # (P) of (N,) bool
    noises: np.ndarray  # (P,) of keypoints, in their own standard deviations
    projections: tuple[Projection, ...]  # (C) of the cameras
    camera_covariances: np.ndarray  # (C, 6, 6), of the projection's parameters, zero beyond these


def fit(
    pictures: Sequence[PointSightings],
    starts: np.ndarray,
    scales: Sequence[float],
    projections: Sequence[Projection] = (),
    priors: Sequence[CameraPrior] = (),
) -> PoseFit:
    """Minimise the robust residuals of known points over poses and cameras.

    Args:
        pictures: sightings of each picture (P); many may be false.
        starts: (P, 4, 4) initial world_T_rigs.
        scales: of the loss, round by round.
        projections: (C) initial cameras.
        priors: (C) on their parameters.
    """
    values, graph = gtsam.Values(), gtsam.NonlinearFactorGraph()
    for p, start in enumerate(starts):
        values.insert(X(p), gtsam.Pose3(start))
    for c, (projection, prior) in enumerate(zip(projections, priors, strict=True)):
        values.insert(K(c), np.zeros(num_parameters(projection)))
        noise = gtsam.noiseModel.Diagonal.Sigmas(prior.sigmas)
        graph.push_back(gtsam.PriorFactorVector(K(c), prior.step, noise))
    noises = np.ones(len(pictures))
    for scale in scales:
        block = _block(pictures, noises, projections, scale)
        values = optimize(graph, values, [block], _SOLVER).values
        squares = block.squared_residuals(values)
        if scale <= _KNOWN_NOISE:
            noises = np.array([_rescaled(*pair) for pair in zip(noises, squares, strict=True)])
    squares = _block(pictures, noises, projections, scales[-1]).squared_residuals(values)
    inliers = tuple(part < GATE_SIGMAS**2 for part in squares)
    kept = [with_rows(*pair) for pair in zip(pictures, inliers, strict=True)]
    block = _block(kept, noises, projections, GATE_SIGMAS, "none")
    block.refresh(values)
    cameras = [K(c) for c in range(len(projections))]
    keys = [X(p) for p in range(len(pictures))]
    covariances, _ = marginal_covariances(graph, [block], values, keys, beside=cameras)
    num = len(pictures)
    poses = np.array([values.atPose3(key).matrix() for key in keys])
    found = tuple(block.projections(values))
    return PoseFit(poses, covariances[:num], inliers, noises, found, covariances[num:])


def is_determined(
    world_T_rig: np.ndarray, covariance: np.ndarray, points_world: np.ndarray
) -> bool:
    """True if a pose (4, 4) with a covariance (6, 6) is precise, relative to the distances of the
    points (N, 3) that it was fitted to."""
    if not len(points_world) or not np.isfinite(covariance).all():
        return False
    depth = float(np.median(np.linalg.norm(points_world - world_T_rig[:3, 3], axis=1)))
    return bool(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]) <= _MAX_POSITION_SIGMA * depth)


def _block(
    pictures: Sequence[PointSightings],
    noises: np.ndarray,
    projections: Sequence[Projection],
    scale: float,
    loss: str = "cauchy",
) -> KnownPointBlock:
    """Block of pictures whose keypoints are `noises` (P,) times as noisy as they claim."""
    scaled = [
        replace(seen, spreads=noise**2 * seen.spreads)
        for seen, noise in zip(pictures, noises, strict=True)
    ]
    return KnownPointBlock(scaled, projections, RobustLoss(loss, scale))  # type: ignore[arg-type]


def _rescaled(noise: float, squares: np.ndarray) -> float:
    """Noise of a picture's keypoints after a fit with squared residuals (N,)."""
    near = squares[squares < GATE_SIGMAS**2]
    if not len(near):
        return noise
    return max(noise * float(np.sqrt(np.median(near) / _MEDIAN_OF_SQUARES)), _MIN_NOISE)
