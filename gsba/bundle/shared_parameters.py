"""Parameters that all frames share: quadratic models of the cost of each part of a sequence, poses
and points eliminated. Others' parameters are believed where they predict a part."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TypeVar

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse import diags_array as diags
from scipy.sparse.linalg import splu

from factors.bearing import bearing_residuals
from factors.cholesky import BlockCholesky
from factors.elimination import Eliminated, LinearSystem, eliminate
from factors.robust import RobustLoss
from factors.threads import Once
from gsba.bundle.adjustment import AdjustmentContext, landmark_block, values_of
from gsba.camera.lens import ONE_CENTRE, Lenses
from gsba.types import Counts, Keypoints, Landmarks, Solution, Tracks

BySharedParameters = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]

MAX_OBSERVATIONS = 60_000  # observations that parameters are estimated from
PARTS = 4  # parts of the sequence: each is predicted by the others
_MIN_POINTS = 50  # least number of points of a part
_POSE_DAMPING = 1e-4  # of the poses' information, against the map's free similarity
_MIN_CURVATURE = 0.3  # lower curvatures give steps beyond the reach of the model


@dataclass(frozen=True)
class ObservedRays:
    """Points of a map and the rays that observe them: all that an estimate of a camera rests on."""

    solved: Solution  # poses and points, noise of the observations
    keypoints: Keypoints  # of its observations, as rays of the lenses so far
    context: AdjustmentContext
    lenses: Lenses = ONE_CENTRE  # so far
    shown: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))  # (N, 3) directions of the
    # keypoints in their pictures, unit, rig frame
    timestamps: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (F,) seconds
    most: int = MAX_OBSERVATIONS  # observations that an estimate uses

    def of(self, landmarks: Landmarks) -> "ObservedRays":
        """The rays that observe other points."""
        return replace(self, solved=replace(self.solved, landmarks=landmarks))

    @cached_property
    def drawn(self) -> "ObservedRays":
        """Those of a share of the points, see `drawn`."""
        return self.of(drawn(self.solved.landmarks, self.most, self.context.settings.seed))

    @cached_property
    def parts(self) -> "list[tuple[Tracks, Once[Weighted]]]":
        """Tracks of each part of the sequence, see `parts_of`, and their residuals, computed once
        for all models; parts run side by side."""
        alone = replace(self, context=replace(self.context, num_threads=1))
        return [
            (part.tracks, Once(partial(weighted, alone.of(part))))
            for part in parts_of(self.drawn.solved.landmarks)
        ]


@dataclass(frozen=True, slots=True)
class SharedModel:
    """Second-order model of a part's cost over shared parameters, poses and points eliminated."""

    cost: float  # at no parameters
    gradient: np.ndarray  # (K,) there
    hessian: np.ndarray  # (K, K), by the weights of the robust loss
    curvature: float = 1.0  # of the loss, part of its weights: steps by the Hessian are too short
    # by it

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


def summed(models: Sequence[SharedModel]) -> SharedModel:
    """The model of several parts."""
    return SharedModel(
        float(sum(model.cost for model in models)),
        np.array(sum(model.gradient for model in models)),
        np.array(sum(model.hessian for model in models)),
        float(np.mean([model.curvature for model in models])),
    )


def newton_step(models: Sequence[SharedModel], *, curved: bool) -> np.ndarray:
    """Change of the parameters (K,) that minimises the parts' cost, the curvature of the loss taken
    into account or not."""
    total = summed(models)
    hessian = (total.curvature if curved else 1.0) * total.hessian
    return -np.linalg.solve(damped(hessian), total.gradient)


def damped(hessian: np.ndarray) -> np.ndarray:
    """A Hessian (K, K) that can be inverted, also where nothing depends on a parameter."""
    return hessian + max(1e-9 * np.trace(hessian), 1e-300) * np.eye(len(hessian))


