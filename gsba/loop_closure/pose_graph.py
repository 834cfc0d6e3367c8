"""The path as a chain of steps, and loops that may bend it: as far as its steps can be off."""

from dataclasses import dataclass

import gtsam
import numpy as np

from gsba.bundle.prior_factors import X
from gsba.geometry import inverse
from gsba.types import Solution

_STEP_DEG, _STEP = 0.2, 0.02  # noise of a confirmed step; of its position, typical lengths
_LOOP_DEG, _LOOP = 0.3, 0.05  # the same of a loop
_UNSEEN_RAD = 0.5  # of a step that no image confirms, besides its own length
_PROBABILITY = 0.99  # that a true loop is within what its noise allows


def path(
    world_T_rigs: np.ndarray, unseen: np.ndarray
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, gtsam.noiseModel.Base]:
    """The chain of steps with its first pose held, its poses, and the noise of a loop.

    Args:
        world_T_rigs: (F, 4, 4) poses that are right from one to the next.
        unseen: (F - 1,) bool, steps that give way first.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for f, world_T_rig in enumerate(world_T_rigs):
        values.insert(X(f), gtsam.Pose3(world_T_rig))
    graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(world_T_rigs[0]), _sigmas(1e-6, 1e-6)))
    steps = inverse(world_T_rigs[:-1]) @ world_T_rigs[1:]
    lengths = np.linalg.norm(steps[:, :3, 3], axis=1)
    typical = float(np.median(lengths)) or 1.0
    for f, step in enumerate(steps):
        loose = _sigmas(_UNSEEN_RAD, float(max(lengths[f], typical)))
        noise = loose if unseen[f] else _sigmas(np.deg2rad(_STEP_DEG), _STEP * typical)
        graph.add(gtsam.BetweenFactorPose3(X(f), X(f + 1), gtsam.Pose3(step), noise))
    return graph, values, _sigmas(np.deg2rad(_LOOP_DEG), _LOOP * typical)


def affordable(
    world_T_rigs: np.ndarray, unseen: np.ndarray, pairs: np.ndarray, f0_T_f1s: np.ndarray
) -> np.ndarray:
    """Which loops (L,) bool the path can meet at a price that its steps can pay.

    Graduated non-convexity with a truncated quadratic loss on loops only (Yang, Antonante,
    Tzoumas and Carlone, RA-L 5(2), 2020). A loop to a place that merely looks the same bends
    confirmed steps further than many such loops are worth, and is switched off; one that asks for
    drift as it happens, or for an unseen step to move, stays.

    Args:
        world_T_rigs: (F, 4, 4) poses that are right from one to the next.
        unseen: (F - 1,) bool, steps that give way first.
        pairs: (L, 2) frames of loops.
        f0_T_f1s: (L, 4, 4) relative poses that loops assert, map units.
    """
    graph, values, noise = path(world_T_rigs, unseen)
    chain = graph.size()
    for (f0, f1), f0_T_f1 in zip(pairs.tolist(), f0_T_f1s, strict=True):
        graph.add(gtsam.BetweenFactorPose3(X(f0), X(f1), gtsam.Pose3(f0_T_f1), noise))
    parameters = gtsam.GncLMParams()
    parameters.setLossType(gtsam.GncLossType.TLS)
    parameters.setKnownInliers(list(range(chain)))
    solver = gtsam.GncLMOptimizer(graph, values, parameters)
    solver.setInlierCostThresholdsAtProbability(_PROBABILITY)
    solver.optimize()
    return np.asarray(solver.getWeights())[chain:] > 0.5


def _sigmas(rotation: float, translation: float) -> gtsam.noiseModel.Base:
    return gtsam.noiseModel.Diagonal.Sigmas(np.array([rotation] * 3 + [translation] * 3))


@dataclass(frozen=True, slots=True)
class Loop:
    """Two frames that see the same points of the map, and how one lies in the other."""

    f0: int
    f1: int
    f0_T_f1: np.ndarray  # (4, 4) float64, map units
    support: int  # points that agree


def met(loops: list[Loop], solved: Solution, unseen: np.ndarray) -> list[Loop]:
    """Loops that the path can meet without bending steps that images confirm."""
    if not loops:
        return loops
    pairs = np.array([(loop.f0, loop.f1) for loop in loops])
    asserted = np.array([loop.f0_T_f1 for loop in loops])
    kept = affordable(solved.world_T_rigs, unseen, pairs, asserted)
    return [loop for loop, stays in zip(loops, kept, strict=True) if stays]


def bend(solved: Solution, loops: list[Loop], unseen: np.ndarray) -> Solution:
    """Spread what loops leave open over the path: a pose graph of its steps and the loops.

    Points move with the first frame that sees them.

    Args:
        solved: poses and points.
        loops: to be closed, under a robust loss.
        unseen: (F - 1,) bool, steps that give way first.
    """
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
