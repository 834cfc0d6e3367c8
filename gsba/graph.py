"""Priors of the factor graph: what the trajectory says, and the gauge."""

import gtsam
import numpy as np

from gsba.config import PriorSettings
from gsba.geometry import furthest, inverse

X = gtsam.symbol_shorthand.X


def build(
    coarse_world_T_rigs: np.ndarray,
    settings: PriorSettings,
    false_steps: np.ndarray | None = None,
    false_frames: np.ndarray | None = None,
    first: np.ndarray | None = None,
) -> gtsam.NonlinearFactorGraph:
    """Relative priors between neighbours, a weak absolute one, and a fixed first pose.

    Args:
        coarse_world_T_rigs: (F, 4, 4) trajectory, in the frame and scale that the result keeps.
        settings: noise of the trajectory's steps, loss, strength of the absolute prior.
        false_steps: (F - 1,) bool, steps that get no prior; None = all do.
        false_frames: (F,) bool, frames that get no absolute prior; None = all do.
        first: (4, 4) where to fix the first pose; None = where the trajectory has it.
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

    for f, step in enumerate(steps):
        if false_steps is not None and false_steps[f]:
            continue
        sigma = settings.translation * max(float(lengths[f]), typical)
        graph.add(
            gtsam.BetweenFactorPose3(
                X(f), X(f + 1), gtsam.Pose3(step), robust(np.deg2rad(settings.rotation_deg), sigma)
            )
        )
    weak = robust(np.deg2rad(settings.absolute_rotation_deg), settings.absolute_position * extent)
    for f, world_T_rig in enumerate(coarse_world_T_rigs):
        if false_frames is not None and false_frames[f]:
            continue
        graph.add(gtsam.PriorFactorPose3(X(f), gtsam.Pose3(world_T_rig), weak))
    gauge = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e-6] * 3 + [1e-6 * extent] * 3))
    fixed = gtsam.Pose3(coarse_world_T_rigs[0] if first is None else first)
    graph.add(gtsam.PriorFactorPose3(X(0), fixed, gauge))
    return graph


def fixed_scale(
    world_T_rigs: np.ndarray, components: np.ndarray | None = None
) -> gtsam.NonlinearFactorGraph:
    """A tight factor on the distance from the first frame to the one furthest from it.

    Args:
        world_T_rigs: (F, 4, 4).
        components: (F,) map of each frame; each gets such a factor, and those behind the first
            frame's a fixed pose besides. None = there is one.
    """
    held = gtsam.NonlinearFactorGraph()
    if components is None:
        components = np.zeros(len(world_T_rigs), np.int32)
    for component in np.unique(components):
        rows = np.flatnonzero(components == component)
        first = int(rows[0])
        far, distance = furthest(world_T_rigs[rows, :3, 3])
        if distance > 0:
            noise = gtsam.noiseModel.Isotropic.Sigma(1, 1e-6 * distance)
            held.add(gtsam.RangeFactorPose3(X(first), X(int(rows[far])), distance, noise))
        if first > 0:
            sigmas = np.array([1e-6] * 3 + [1e-6 * max(distance, 1e-12)] * 3)
            fixed = gtsam.Pose3(world_T_rigs[first])
            noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
            held.add(gtsam.PriorFactorPose3(X(first), fixed, noise))
    return held