def drawn(landmarks: Landmarks, most: int, seed: int) -> Landmarks:
    """A share of the points, drawn at random, where there are more than `most` observations."""
    tracks = landmarks.tracks
    share = most / max(len(tracks), 1)
    if share >= 1:
        return landmarks
    chosen = np.random.default_rng(seed).random(tracks.num_points) < share
    return landmarks.of(chosen)


def sample_counts(landmarks: Landmarks, used: Landmarks) -> Counts:
    """Counts of all observations and of those of the points that were drawn."""
    received, kept = len(landmarks.tracks), len(used.tracks)
    return Counts(received, kept, "observations", {"not in the random sample": received - kept})


def parts_of(landmarks: Landmarks) -> list[Landmarks]:
    """The points of each part of the sequence; no part where there is too little."""
    tracks = landmarks.tracks
    if len(np.unique(tracks.frames)) < 2 * PARTS or tracks.num_points < _MIN_POINTS * PARTS:
        return []
    seen = np.bincount(tracks.points, minlength=tracks.num_points)
    means = np.bincount(tracks.points, tracks.frames, tracks.num_points) / np.maximum(seen, 1)
    ranks = np.argsort(np.argsort(means, kind="stable"), kind="stable")
    part = ranks * PARTS // tracks.num_points
    return [landmarks.of(part == p) for p in range(PARTS)]


@dataclass(frozen=True, slots=True)
class Weighted:
    """Residuals of bearings under a robust loss."""

    rows: np.ndarray  # (O,) of the keypoints
    residuals: np.ndarray  # (O, 2) radians
    by_pose: np.ndarray  # (O, 2, 6)
    by_point: np.ndarray  # (O, 2, 3)
    roots: np.ndarray  # (O, 2, 2) that whiten them, robust weights included
    curvature: float  # see `SharedModel`


def weighted(rays: ObservedRays) -> Weighted:
    """Residuals of bearings at a solution's poses, points at their best, and their Jacobians."""
    keypoints, solved = rays.keypoints, rays.solved
    block = landmark_block(solved.landmarks, keypoints, solved.noise, rays.context)
    block.polish(values_of(solved.world_T_rigs))
    tracks, loss = solved.landmarks.tracks, rays.context.solver.loss
    return weighted_at(block.points_world, tracks, keypoints, solved, loss)


def weighted_at(
    points_world: np.ndarray,
    tracks: Tracks,
    keypoints: Keypoints,
    solved: Solution,
    loss: RobustLoss,
) -> Weighted:
    """As `weighted`, of points (J, 3) and their tracks as they are, at a solution's poses."""
    rows = keypoints.rows(tracks)
    residuals, by_pose, by_point = bearing_residuals(
        solved.world_T_rigs[tracks.frames],
        points_world[tracks.points],
        keypoints.bearings_rig[rows],
        keypoints.origins_of(rows),
    )
    roots = keypoints.roots(rows)
    whitened = np.einsum("oij,oj->oi", roots, residuals) / solved.noise
    squares = np.sum(whitened**2, axis=1)
    weights = loss.weights(squares)
    curvature = float(np.sum(loss.curvatures(squares))) / max(float(np.sum(weights)), 1e-300)
    roots = np.sqrt(weights)[:, None, None] * roots / solved.noise
    return Weighted(rows, residuals, by_pose, by_point, roots, max(curvature, _MIN_CURVATURE))


def models_of(
    rays: ObservedRays, by_shared: BySharedParameters
) -> tuple[list[SharedModel], Counts]:
    """Models of the robust cost of each part of the sequence, none where there is too little; and
    how many observations they rest on.

    Points are moved to their best first, poses are those of a solution; by_shared: Jacobian (O, 2,
    K) of bearings' residuals, from the rows (O,) of keypoints, the Jacobian (O, 2, 3) by where each
    ray starts, and the residuals (O, 2).
    """

    def model(part: tuple[Tracks, Once[Weighted]]) -> SharedModel:
        tracks, seen = part
        return _model(seen(), tracks, rays.solved.world_T_rigs, by_shared)

    with ThreadPoolExecutor(rays.context.num_threads) as pool:
        models = list(pool.map(model, rays.parts))
    return models, sample_counts(rays.solved.landmarks, rays.drawn.solved.landmarks)


