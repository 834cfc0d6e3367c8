"""Priors of the factor graph: what the trajectory says, and the gauge."""

import gtsam
import numpy as np

from gsba.config import PriorSettings
from gsba.geometry import furthest, inverse
from gsba.types import GyroConstraints, StepNoise

X = gtsam.symbol_shorthand.X
_ANYWHERE = 1e4  # extents of a map: as good as no say
_FAINTER = 10.0  # times the noise of absolute priors, where GPS says where frames are


def values_of(world_T_rigs: np.ndarray) -> gtsam.Values:
    """Poses (F, 4, 4) under their keys."""
    values = gtsam.Values()
    for f, world_T_rig in enumerate(world_T_rigs):
        values.insert(X(f), gtsam.Pose3(world_T_rig))
    return values


def poses_of(values: gtsam.Values, num_frames: int) -> np.ndarray:
    """Poses (F, 4, 4) of the first keys."""
    return np.array([values.atPose3(X(f)).matrix() for f in range(num_frames)])


def build(
    coarse_world_T_rigs: np.ndarray,
    settings: PriorSettings,
    false_steps: np.ndarray | None = None,
    false_frames: np.ndarray | None = None,
    first: np.ndarray | None = None,
    noise: StepNoise | None = None,
    gauge: bool = True,
) -> gtsam.NonlinearFactorGraph:
    """Relative priors between neighbours, a weak absolute one, and a fixed first pose.

    Args:
        coarse_world_T_rigs: (F, 4, 4) trajectory, in the frame and scale that the result keeps.
        settings: noise of the trajectory's steps, loss, strength of the absolute prior.
        false_steps: (F - 1,) bool, steps that get no prior; None = all do.
        false_frames: (F,) bool, frames that get no absolute prior; None = all do.
        first: (4, 4) where to fix the first pose; None = where the trajectory has it.
        noise: of the steps that keep their prior, as others showed it; None = as in the settings.
        gauge: whether to fix the first pose. Else GPS says where frames are: the first pose is as
            free as the map is large, and absolute priors are fainter.
    """
    graph = gtsam.NonlinearFactorGraph()
    steps = inverse(coarse_world_T_rigs[:-1]) @ coarse_world_T_rigs[1:]
    positions = coarse_world_T_rigs[:, :3, 3]
    lengths = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    typical = float(np.median(lengths[lengths > 0])) if (lengths > 0).any() else 1.0
    extent = max(float(np.linalg.norm(np.ptp(positions, axis=0))), typical)
    loss = gtsam.noiseModel.mEstimator.Cauchy.Create(settings.loss_sigmas)

    def robust(rotation: float, translation: float) -> gtsam.noiseModel.Base:
        sigmas = np.array([rotation] * 3 + [translation] * 3)
        return gtsam.noiseModel.Robust.Create(loss, gtsam.noiseModel.Diagonal.Sigmas(sigmas))

    kept = np.ones(len(steps), bool) if false_steps is None else ~false_steps
    in_a_row = _in_a_row(kept)
    for f in np.flatnonzero(kept).tolist():
        length = max(float(lengths[f]), typical)
        if noise is None:
            model = robust(np.deg2rad(settings.rotation_deg), settings.translation * length)
        else:
            covariance = in_a_row[f] * _step_covariance(steps[f], length, noise)
            gaussian = gtsam.noiseModel.Gaussian.Covariance(covariance)
            model = gtsam.noiseModel.Robust.Create(loss, gaussian)
        graph.add(gtsam.BetweenFactorPose3(X(f), X(f + 1), gtsam.Pose3(steps[f]), model))
    fainter = 1.0 if gauge else _FAINTER
    weak = robust(
        fainter * np.deg2rad(settings.absolute_rotation_deg),
        fainter * settings.absolute_position * extent,
    )
    for f, world_T_rig in enumerate(coarse_world_T_rigs):
        if false_frames is not None and false_frames[f]:
            continue
        graph.add(gtsam.PriorFactorPose3(X(f), gtsam.Pose3(world_T_rig), weak))
    tight = 1e-6 if gauge else 1.0
    held = gtsam.noiseModel.Diagonal.Sigmas(np.array([tight] * 3 + [tight * extent] * 3))
    fixed = gtsam.Pose3(coarse_world_T_rigs[0] if first is None else first)
    graph.add(gtsam.PriorFactorPose3(X(0), fixed, held))
    return graph


