"""Priors of the factor graph: what the trajectory says, and the gauge."""

import gtsam
import numpy as np

from gsba.config import PriorSettings
from gsba.geometry import inverse

X = gtsam.symbol_shorthand.X


def build(coarse_world_T_rigs: np.ndarray, settings: PriorSettings) -> gtsam.NonlinearFactorGraph:
    """Relative priors between neighbours, a weak absolute one, and a fixed first pose.

    Args:
        coarse_world_T_rigs: (F, 4, 4) trajectory, in the frame and scale that the result keeps.
        settings: noise of the trajectory's steps, loss, strength of the absolute prior.
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
        sigma = settings.translation * max(float(lengths[f]), typical)
        graph.add(
            gtsam.BetweenFactorPose3(
                X(f), X(f + 1), gtsam.Pose3(step), robust(np.deg2rad(settings.rotation_deg), sigma)
            )
        )
    weak = robust(np.deg2rad(settings.absolute_rotation_deg), settings.absolute_position * extent)
    for f, world_T_rig in enumerate(coarse_world_T_rigs):
        graph.add(gtsam.PriorFactorPose3(X(f), gtsam.Pose3(world_T_rig), weak))
    gauge = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e-6] * 3 + [1e-6 * extent] * 3))
    graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(coarse_world_T_rigs[0]), gauge))
    return graph


def fixed_scale(world_T_rigs: np.ndarray) -> gtsam.NonlinearFactorGraph:
    """A tight factor on the distance from the first frame to the one furthest from it."""
    distances = np.linalg.norm(world_T_rigs[:, :3, 3] - world_T_rigs[0, :3, 3], axis=1)
    far = int(np.argmax(distances))
    held = gtsam.NonlinearFactorGraph()
    if distances[far] > 0:
        noise = gtsam.noiseModel.Isotropic.Sigma(1, 1e-6 * float(distances[far]))
        held.add(gtsam.RangeFactorPose3(X(0), X(far), float(distances[far]), noise))
    return held
