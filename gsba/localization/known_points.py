"""Factor block of pictures that show known points: poses, and cameras that pictures share."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from factors import Block, PoseSystem, RobustLoss, tangent_basis
from gsba.bundle.adjustment import MIN_NOISE
from gsba.bundle.optimizer import SolverOptions, marginal_covariances, optimize
from gsba.bundle.pose_variables import X, values_of
from gsba.camera.projections import RadialProjection
from gsba.types.records import with_rows

_BEHIND = 1e3  # whitened residual of a point that the picture cannot show
_FAMILY = "known_points"
GATE_SIGMAS = 3.5  # of an inlier's residual
COARSE = (8.0,)  # scales of the loss, round by round, standard deviations, of a first fit
FINE = (2.0, 1.0)  # of the last one
_SOLVER = SolverOptions(max_iterations=20, relative_tolerance=1e-5, absolute_tolerance=1e-2)


def K(camera: int) -> int:
    """GTSAM key of a camera: the steps of its projection's parameters so far, a vector."""
    return gtsam.symbol("k", camera)


def isotropic(sigmas: np.ndarray) -> np.ndarray:
    """Covariances (N, 2, 2) of standard deviations (N,) per axis."""
    return sigmas[:, None, None] ** 2 * np.eye(2)


def _no_step(projection: RadialProjection) -> np.ndarray:
    return np.zeros(projection.num_parameters)


@dataclass(frozen=True, slots=True)
class PointSightings:
    """Points of a map in one picture, a panorama or a photo."""

    points_world: np.ndarray  # (N, 3) float64, map units
    covariances: np.ndarray  # (N, 3, 3) float64, of the points, map units^2
    measured: np.ndarray  # (N, 3) unit bearings, rig frame, of a panorama; (N, 2) pixels of a photo
    spreads: np.ndarray  # (N, 2, 2) float64, covariances of what is measured: radians^2 on the
    # bearing's tangent_basis, or pixels^2
    origins_rig: np.ndarray | None = None  # (N, 3) origins of rays, rig frame; None = the centre
    camera: int | None = None  # number of a photo's camera; None = a panorama


@dataclass(frozen=True, slots=True)
class Residuals:
    """Residuals of sightings and their derivatives, not whitened."""

    values: np.ndarray  # (N, 2) radians or pixels
    by_pose: np.ndarray  # (N, 2, 6), tangent [rotation, translation] on the right
    by_camera: np.ndarray  # (N, 2, C), steps of the projection's parameters
    covariances: np.ndarray  # (N, 2, 2), of keypoints and points
    behind: np.ndarray  # (N,) bool, points that the picture cannot show


def residuals_of(
    seen: PointSightings, world_T_rig: np.ndarray, projection: RadialProjection | None
) -> Residuals:
    """Residuals of sightings at a pose (4, 4): in a panorama on the bearing's tangent plane, in a
    photo in pixels."""
    rotation = world_T_rig[:3, :3]
    local = (seen.points_world - world_T_rig[:3, 3]) @ rotation
    vectors = local if seen.origins_rig is None else local - seen.origins_rig
    if projection is None:
        lengths = np.maximum(np.linalg.norm(vectors, axis=1), 1e-12)
        units, axes = vectors / lengths[:, None], tangent_basis(seen.measured)
        values = np.einsum("nij,nj->ni", axes, units)
        by_vector = (axes - values[:, :, None] * units[:, None]) / lengths[:, None, None]
        by_camera = np.zeros((len(values), 2, 0))
        behind = np.sum(units * seen.measured, axis=1) <= 0
    else:
        behind = ~(vectors[:, 2] > 1e-9) | ~np.isfinite(projection.project(vectors)).all(axis=1)
        shown = np.where(behind[:, None], [0.0, 0.0, 1.0], vectors)
        values = projection.project(shown) - seen.measured
        by_vector, by_camera = projection.jacobians(shown)
    turned = np.cross(by_vector, local[:, None])  # d(vector) = local x rotation - translation
    by_pose = np.concatenate([turned, -by_vector], axis=2)
    by_point = by_vector @ rotation.T
    spread = by_point @ seen.covariances @ np.swapaxes(by_point, 1, 2) + seen.spreads
    return Residuals(values, by_pose, by_camera, spread, behind)


