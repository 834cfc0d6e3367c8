"""Parameters that all frames share: what parts of the sequence say of them, the rest adjusted.

A part's cost is a quadratic function of the parameters once its points and poses are eliminated.
Sums of other parts' models give parameters, and the part itself says what they are worth: they are
believed only if they predict what they were not found from.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import splu

from factors.bearing import bearing_residuals, tangent_basis
from factors.robust import RobustLoss
from gsba.bundle.adjustment import Problem, landmark_block, values_of
from gsba.types import Counts, Keypoints, Landmarks, Solution, Tracks

PARTS = 4  # of the sequence: each is predicted by what the others give
_LEAST_FRAMES = 2 * PARTS
_LEAST_POINTS = 50  # of a part
_POSE_DAMPING = 1e-4  # of the poses' information, against the map's free similarity
_POINT_DAMPING = 1e-9
_LEAST_CURVATURE = 0.3  # or a step would go further than its model holds


@dataclass(frozen=True, slots=True)
class SharedModel:
    """Second-order model of a part's cost over shared parameters, poses and points eliminated."""

    cost: float  # at no parameters
    gradient: np.ndarray  # (K,) there
    hessian: np.ndarray  # (K, K), by the weights of the robust loss
    curvature: float = 1.0  # of that loss, part of its weights': steps by the Hessian fall as short

    def gain(self, parameters: np.ndarray) -> float:
        """Decrease of the cost by these first parameters."""
        num = len(parameters)
        slope = self.gradient[:num] + 0.5 * self.hessian[:num, :num] @ parameters
        return float(-parameters @ slope)

    def of(self, which: slice) -> "SharedModel":
        """The model over some of the parameters, the rest none."""
        return replace(self, gradient=self.gradient[which], hessian=self.hessian[which, which])

    def around(self, parameters: np.ndarray) -> "SharedModel":
        """The model around none of one around these first parameters."""
        step = np.zeros(len(self.gradient))
        num = min(len(step), len(parameters))
        step[:num] = -parameters[:num]
        return SharedModel(
            self.cost - self.gain(step),
            self.gradient + self.hessian @ step,
            self.hessian,
            self.curvature,
        )


def drawn(landmarks: Landmarks, most: int, seed: int) -> Landmarks:
    """A share of the points, drawn at random, where there are more than `most` observations."""
    tracks = landmarks.tracks
    share = most / max(len(tracks), 1)
    if share >= 1:
        return landmarks
    chosen = np.random.default_rng(seed).random(tracks.num_points) < share
    return of_points(landmarks, chosen)


def of_points(landmarks: Landmarks, chosen: np.ndarray) -> Landmarks:
    """Points `chosen (J,)` and their observations."""
    return Landmarks(landmarks.points_world[chosen], landmarks.tracks.of(chosen), landmarks.counts)


def parts_of(landmarks: Landmarks) -> list[Landmarks]:
    """The points of each part of the sequence; no part where there is too little."""
    tracks = landmarks.tracks
    if len(np.unique(tracks.frames)) < _LEAST_FRAMES or tracks.num_points < _LEAST_POINTS * PARTS:
        return []
    seen = np.bincount(tracks.points, minlength=tracks.num_points)
    means = np.bincount(tracks.points, tracks.frames, tracks.num_points) / np.maximum(seen, 1)
    ranks = np.argsort(np.argsort(means, kind="stable"), kind="stable")
    part = ranks * PARTS // tracks.num_points
    return [of_points(landmarks, part == p) for p in range(PARTS)]


@dataclass(frozen=True, slots=True)
class Weighted:
    """Bearings' residuals under a robust loss, points at their best."""

    rows: np.ndarray  # (O,) of the keypoints
    residuals: np.ndarray  # (O, 2) radians
    by_pose: np.ndarray  # (O, 2, 6)
    by_point: np.ndarray  # (O, 2, 3)
    roots: np.ndarray  # (O, 2, 2) that whiten them, robust weights included
    curvature: float  # see `SharedModel`


