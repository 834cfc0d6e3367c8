"""Parameters that each frame has beside its pose: found with poses and points adjusted.

Normal equations of bearings, points eliminated. Points that the parameters were not found from say
whether they predict.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix, diags, hstack
from scipy.sparse.linalg import splu

from gsba.bundle.adjustment import Problem
from gsba.bundle.shared_parameters import (
    PARTS,
    Normal,
    Weighted,
    of_points,
    sparse,
    weighted,
    without_points,
)
from gsba.types import Keypoints, Landmarks, Solution, Tracks

_POSE_DAMPING = 1e-4  # of the poses' information, against the map's free similarity


@dataclass(frozen=True, slots=True)
class FrameModel:
    """Second-order model of some points' cost over poses and K parameters of each frame."""

    normal: Normal  # (F * (6 + K)) variables, poses first; by the weights of the robust loss
    curvature: float  # of that loss, part of its weights'

    def gain(self, step: np.ndarray) -> float:
        """Decrease of the cost by a step of all of them."""
        return float(-step @ (self.normal.gradient + 0.5 * (self.normal.hessian @ step)))

    def step(self, sigmas: np.ndarray) -> np.ndarray:
        """Change of poses and parameters (F * (6 + K),).

        Args:
            sigmas: (K,) how strongly the parameters are drawn to what they are; 0 = they stay.
        """
        num_frames = len(self.normal.gradient) // (6 + len(sigmas))
        num, hessian = 6 * num_frames, self.curvature * self.normal.hessian
        damped = hessian.diagonal()[:num]
        held = np.where(damped > 0, _POSE_DAMPING * damped, 1.0)
        weights = np.tile(np.maximum(sigmas, 1e-12) ** -2.0, num_frames)
        matrix = hessian + diags(np.concatenate([held, weights]))
        return -splu(matrix.tocsc()).solve(self.normal.gradient)


def models_of(
    landmarks: Landmarks,
    keypoints: Keypoints,
    solved: Solution,
    problem: Problem,
    by_parameters: Callable[[Weighted], np.ndarray],
) -> list[FrameModel]:
    """Models of the robust cost of parts of some points, at a solution's poses.

    Args:
        landmarks: points, moved to their best first, and their observations.
        keypoints: where these really point.
        solved: poses, and the noise of observations.
        problem: families, loss.
        by_parameters: Jacobian (O, 2, K) of residuals by parameters of their frames.
    """
    drawn = np.random.default_rng(problem.settings.seed).permutation(landmarks.tracks.num_points)

    def model(part: int) -> FrameModel:
        some = of_points(landmarks, drawn % PARTS == part)
        seen = weighted(some, keypoints, solved, problem)
        return _model(some.tracks, seen, by_parameters(seen), len(solved.world_T_rigs))

    with ThreadPoolExecutor(problem.num_threads) as pool:
        return list(pool.map(model, range(PARTS)))


def summed(models: Sequence[FrameModel]) -> FrameModel:
    """The model of all their points."""
    normals = [model.normal for model in models]
    total = Normal(
        sum(normal.cost for normal in normals),
        np.sum([normal.gradient for normal in normals], axis=0),
        csr_matrix(sum(normal.hessian for normal in normals)),
    )
    return FrameModel(total, float(np.mean([model.curvature for model in models])))


def part_gains(models: Sequence[FrameModel], sigmas: np.ndarray) -> np.ndarray:
    """Share of its cost that each part gains by the parameters that the others give, poses too."""
    gains = []
    for p, part in enumerate(models):
        others = summed([model for q, model in enumerate(models) if q != p])
        without = part.gain(others.step(np.zeros_like(sigmas)))
        gains.append((part.gain(others.step(sigmas)) - without) / part.normal.cost)
    return np.array(gains)


def _model(
    tracks: Tracks, seen: Weighted, by_parameters: np.ndarray, num_frames: int
) -> FrameModel:
    poses = sparse(seen.roots @ seen.by_pose, tracks.frames, num_frames)
    own = sparse(seen.roots @ by_parameters, tracks.frames, num_frames)
    return FrameModel(
        without_points(seen, tracks, csr_matrix(hstack([poses, own]))), seen.curvature
    )