class KnownPointBlock(Block):
    """Robust residuals of sightings over the poses of pictures and the cameras that they share.

    The noise of a residual, which holds what a point is uncertain by, is taken at accepted values.

    Args:
        pictures: sightings of each picture (P).
        projections: (C) of each camera, where its steps are zero.
        loss: on a residual's norm, in standard deviations.
    """

    def __init__(
        self,
        pictures: Sequence[PointSightings],
        projections: Sequence[RadialProjection],
        loss: RobustLoss,
    ) -> None:
        self._pictures, self._loss = tuple(pictures), loss
        # Cameras at accepted values, and these: steps lead on from there.
        self._projections: list[RadialProjection] = list(projections)
        self._at = [_no_step(one) for one in projections]
        self._roots: list[np.ndarray] = []  # (N, 2, 2) inverse square root of each covariance
        self.keys: list[int] = [X(p) for p in range(len(pictures))]
        self.keys += [K(c) for c in range(len(projections))]
        num = len(pictures)
        rows = [
            (p, num + seen.camera) for p, seen in enumerate(pictures) if seen.camera is not None
        ]
        self.pairs = np.array(rows, np.int64).reshape(-1, 2)

    def refresh(self, values: gtsam.Values) -> None:
        """Take cameras, and the noise of residuals, at accepted values."""
        for c in range(len(self._projections)):
            self._projections[c] = self._projection(c, values)
            self._at[c] = values.atVector(K(c))
        self._roots = [
            np.linalg.inv(np.linalg.cholesky(self._residuals(p, values).covariances))
            for p in range(len(self._pictures))
        ]

    def linearize(self, values: gtsam.Values) -> PoseSystem:
        """Model of the cost at accepted values."""
        num = len(self.keys)
        diagonal, gradient = np.zeros((num, 6, 6)), np.zeros((num, 6))
        mixed, cost, pair = np.zeros((len(self.pairs), 6, 6)), 0.0, 0
        for p, seen in enumerate(self._pictures):
            whitened, by_pose, by_camera, weights = self._whitened(p, values)
            cost += float(self._loss.rho(np.sum(whitened**2, axis=1)).sum())
            weighted = weights[:, None, None] * by_pose
            diagonal[p] += np.einsum("nri,nrj->ij", weighted, by_pose)
            gradient[p] += np.einsum("nri,nr->i", weighted, whitened)
            if seen.camera is None:
                continue
            row, size = len(self._pictures) + seen.camera, by_camera.shape[2]
            scaled = weights[:, None, None] * by_camera
            diagonal[row, :size, :size] += np.einsum("nri,nrj->ij", scaled, by_camera)
            gradient[row, :size] += np.einsum("nri,nr->i", scaled, whitened)
            mixed[pair, :, :size] = np.einsum("nri,nrj->ij", weighted, by_camera)
            pair += 1
        return PoseSystem(diagonal, mixed, gradient, {_FAMILY: cost})

    def propose(self, values: gtsam.Values, steps: np.ndarray) -> float:
        """Cost at tentative values."""
        return self.costs(values)[_FAMILY]

    def costs(self, values: gtsam.Values) -> dict[str, float]:
        """Cost, under the noise of the accepted values."""
        return {_FAMILY: float(sum(self._loss.rho(part).sum() for part in self._squares(values)))}

    def squared_residuals(self, values: gtsam.Values) -> list[np.ndarray]:
        """Squared whitened residuals (N,) of each picture."""
        self.refresh(values)
        return self._squares(values)

    def projections(self, values: gtsam.Values) -> list[RadialProjection]:
        """Projections (C) of the cameras."""
        return [self._projection(c, values) for c in range(len(self._projections))]

    def _projection(self, camera: int, values: gtsam.Values) -> RadialProjection:
        step = values.atVector(K(camera)) - self._at[camera]
        return self._projections[camera].stepped(step)

    def _squares(self, values: gtsam.Values) -> list[np.ndarray]:
        return [
            np.sum(self._whitened(p, values)[0] ** 2, axis=1) for p in range(len(self._pictures))
        ]

    def _residuals(self, picture: int, values: gtsam.Values) -> Residuals:
        seen = self._pictures[picture]
        projection = None if seen.camera is None else self._projection(seen.camera, values)
        return residuals_of(seen, values.atPose3(X(picture)).matrix(), projection)

    def _whitened(
        self, picture: int, values: gtsam.Values
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Whitened residuals (N, 2), by pose (N, 2, 6), by camera (N, 2, C), and weights (N,)."""
        found, roots = self._residuals(picture, values), self._roots[picture]
        whitened = np.einsum("nij,nj->ni", roots, found.values)
        whitened[found.behind] = [_BEHIND, 0.0]
        weights = self._loss.weights(np.sum(whitened**2, axis=1))
        weights[found.behind] = 0.0
        return whitened, roots @ found.by_pose, roots @ found.by_camera, weights


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
    projections: tuple[RadialProjection, ...]  # (C) of the cameras
    camera_covariances: np.ndarray  # (C, 6, 6), of the projection's parameters, zero beyond these


def fit(
    pictures: Sequence[PointSightings],
    starts: np.ndarray,
    scales: Sequence[float],
    projections: Sequence[RadialProjection] = (),
    priors: Sequence[CameraPrior] = (),
) -> PoseFit:
    """Minimise the robust residuals of sightings over poses (P, 4, 4) and cameras (C) with priors,
    in rounds of loss `scales`; many sightings may be false."""
    values, graph = values_of(starts), gtsam.NonlinearFactorGraph()
    for c, (projection, prior) in enumerate(zip(projections, priors, strict=True)):
        values.insert(K(c), _no_step(projection))
        noise = gtsam.noiseModel.Diagonal.Sigmas(prior.sigmas)
        graph.push_back(gtsam.PriorFactorVector(K(c), prior.step, noise))
    noises = np.ones(len(pictures))
    for scale in scales:
        block = _block(pictures, noises, projections, scale)
        values = optimize(graph, values, [block], _SOLVER).values
        squares = block.squared_residuals(values)
        # from this scale on, residuals tell of the noise
        if scale <= 2.0:
            for p, near in enumerate(part[part < GATE_SIGMAS**2] for part in squares):
                if len(near):  # 1.3863: median of a chi-square of two degrees of freedom
                    found = noises[p] * float(np.sqrt(np.median(near) / 1.3863))
                    noises[p] = max(found, MIN_NOISE)
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
    return bool(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]) <= 0.05 * depth)


def _block(
    pictures: Sequence[PointSightings],
    noises: np.ndarray,
    projections: Sequence[RadialProjection],
    scale: float,
    loss: str = "cauchy",
) -> KnownPointBlock:
    """Block of pictures whose keypoints are `noises` (P,) times as noisy as they claim."""
    scaled = [
        replace(seen, spreads=noise**2 * seen.spreads)
        for seen, noise in zip(pictures, noises, strict=True)
    ]
    return KnownPointBlock(scaled, projections, RobustLoss(loss, scale))  # type: ignore[arg-type]
