"""What the camera's calibration and stitching bend: a field fixed to the rig, found by the map."""

import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import splu

from factors.bearing import bearing_residuals, tangent_basis
from factors.robust import RobustLoss
from factors.sphere_field import SphereField, degrees_of, harmonics, num_harmonics
from gsba.bundle import adjustment
from gsba.bundle.adjustment import Problem
from gsba.camera.rig import CubeRig, owner_faces
from gsba.types import Counts, Keypoints, Landmarks, Round, Sighted, Solution, Tracks

logger = logging.getLogger(__name__)

PARTS = 4  # of the sequence: each is predicted by the field that the others give
_LEAST_FRAMES = 2 * PARTS
_LEAST_POINTS = 50  # of a part
_SPREADS = (1e-4, 3e-4, 1e-3, 3e-3)  # radians: a priori, of coefficients of degree 1; falls with
# the square of the degree
_GOOD_ENOUGH = 0.95  # of the best gain: the smoothest field that reaches it is taken
_POSE_DAMPING = 1e-4  # of the poses' information, against the map's free similarity
_POINT_DAMPING = 1e-9
_MOST = 60_000  # observations that a field is found from
_PROBE = 20_000, 4  # observations and degree of a first look: half the gain must show there


@dataclass(frozen=True, slots=True)
class Stitching:
    """A field, and the map solved with it."""

    field: SphereField  # coefficients (0,): nothing is corrected
    adjustment: Solution
    keypoints: Keypoints  # of the adjustment, as observed
    degree: int  # of the best field, taken or not
    part_gains: np.ndarray  # (PARTS,) float64, share of the robust cost of each part of the
    # sequence that the field of the other parts takes off, poses and points adjusted with and
    # without it
    counts: Counts  # of observations the field was found from

    @property
    def rounds(self) -> tuple[Round, ...]:
        """Of the adjustment, if there is a field."""
        return self.adjustment.rounds if self.field else ()


@dataclass(frozen=True, slots=True)
class _System:
    """Second-order model of a part's cost over a field, poses and points eliminated."""

    cost: float  # without a field
    gradient: np.ndarray  # (K,) there
    hessian: np.ndarray  # (K, K)

    def gain(self, coefficients: np.ndarray) -> float:
        """Decrease of the cost by a field of these first coefficients."""
        num = len(coefficients)
        slope = self.gradient[:num] + 0.5 * self.hessian[:num, :num] @ coefficients
        return float(-coefficients @ slope)

    def around(self, coefficients: np.ndarray) -> "_System":
        """The model around no field of one around a field of these first coefficients."""
        step = np.zeros(len(self.gradient))
        num = min(len(step), len(coefficients))
        step[:num] = -coefficients[:num]
        return _System(
            self.cost - self.gain(step), self.gradient + self.hessian @ step, self.hessian
        )


def corrected(keypoints: Keypoints, field: SphereField, rig: CubeRig) -> Keypoints:
    """Keypoints where they really point: bearings, faces, pixels and noise."""
    if not field:
        return keypoints
    bearings, roots = field.corrected(keypoints.bearings_rig), keypoints.sqrt_infos
    if roots is not None:
        roots = field.corrected_roots(keypoints.bearings_rig, roots)
    faces = owner_faces(bearings)
    pixels = rig.project(bearings, faces)
    return replace(keypoints, bearings_rig=bearings, sqrt_infos=roots, faces=faces, pixels=pixels)


def with_noise_of(keypoints: Keypoints, calibrated: Keypoints) -> Keypoints:
    """Keypoints whose noise is scaled as in others of the same rows, where they were corrected."""
    factors = calibrated.sigmas_rad / keypoints.sigmas_rad
    roots = keypoints.sqrt_infos
    scaled = None if roots is None else roots / factors[:, None, None]
    return replace(keypoints, sigmas_rad=calibrated.sigmas_rad, sqrt_infos=scaled)


