"""Parameters that each frame has beside its pose, poses and points adjusted; other points say
whether they predict."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.sparse import diags_array as diags
from scipy.sparse.linalg import splu

from factors.elimination import LinearSystem
from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.shared_parameters import (
    PARTS,
    Verdict,
    Weighted,
    cross_validate,
    weighted,
    without_points,
)
from gsba.types import Keypoints, Landmarks, Solution

_POSE_DAMPING = 1e-4  # of the poses' information, against the map's free similarity


@dataclass(frozen=True, slots=True)
class FrameModel:
    """Second-order model of some points' cost over poses and K parameters of each frame."""

    system: LinearSystem  # 6 + K variables of each frame, its pose first; by robust weights
    curvature: float  # of that loss, part of its weights'

    @property
    def cost(self) -> float:
        """At no step."""
        return self.system.cost

    def gain(self, step: np.ndarray) -> float:
        """Decrease of the cost by a step of all of them."""
        return float(-step @ (self.system.gradient + 0.5 * (self.system.hessian @ step)))

    def step(self, sigmas: np.ndarray) -> np.ndarray:
        """Change of poses and parameters (F * (6 + K),).

        Args:
            sigmas: (K,) how strongly the parameters are drawn to what they are; 0 = they stay.
        """
        hessian = self.curvature * self.system.hessian
        held = _POSE_DAMPING * hessian.diagonal().reshape(-1, 6 + len(sigmas))
        held[held <= 0] = 1.0
        held[:, 6:] = np.maximum(sigmas, 1e-12) ** -2.0
        matrix = hessian + diags(held.ravel())
        return -splu(matrix.tocsc()).solve(self.system.gradient)


def models_of(
    landmarks: Landmarks,
    keypoints: Keypoints,
    solved: Solution,
    context: AdjustmentContext,
    by_parameters: Callable[[Weighted], np.ndarray],
) -> list[FrameModel]:
    """Models of the robust cost of parts of some points, at a solution's poses.

    Args:
        landmarks: points, moved to their best first, and their observations.
        keypoints: where these really point.
        by_parameters: Jacobian (O, 2, K) of residuals by parameters of their frames.
    """
    drawn = np.random.default_rng(context.settings.seed).permutation(landmarks.tracks.num_points)

    def model(part: int) -> FrameModel:
        some = landmarks.of(drawn % PARTS == part)
        seen = weighted(some, keypoints, solved, context)
        by_frame = np.concatenate([seen.by_pose, by_parameters(seen)], axis=2)
        system = without_points(seen, some.tracks, len(solved.world_T_rigs), by_frame)
        return FrameModel(system, seen.curvature)

    with ThreadPoolExecutor(context.num_threads) as pool:
        return list(pool.map(model, range(PARTS)))


def summed(models: Sequence[FrameModel]) -> FrameModel:
    """The model of all their points."""
    systems = [model.system for model in models]
    total = LinearSystem(
        sum(system.cost for system in systems),
        np.sum([system.gradient for system in systems], axis=0),
        sum(system.hessian for system in systems[1:]) + systems[0].hessian,
    )
    return FrameModel(total, float(np.mean([model.curvature for model in models])))


def validated(models: Sequence[FrameModel], sigmas: np.ndarray) -> Verdict:
    """Verdict on parameters with priors `sigmas` (K,), poses solved for with and without them."""
    return cross_validate(
        models,
        lambda others: summed(others).step(sigmas),
        lambda others: summed(others).step(np.zeros_like(sigmas)),
    )