def weighted(
    landmarks: Landmarks, keypoints: Keypoints, solved: Solution, problem: Problem
) -> Weighted:
    """Residuals of some points' bearings at a solution's poses, and their Jacobians."""
    block = landmark_block(landmarks, keypoints, solved.noise, problem)
    block.polish(values_of(solved.world_T_rigs))
    tracks, rows = landmarks.tracks, keypoints.rows(landmarks.tracks)
    residuals, by_pose, by_point = bearing_residuals(
        solved.world_T_rigs[tracks.frames],
        block.points_world[tracks.points],
        keypoints.bearings_rig[rows],
        keypoints.origins_of(rows),
    )
    roots = np.eye(2) / keypoints.sigmas_rad[rows, None, None]
    if keypoints.sqrt_infos is not None:
        roots = keypoints.sqrt_infos[rows]
    whitened = np.einsum("oij,oj->oi", roots, residuals) / solved.noise
    solver = problem.settings.solver
    loss = RobustLoss(solver.loss, solver.loss_sigmas)
    squares = np.sum(whitened**2, axis=1)
    weights = loss.weights(squares)
    step = 1e-4  # of a squared residual; the loss bends by its derivative
    bent = (loss.weights(squares * (1 + step)) - weights) / step
    curvature = 1 + float(np.sum(bent)) / max(float(np.sum(weights)), 1e-300)
    roots = np.sqrt(weights)[:, None, None] * roots / solved.noise
    return Weighted(rows, residuals, by_pose, by_point, roots, max(curvature, _LEAST_CURVATURE))