def estimate(
    sighted: Sighted,
    keypoints: Keypoints,
    before: Solution,
    field: SphereField,
    problem: Problem,
) -> Stitching:
    """Find the field, by cross-validation over parts of the sequence, and solve the map with it.

    Points are shared out among parts of the sequence by their mean frame. A part's cost is a
    quadratic function of the field once its points and poses are eliminated; sums of those of
    the other parts give fields of every degree and smoothness, and the part itself says what they
    are worth. The field is taken where every part gains, and all together enough.

    Args:
        sighted: candidate tracks and their keypoints, as observed.
        keypoints: the same with the noise they turned out to have.
        before: the map solved with `field`.
        field: so far.
        problem: priors, limits, loss, solver.
    """
    settings = problem.settings
    chosen = settings.stitching
    whole = _MOST, chosen.max_degree, chosen.min_gain
    probe = _PROBE[0], min(_PROBE[1], chosen.max_degree), 0.5 * chosen.min_gain
    now = Stitching(field, before, keypoints, 0, np.zeros(PARTS), Counts(0, 0, "observations"))
    systems, spread = [], 0.0
    for most, max_degree, least in [whole] if field else [probe, whole]:
        systems, counts = _systems(now, most, max_degree, problem)
        if not systems:
            return replace(now, counts=counts)
        degree, spread, gains = _choose(systems, max_degree)
        costs = np.array([part.cost for part in systems])
        now = replace(now, degree=degree, part_gains=gains / costs, counts=counts)
        if gains.sum() < least * costs.sum() or np.any(gains <= 0):
            return now
    for number in range(chosen.rounds):
        if number:
            systems, _ = _systems(now, _MOST, chosen.max_degree, problem)
        field = SphereField(_fitted(systems, now.degree, spread))
        there = replace(sighted, keypoints=corrected(sighted.keypoints, field, problem.rig))
        gates = settings.rounds.aligned[-1:]
        solved, found = adjustment.adjust_sighted(there, now.adjustment, problem, gates)
        keypoints = with_noise_of(sighted.keypoints, found)
        now = replace(now, field=field, adjustment=solved, keypoints=keypoints)
    logger.info("stitching: %.4f deg rms, degree %d", np.rad2deg(field.rms_rad), now.degree)
    return now


def _systems(
    now: Stitching, most: int, max_degree: int, problem: Problem
) -> tuple[list[_System], Counts]:
    """Models of the cost of each part of the sequence; none where there is too little."""
    landmarks = _drawn(now.adjustment.landmarks, most, problem.settings.seed)
    counts = Counts(len(now.adjustment.landmarks.tracks), len(landmarks.tracks), "observations")
    there = corrected(now.keypoints, now.field, problem.rig)
    alone = replace(problem, num_threads=1)  # parts run side by side

    def model(part: Landmarks) -> _System:
        return _system(part, now, there, max_degree, alone)

    with ThreadPoolExecutor(problem.num_threads) as pool:
        return list(pool.map(model, _parts(landmarks))), counts


def _drawn(landmarks: Landmarks, most: int, seed: int) -> Landmarks:
    """A share of the points, drawn at random, where there are more than `most` observations."""
    tracks = landmarks.tracks
    share = most / max(len(tracks), 1)
    if share >= 1:
        return landmarks
    drawn = np.random.default_rng(seed).random(tracks.num_points) < share
    return _of_points(landmarks, drawn)


def _of_points(landmarks: Landmarks, chosen: np.ndarray) -> Landmarks:
    """Points `chosen (J,)` and their observations."""
    tracks = landmarks.tracks
    rows, numbers = chosen[tracks.points], np.cumsum(chosen) - 1
    kept = Tracks(
        numbers[tracks.points[rows]].astype(np.int32),
        tracks.frames[rows],
        tracks.keypoints[rows],
        int(np.count_nonzero(chosen)),
    )
    return Landmarks(landmarks.points_world[chosen], kept, landmarks.counts)


def _parts(landmarks: Landmarks) -> list[Landmarks]:
    """The points of each part of the sequence; no part where there is too little."""
    tracks = landmarks.tracks
    if len(np.unique(tracks.frames)) < _LEAST_FRAMES or tracks.num_points < _LEAST_POINTS * PARTS:
        return []
    seen = np.bincount(tracks.points, minlength=tracks.num_points)
    means = np.bincount(tracks.points, tracks.frames, tracks.num_points) / np.maximum(seen, 1)
    ranks = np.argsort(np.argsort(means, kind="stable"), kind="stable")
    part = ranks * PARTS // tracks.num_points
    return [_of_points(landmarks, part == p) for p in range(PARTS)]