def whole_model(
    rays: ObservedRays, models: Sequence[SharedModel], by_shared: BySharedParameters
) -> SharedModel | None:
    """The sum of the models of parts, or where there is too little for parts, the model of all
    points; None = there are none."""
    if models:
        return summed(models)
    solved = rays.drawn.solved
    tracks = solved.landmarks.tracks
    if not tracks.num_points:
        return None
    return _model(weighted(rays.drawn), tracks, solved.world_T_rigs, by_shared)


def _model(
    seen: Weighted, tracks: Tracks, world_T_rigs: np.ndarray, by_shared: BySharedParameters
) -> SharedModel:
    by_origin = -seen.by_point @ world_T_rigs[tracks.frames, :3, :3]
    jacobian = by_shared(seen.rows, by_origin, seen.residuals)
    sums = without_points(seen, tracks, len(world_T_rigs), seen.by_pose, jacobian)
    num, diagonal = len(sums.diagonal), sums.diagonal
    right = np.concatenate([sums.to_shared, sums.gradient[:, :, None]], axis=2).reshape(6 * num, -1)
    entries = np.einsum("nii->ni", diagonal)
    entries += np.where(entries > 0, _POSE_DAMPING * entries, 1.0)
    rows = np.repeat(np.arange(num), np.diff(sums.starts))
    cholesky = BlockCholesky(num, np.column_stack([rows, sums.columns]))
    if not cholesky.factorize(diagonal, sums.off_diagonal):
        raise ArithmeticError("a damped Hessian of poses is not positive definite")
    coupled = right.T @ cholesky.solve_all(right.T.reshape(-1, num, 6)).reshape(right.T.shape).T
    return SharedModel(
        sums.cost - 0.5 * float(coupled[-1, -1]),
        sums.shared_gradient - coupled[:-1, -1],
        sums.shared - coupled[:-1, :-1],
        seen.curvature,
    )


def without_points(
    seen: Weighted,
    tracks: Tracks,
    num_frames: int,
    by_frame: np.ndarray,
    by_shared: np.ndarray | None = None,
) -> Eliminated:
    """Normal equations of bearings with the points eliminated, by Jacobians (O, 2, K) of residuals
    by K variables of their frames, and (O, 2, S) by variables of all frames; None = there are none.
    """
    residuals = np.einsum("oij,oj->oi", seen.roots, seen.residuals)
    shared = np.zeros((len(residuals), 2, 0)) if by_shared is None else seen.roots @ by_shared
    of_point, of_frame = seen.roots @ seen.by_point, seen.roots @ by_frame
    return eliminate(
        num_frames, tracks.frames, tracks.points, residuals, of_point, of_frame, shared
    )


_MIN_GAIN_SIGMAS = 3.0  # least significant gain, in its standard deviations


P = TypeVar("P", "SharedModel", "FrameModel")


@dataclass(frozen=True, slots=True)
class PartGains:
    """Gains of parts by parameters that were found from the other parts."""

    gains: np.ndarray  # (PARTS,) float64, decrease of each part's robust cost by the
    # parameters of the other parts, beyond the baseline
    shares: np.ndarray  # (PARTS,) float64, gains as shares of the cost that the baseline leaves

    @property
    def predicts(self) -> bool:
        """True if the parameters surely predict parts that they were not found from."""
        return predicts(self.gains)


def cross_validate(
    parts: Sequence[P],
    candidate: Callable[[list[P]], np.ndarray],
    baseline: Callable[[list[P]], np.ndarray] | None = None,
) -> PartGains:
    """Predict each part of a sequence by the others: by the parameters of a candidate, and by those
    of a simpler baseline; None = all parameters are zero."""
    gains, costs = np.zeros(len(parts)), np.array([part.cost for part in parts])
    for p, part in enumerate(parts):
        others = [*parts[:p], *parts[p + 1 :]]
        before = 0.0 if baseline is None else part.gain(baseline(others))
        gains[p] = part.gain(candidate(others)) - before
        costs[p] -= before
    return PartGains(gains, gains / costs)


