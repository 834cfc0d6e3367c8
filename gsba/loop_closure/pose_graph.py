"""Pose graph of the path: its steps, and loops that may bend it within the steps' noise."""

from dataclasses import dataclass

import gtsam
import numpy as np

from gsba.bundle.pose_variables import X
from gsba.geometry import inverse
from gsba.types import Solution

# Noise of a verified step, and of a loop: rotation; position in typical lengths of steps.
_STEP_SIGMA_DEG, _STEP_SIGMA_LENGTHS = 0.2, 0.02
_LOOP_SIGMA_DEG, _LOOP_SIGMA_LENGTHS = 0.3, 0.05
# Rotation noise of a step without matches, whose position noise is its length.
_UNSEEN_SIGMA_RAD = 0.5
_INLIER_PROBABILITY = 0.99  # that a true loop is within its noise


def path(
    world_T_rigs: np.ndarray, unseen: np.ndarray
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, gtsam.noiseModel.Base]:
    """A pose graph of the steps of poses (F, 4, 4), its first fixed, its values, and a loop's
    noise; steps `unseen` (F - 1,) bool without matches give way first."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for f, world_T_rig in enumerate(world_T_rigs):
        values.insert(X(f), gtsam.Pose3(world_T_rig))
    graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(world_T_rigs[0]), _noise_model(1e-6, 1e-6)))
    steps = inverse(world_T_rigs[:-1]) @ world_T_rigs[1:]
    lengths = np.linalg.norm(steps[:, :3, 3], axis=1)
    typical = float(np.median(lengths)) or 1.0
    for f, step in enumerate(steps):
        loose = _noise_model(_UNSEEN_SIGMA_RAD, float(max(lengths[f], typical)))
        noise = (
            loose
            if unseen[f]
            else _noise_model(np.deg2rad(_STEP_SIGMA_DEG), _STEP_SIGMA_LENGTHS * typical)
        )
        graph.add(gtsam.BetweenFactorPose3(X(f), X(f + 1), gtsam.Pose3(step), noise))
    return graph, values, _noise_model(np.deg2rad(_LOOP_SIGMA_DEG), _LOOP_SIGMA_LENGTHS * typical)


def affordable(
    world_T_rigs: np.ndarray, unseen: np.ndarray, pairs: np.ndarray, f0_T_f1s: np.ndarray
) -> np.ndarray:
    """True (L,) for loops that the path can close within the noise of its steps.

    Graduated non-convexity with a truncated quadratic loss on loops only (Yang, Antonante,
    Tzoumas and Carlone, RA-L 5(2), 2020). A loop to a look-alike place bends verified steps further
    than many such loops are worth, and is switched off; one that needs normal drift, or moves a
    step without matches, stays.

    Args:
        world_T_rigs: (F, 4, 4) poses, accurate from one to the next.
        unseen: (F - 1,) bool, steps without matches, which give way first.
        pairs: (L, 2) frames of loops.
        f0_T_f1s: (L, 4, 4) relative poses by the loops, map units.
    """
    graph, values, noise = path(world_T_rigs, unseen)
    chain = graph.size()
    for (f0, f1), f0_T_f1 in zip(pairs.tolist(), f0_T_f1s, strict=True):
        graph.add(gtsam.BetweenFactorPose3(X(f0), X(f1), gtsam.Pose3(f0_T_f1), noise))
    parameters = gtsam.GncLMParams()
    parameters.setLossType(gtsam.GncLossType.TLS)
    parameters.setKnownInliers(list(range(chain)))
    solver = gtsam.GncLMOptimizer(graph, values, parameters)
    solver.setInlierCostThresholdsAtProbability(_INLIER_PROBABILITY)
    solver.optimize()
    return np.asarray(solver.getWeights())[chain:] > 0.5


def _noise_model(rotation: float, translation: float) -> gtsam.noiseModel.Base:
    return gtsam.noiseModel.Diagonal.Sigmas(np.array([rotation] * 3 + [translation] * 3))


@dataclass(frozen=True, slots=True)
class Loop:
    """Two frames that observe the same map points, and their relative pose."""

    f0: int
    f1: int
    f0_T_f1: np.ndarray  # (4, 4) float64, map units
    support: int  # number of inliers


def met(loops: list[Loop], solved: Solution, unseen: np.ndarray) -> list[Loop]:
    """Loops that the path can close without bending verified steps."""
    if not loops:
        return loops
    pairs = np.array([(loop.f0, loop.f1) for loop in loops])
    asserted = np.array([loop.f0_T_f1 for loop in loops])
    kept = affordable(solved.world_T_rigs, unseen, pairs, asserted)
    return [loop for loop, stays in zip(loops, kept, strict=True) if stays]


def bend(solved: Solution, loops: list[Loop], unseen: np.ndarray) -> Solution:
    """Distribute the residuals of loops over the path, each point with its first frame; steps
    `unseen` (F - 1,) bool without matches give way first."""
    poses = solved.world_T_rigs
    graph, values, noise = path(poses, unseen)
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(2.0)
    robust = gtsam.noiseModel.Robust.Create(cauchy, noise)
    for loop in loops:
        between = gtsam.Pose3(loop.f0_T_f1)
        graph.add(gtsam.BetweenFactorPose3(X(loop.f0), X(loop.f1), between, robust))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    bent = np.array([result.atPose3(X(f)).matrix() for f in range(len(poses))])
    landmarks = solved.landmarks.moved(np.ones(len(poses)), bent @ inverse(poses))
    return Solution(bent, landmarks, solved.noise, ())