def _system(
    landmarks: Landmarks,
    now: Stitching,
    there: Keypoints,
    max_degree: int,
    problem: Problem,
) -> _System:
    """Model of the robust cost of some points, keypoints corrected by the field so far."""
    keypoints, solved, field, noise = now.keypoints, now.adjustment, now.field, now.adjustment.noise
    block = adjustment.landmark_block(landmarks, there, noise, problem)
    block.polish(adjustment.values_of(solved.world_T_rigs))
    tracks, rows = landmarks.tracks, keypoints.rows(landmarks.tracks)
    residuals, by_pose, by_point = bearing_residuals(
        solved.world_T_rigs[tracks.frames], block.points_world[tracks.points],
        there.bearings_rig[rows],
    )  # fmt: skip
    observed = keypoints.bearings_rig[rows]
    by_field = -tangent_basis(there.bearings_rig[rows]) @ harmonics(observed, max_degree)
    roots = np.eye(2) / there.sigmas_rad[rows, None, None]
    if there.sqrt_infos is not None:
        roots = there.sqrt_infos[rows]
    whitened = np.einsum("oij,oj->oi", roots, residuals) / noise
    solver = problem.settings.solver
    loss = RobustLoss(solver.loss, solver.loss_sigmas)
    roots = np.sqrt(loss.weights(np.sum(whitened**2, axis=1)))[:, None, None] * roots / noise
    reduced = _reduced(
        tracks,
        len(solved.world_T_rigs),
        np.einsum("oij,oj->oi", roots, residuals),
        roots @ by_pose,
        roots @ by_point,
        roots @ by_field,
    )
    return reduced.around(field.coefficients)


def _reduced(
    tracks: Tracks,
    num_frames: int,
    residuals: np.ndarray,
    by_pose: np.ndarray,
    by_point: np.ndarray,
    by_field: np.ndarray,
) -> _System:
    """Eliminate points, then poses, from weighted residuals (O, 2) and their Jacobians."""
    num = len(tracks)
    right = np.concatenate([by_field, residuals[:, :, None]], axis=2).reshape(2 * num, -1)
    poses = _sparse(by_pose, tracks.frames, num_frames)
    points = _sparse(by_point, tracks.points, tracks.num_points)
    normal = np.zeros((tracks.num_points, 3, 3))
    np.add.at(normal, tracks.points, np.einsum("oki,okj->oij", by_point, by_point))
    traces = np.trace(normal, axis1=1, axis2=2)[:, None, None]
    inverse = np.linalg.inv(normal + (_POINT_DAMPING * traces + 1e-200) * np.eye(3))
    blocks = _block_diagonal(inverse)
    rest = right - points @ (blocks @ (points.T @ right))  # what points cannot take up
    among = (points.T @ poses).tocsr()
    of_poses = (poses.T @ poses - among.T @ blocks @ among).tocsc()
    curvature = of_poses.diagonal()
    idle = curvature <= 0
    of_poses = of_poses + diags(np.where(idle, 1.0, _POSE_DAMPING * curvature), format="csc")
    coupled = poses.T @ rest
    inner = right.T @ rest - coupled.T @ splu(of_poses.tocsc()).solve(coupled)
    return _System(0.5 * float(inner[-1, -1]), inner[:-1, -1], inner[:-1, :-1])


def _sparse(jacobians: np.ndarray, columns: np.ndarray, num: int) -> csr_matrix:
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


def _fitted(systems: list[_System], degree: int, spread: float) -> np.ndarray:
    """Coefficients (K,) of the field that the parts ask for, drawn to none."""
    num = num_harmonics(degree)
    pull = degrees_of(num) ** 4 / spread**2
    gradient = sum(part.gradient[:num] for part in systems)
    hessian = sum((part.hessian[:num, :num] for part in systems), np.diag(pull))
    return -np.linalg.solve(hessian, gradient)


def _choose(systems: list[_System], max_degree: int) -> tuple[int, float, np.ndarray]:
    """Degree and spread of the smoothest field that predicts parts well, and the parts' gains."""
    tried = [
        (degree, spread, _gains(systems, degree, spread))
        for spread in _SPREADS
        for degree in range(1, max_degree + 1)
    ]
    best = max(gains.sum() for _, _, gains in tried)
    return next(trial for trial in tried if trial[2].sum() >= min(_GOOD_ENOUGH * best, best))


def _gains(systems: list[_System], degree: int, spread: float) -> np.ndarray:
    """What each part (PARTS,) gains from the field of the others."""
    return np.array(
        [
            part.gain(_fitted(systems[:p] + systems[p + 1 :], degree, spread))
            for p, part in enumerate(systems)
        ]
    )