def models_of(
    landmarks: Landmarks,
    most: int,
    keypoints: Keypoints,
    solved: Solution,
    problem: Problem,
    by_shared: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> tuple[list[SharedModel], Counts]:
    """Models of the cost of each part of the sequence, by at most so many observations.

    Args: see `model_of`.

    Returns:
        (PARTS) models, none where there is too little; and how many observations they rest on.
    """
    used = drawn(landmarks, most, problem.settings.seed)
    alone = replace(problem, num_threads=1)  # parts run side by side

    def model(part: Landmarks) -> SharedModel:
        return model_of(part, keypoints, solved, alone, by_shared)

    with ThreadPoolExecutor(problem.num_threads) as pool:
        models = list(pool.map(model, parts_of(used)))
    return models, Counts(len(landmarks.tracks), len(used.tracks), "observations")


def model_of(
    landmarks: Landmarks,
    keypoints: Keypoints,
    solved: Solution,
    problem: Problem,
    by_shared: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> SharedModel:
    """Model of the robust cost of some points and their bearings, at a solution's poses.

    Args:
        landmarks: points, moved to their best first, and their observations.
        keypoints: where these really point.
        solved: poses, and the noise of observations.
        problem: families, loss.
        by_shared: Jacobian (O, 2, K) of bearings' residuals, from the rows (O,) of keypoints and
            the Jacobian (O, 2, 3) by where each ray starts.
    """
    seen = weighted(landmarks, keypoints, solved, problem)
    by_origin = -seen.by_point @ solved.world_T_rigs[landmarks.tracks.frames, :3, :3]
    model = _reduced(
        landmarks.tracks,
        len(solved.world_T_rigs),
        np.einsum("oij,oj->oi", seen.roots, seen.residuals),
        seen.roots @ seen.by_pose,
        seen.roots @ seen.by_point,
        seen.roots @ by_shared(seen.rows, by_origin),
    )
    return replace(model, curvature=seen.curvature)


def _reduced(
    tracks: Tracks,
    num_frames: int,
    residuals: np.ndarray,
    by_pose: np.ndarray,
    by_point: np.ndarray,
    by_shared: np.ndarray,
) -> SharedModel:
    """Eliminate points, then poses, from weighted residuals (O, 2) and their Jacobians."""
    num = len(tracks)
    right = np.concatenate([by_shared, residuals[:, :, None]], axis=2).reshape(2 * num, -1)
    poses = sparse(by_pose, tracks.frames, num_frames)
    points = sparse(by_point, tracks.points, tracks.num_points)
    blocks = _inverted(by_point, tracks)
    rest = right - points @ (blocks @ (points.T @ right))  # what points cannot take up
    among = (points.T @ poses).tocsr()
    of_poses = (poses.T @ poses - among.T @ blocks @ among).tocsc()
    curvature = of_poses.diagonal()
    idle = curvature <= 0
    of_poses = of_poses + diags(np.where(idle, 1.0, _POSE_DAMPING * curvature), format="csc")
    coupled = poses.T @ rest
    inner = right.T @ rest - coupled.T @ splu(of_poses.tocsc()).solve(coupled)
    return SharedModel(0.5 * float(inner[-1, -1]), inner[:-1, -1], inner[:-1, :-1])


def by_origin(
    seen: Weighted, world_R_rigs: np.ndarray, bearings_rig: np.ndarray, nearness: float
) -> np.ndarray:
    """Jacobian (O, 2, 3) of residuals by where rays start, rig frame, and point by what they show.

    Args:
        seen: the residuals.
        world_R_rigs: (O, 3, 3) of their poses.
        bearings_rig: (O, 3) of their rays.
        nearness: see `Lenses`.
    """
    return -seen.by_point @ world_R_rigs + nearness * tangent_basis(bearings_rig)


@dataclass(frozen=True, slots=True)
class Normal:
    """Second-order model of some bearings' cost over variables, their points eliminated."""

    cost: float  # as it is
    gradient: np.ndarray  # (K,)
    hessian: csr_matrix  # (K, K)


def without_points(seen: Weighted, tracks: Tracks, columns: csr_matrix) -> Normal:
    """Eliminate points from weighted bearings whose whitened Jacobian is columns (2 O, K)."""
    by_point = seen.roots @ seen.by_point
    residuals = np.einsum("oij,oj->oi", seen.roots, seen.residuals).ravel()
    points = sparse(by_point, tracks.points, tracks.num_points)
    blocks = _inverted(by_point, tracks)
    among, pulled = (points.T @ columns).tocsr(), points.T @ residuals
    return Normal(
        0.5 * float(residuals @ residuals - pulled @ (blocks @ pulled)),
        columns.T @ residuals - among.T @ (blocks @ pulled),
        csr_matrix(columns.T @ columns - among.T @ blocks @ among),
    )


def _inverted(by_point: np.ndarray, tracks: Tracks) -> csr_matrix:
    """Inverse of the points' own normal equations, along the diagonal."""
    normal = np.zeros((tracks.num_points, 3, 3))
    np.add.at(normal, tracks.points, np.einsum("oki,okj->oij", by_point, by_point))
    traces = np.trace(normal, axis1=1, axis2=2)[:, None, None]
    return _block_diagonal(np.linalg.inv(normal + (_POINT_DAMPING * traces + 1e-200) * np.eye(3)))


def sparse(jacobians: np.ndarray, columns: np.ndarray, num: int) -> csr_matrix:
    """Jacobians (O, 2, D) by the variables `columns (O,)` of D entries, of `num`, as one matrix."""
    count, _, dim = jacobians.shape
    at = dim * columns[:, None, None].astype(np.int64) + np.arange(dim)
    at = np.broadcast_to(at, jacobians.shape).ravel()
    starts = np.arange(0, jacobians.size + 1, dim)
    return csr_matrix((jacobians.ravel(), at, starts), shape=(2 * count, dim * num))


def _block_diagonal(blocks: np.ndarray) -> csr_matrix:
    """Blocks (J, 3, 3) along the diagonal of one matrix."""
    num = len(blocks)
    at = 3 * np.arange(num)[:, None, None] + np.broadcast_to(np.arange(3), (3, 3))
    starts = np.arange(0, 9 * num + 1, 3)
    return csr_matrix((blocks.ravel(), at.ravel(), starts), shape=(3 * num, 3 * num))