def predicts(gains: np.ndarray, least: float = _MIN_GAIN_SIGMAS) -> bool:
    """True if gains (PARTS,) in log-likelihood are surely more than chance.

    A gain of G by parameters that are true has a standard deviation of sqrt(2 G): the residuals'
    noise along their change. The sum of all parts must exceed none by at least `least` of these,
    and no part may surely lose.
    """
    total = float(gains.sum())
    sigma = np.sqrt(2 * max(total, 0.0))
    loss = _MIN_GAIN_SIGMAS * sigma / np.sqrt(len(gains))
    return bool(total > least * sigma and np.all(gains > -loss))


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


def frame_models(
    rays: ObservedRays, by_parameters: Callable[[Weighted], np.ndarray]
) -> list[FrameModel]:
    """Models of the robust cost of parts of the points, moved to their best first, at a solution's
    poses; by_parameters: Jacobian (O, 2, K) of residuals by parameters of their frames."""
    landmarks, num = rays.solved.landmarks, len(rays.solved.world_T_rigs)
    rng = np.random.default_rng(rays.context.settings.seed)
    drawn = rng.permutation(landmarks.tracks.num_points)

    def model(part: int) -> FrameModel:
        some = landmarks.of(drawn % PARTS == part)
        seen = weighted(rays.of(some))
        by_frame = np.concatenate([seen.by_pose, by_parameters(seen)], axis=2)
        sums = without_points(seen, some.tracks, num, by_frame)
        return FrameModel(sums.system(), seen.curvature)

    with ThreadPoolExecutor(rays.context.num_threads) as pool:
        return list(pool.map(model, range(PARTS)))


def frame_step(models: Sequence[FrameModel], sigmas: np.ndarray, alike: bool = False) -> np.ndarray:
    """Change of poses and parameters (F * (6 + K),) by all points of the models; sigmas: (K,) how
    strongly the parameters are drawn to what they are; 0 = they stay. alike: all frames change
    their parameters by the same."""
    systems, num = [model.system for model in models], 6 + len(sigmas)
    gradient = np.sum([system.gradient for system in systems], axis=0)
    hessian = sum(system.hessian for system in systems[1:]) + systems[0].hessian
    hessian = hessian * float(np.mean([model.curvature for model in models]))
    held = _POSE_DAMPING * hessian.diagonal().reshape(-1, num)
    held[held <= 0] = 1.0
    held[:, 6:] = np.maximum(sigmas, 1e-12) ** -2.0
    if not alike:
        return -splu((hessian + diags(held.ravel())).tocsc()).solve(gradient)
    frames, columns = np.arange(len(held))[:, None], np.arange(num)
    last = 6 * len(held)  # where the parameters that frames share start
    shared = np.where(columns < 6, 6 * frames + columns, last + columns - 6).ravel()
    ones = np.ones(len(shared))
    spread = csc_array((ones, (np.arange(len(shared)), shared)), (len(shared), last + num - 6))
    held[:, 6:] /= len(held)
    whole = spread.T @ (hessian + diags(held.ravel())) @ spread
    return -(spread @ splu(whole.tocsc()).solve(spread.T @ gradient))


def validated(models: Sequence[FrameModel], sigmas: np.ndarray, alike: bool = False) -> PartGains:
    """Verdict on parameters with priors `sigmas` (K,), poses solved for with and without them, or,
    where `alike`, with the same parameters for all frames instead of none."""
    before = sigmas if alike else np.zeros_like(sigmas)
    return cross_validate(
        models,
        lambda others: frame_step(others, sigmas),
        lambda others: frame_step(others, before, alike),
    )