def turns(
    turning: GyroConstraints, extent: float, loss_sigmas: float
) -> gtsam.NonlinearFactorGraph:
    """Relative rotations of neighbours as a gyro has them, of no say on where they are.

    Args:
        turning: steps and how well they are known.
        extent: of the map, in its unit.
        loss_sigmas: scale of the Cauchy loss, standard deviations.
    """
    graph = gtsam.NonlinearFactorGraph()
    anywhere = _ANYWHERE * max(extent, 1e-9)
    loss = gtsam.noiseModel.mEstimator.Cauchy.Create(loss_sigmas)
    for f in np.flatnonzero(np.isfinite(turning.step_sigmas)).tolist():
        sigmas = np.array([turning.step_sigmas[f]] * 3 + [anywhere] * 3)
        model = gtsam.noiseModel.Robust.Create(loss, gtsam.noiseModel.Diagonal.Sigmas(sigmas))
        step = gtsam.Pose3(gtsam.Rot3.Expmap(turning.steps[f]), np.zeros(3))
        graph.add(gtsam.BetweenFactorPose3(X(f), X(f + 1), step, model))
    return graph


def _in_a_row(kept: np.ndarray) -> np.ndarray:
    """For each step (N,) how many kept ones it is among, without a gap: they drift alike."""
    runs = np.cumsum(np.diff(kept.astype(int), prepend=0) != 0)
    return np.bincount(runs, minlength=1)[runs] if len(kept) else runs


def _step_covariance(f_T_next: np.ndarray, length: float, noise: StepNoise) -> np.ndarray:
    """Covariance (6, 6) of a step perturbed on the right; `length` in map units."""
    ahead = f_T_next[:3, :3].T @ f_T_next[:3, 3]
    along = np.outer(ahead, ahead) / max(float(ahead @ ahead), 1e-300)
    covariance = np.diag([noise.rotation**2] * 6)
    across = noise.direction**2 * (np.eye(3) - along)
    covariance[3:, 3:] = length**2 * (noise.length**2 * along + across)
    if not ahead.any():
        covariance[3:, 3:] = (length * noise.length) ** 2 * np.eye(3)
    return covariance


def fixed_scale(
    world_T_rigs: np.ndarray, components: np.ndarray | None = None, sigma: float = 1e-6
) -> gtsam.NonlinearFactorGraph:
    """A tight factor on the distance from the first frame to the one furthest from it.

    Args:
        world_T_rigs: (F, 4, 4).
        components: (F,) map of each frame; each gets such a factor, and those behind the first
            frame's a fixed pose besides. None = there is one.
        sigma: of the distance, part of it.
    """
    held = gtsam.NonlinearFactorGraph()
    if components is None:
        components = np.zeros(len(world_T_rigs), np.int32)
    for component in np.unique(components):
        rows = np.flatnonzero(components == component)
        first = int(rows[0])
        far, distance = furthest(world_T_rigs[rows, :3, 3])
        if distance > 0:
            noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma * distance)
            held.add(gtsam.RangeFactorPose3(X(first), X(int(rows[far])), distance, noise))
        if first > 0:
            sigmas = np.array([sigma] * 3 + [sigma * max(distance, 1e-12)] * 3)
            fixed = gtsam.Pose3(world_T_rigs[first])
            noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
            held.add(gtsam.PriorFactorPose3(X(first), fixed, noise))
    return held
