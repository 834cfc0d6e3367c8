"""Similarity transforms of two worlds, from corresponding points or poses with outliers."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np

from gsba.geometry import extent_of, nearest_rotation, pose
from gsba.log import GsbaError
from gsba.significance import MEDIAN_NORMAL_LENGTH, OUTLIER_LENGTH

_MIN_CORRELATION = 1e-6  # smallest correlation of positions that leaves a positive scale
_MIN_DRAWS, _MAX_DRAWS, _SEED = 50, 500, 0  # samples of a robust similarity
_MISS_CHANCE = 1e-9  # of an outlier in every sample, at the largest share of inliers so far
_NUM_TRIALS = 200  # samples of three points each
_MIN_POINTS = 15
_RATIOS_AT_ONCE = 64  # lengths of a step tried in one array


@dataclass(frozen=True, slots=True)
class Sim3:
    """Similarity transform between worlds: new = scale * rotation @ old + translation."""

    scale: float = 1.0  # new units per old one, positive
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))  # (3, 3) float64
    translation: np.ndarray = field(default_factory=lambda: np.zeros(3))  # (3,) float64, new units

    @classmethod
    def of(cls, scale: float, new_T_old: np.ndarray) -> "Sim3":
        """Similarity with the rotation and translation of a rigid pose (4, 4)."""
        return cls(scale, new_T_old[:3, :3], new_T_old[:3, 3])

    @property
    def new_T_old(self) -> np.ndarray:
        """Rotation and translation, without the scale, as a pose (4, 4)."""
        return pose(self.rotation, self.translation)

    def inverse(self) -> "Sim3":
        """Similarity from the new world to the old one."""
        rotation = self.rotation.T
        return Sim3(1 / self.scale, rotation, -rotation @ self.translation / self.scale)

    def after(self, first: "Sim3") -> "Sim3":
        """Composition: `first`, then this one."""
        return Sim3.of(self.scale * first.scale, self.poses(first.new_T_old))

    def points(self, old: np.ndarray) -> np.ndarray:
        """Points (N, 3) transformed from the old world to the new one."""
        return self.scale * old @ self.rotation.T + self.translation

    def points_back(self, new: np.ndarray) -> np.ndarray:
        """Points (N, 3) transformed from the new world to the old one."""
        return (new - self.translation) @ self.rotation / self.scale

    def moved(self, step: np.ndarray, about: np.ndarray) -> "Sim3":
        """This one, then a step (7,) about a point (3,) of the new world: rotation vector, radians,
        translation, and logarithm of the scale."""
        from scipy.spatial.transform import Rotation

        turn, stretch = Rotation.from_rotvec(step[:3]).as_matrix(), float(np.exp(step[6]))
        shift = stretch * turn @ (self.translation - about) + about + step[3:6]
        return Sim3(stretch * self.scale, turn @ self.rotation, shift)

    def poses(self, old_T_rigs: np.ndarray) -> np.ndarray:
        """Poses (..., 4, 4) transformed from the old world to the new one."""
        positions = self.scale * old_T_rigs[..., :3, 3] @ self.rotation.T + self.translation
        return pose(self.rotation @ old_T_rigs[..., :3, :3], positions)


class NoSimilarityError(GsbaError):
    """No positive scale maps one set of positions to the other."""


def similarity(source: np.ndarray, target: np.ndarray) -> Sim3:
    """Least-squares similarity of points (N, 3), N >= 3: Umeyama, PAMI 13(4), 1991.
    NoSimilarityError if targets are all on one point, or uncorrelated with the sources."""
    s, t = source - source.mean(axis=0), target - target.mean(axis=0)
    return turned_similarity(source, target, nearest_rotation(t.T @ s / len(s)))


def pose_similarity(
    source_T_rigs: np.ndarray, target_T_rigs: np.ndarray, min_correlation: float = _MIN_CORRELATION
) -> Sim3:
    """Similarity between worlds of poses (N, 4, 4) of the same rigs: rotation by the chordal mean
    over orientations, so that a straight path suffices, scale and translation by least squares over
    positions; a rig that never moves leaves the scale at 1. For NoSimilarityError see
    `turned_similarity`."""
    between = np.einsum("nij,nkj->ik", target_T_rigs[:, :3, :3], source_T_rigs[:, :3, :3])
    source, target = source_T_rigs[:, :3, 3], target_T_rigs[:, :3, 3]
    return turned_similarity(source, target, nearest_rotation(between), min_correlation)


def turned_similarity(
    source: np.ndarray,
    target: np.ndarray,
    rotation: np.ndarray,
    min_correlation: float = _MIN_CORRELATION,
) -> Sim3:
    """Similarity with a given rotation; scale and translation are least squares.

    Every similarity of gsba is made here, so that none has a negative or vanishing scale.

    Args:
        source, target: (N, 3) float64, N >= 1; sources on one point leave the scale at 1.
        rotation: (3, 3).
        min_correlation: smallest correlation, 0 to 1, of the rotated sources with the targets.

    Raises:
        NoSimilarityError: the positions' correlation is smaller.
    """
    turned = source @ rotation.T
    s, t = turned - turned.mean(axis=0), target - target.mean(axis=0)
    spread, across, wanted = (float(np.sum(a * b)) for a, b in ((s, s), (s, t), (t, t)))
    if spread <= 1e-24 * float(np.sum(source * source)):  # all on one point, up to rounding
        scale = 1.0
    elif across > min_correlation * np.sqrt(spread * wanted) > 0:
        scale = across / spread
    else:
        raise NoSimilarityError(
            "no positive scale maps one set of positions to the other: they are not correlated"
        )
    return Sim3(scale, rotation, target.mean(axis=0) - scale * turned.mean(axis=0))


def level_similarity(source: np.ndarray, target: np.ndarray) -> Sim3:
    """Least-squares similarity whose rotation is around z, in closed form (Umeyama's with complex
    numbers); heights only constrain the scale. For NoSimilarityError see `turned_similarity`."""
    mean_s, mean_t = source.mean(axis=0), target.mean(axis=0)
    s, t = source - mean_s, target - mean_t
    cross = np.sum((t[:, 0] + 1j * t[:, 1]) * (s[:, 0] - 1j * s[:, 1]))
    turn = cross / max(abs(cross), 1e-300)
    rotation = np.array([[turn.real, -turn.imag, 0], [turn.imag, turn.real, 0], [0, 0, 1.0]])
    return turned_similarity(source, target, rotation)


def robust_similarity(
    source: np.ndarray,
    target: np.ndarray,
    solve: Callable[[np.ndarray, np.ndarray], Sim3],
    num_needed: int,
    tolerances: np.ndarray,
    drift: float,
) -> tuple[Sim3, np.ndarray]:
    """Similarity of corresponding points, some of which are outliers.

    The largest consensus under a truncated loss over random draws (Torr and Zisserman, MLESAC,
    CVIU 78, 2000), then least squares over the inliers until these no longer change. No residual
    of an inlier exceeds what both sides claim, so that outliers cannot widen the gate. The inliers
    may be the smaller part: callers decide whether they suffice.

    Args:
        source, target: (N, 3) float64.
        num_needed: smallest number of points that `solve` takes.
        tolerances: (N,) largest error of each target, target units.
        drift: largest error of the sources, part of their extent.

    Returns:
        the similarity, and its inliers (N,) bool.

    Raises:
        NoSimilarityError: too few agree, or the inliers of both worlds are barely correlated.
    """
    rng, reach = np.random.default_rng(_SEED), drift * extent_of(source)
    best, fit, enough = np.inf, None, float(_MAX_DRAWS)
    draws = (rng.choice(len(source), num_needed, replace=False) for _ in range(_MAX_DRAWS))
    for n, draw in enumerate(draws if len(source) > num_needed else [np.arange(len(source))]):
        if n >= max(enough, _MIN_DRAWS):
            break
        try:
            candidate = solve(source[draw], target[draw])
        except NoSimilarityError:
            continue
        shares = residuals_of(candidate, source, target) / (tolerances + reach * candidate.scale)
        loss = float(np.sum(np.minimum(shares**2, 1.0)))
        if loss < best:
            best, fit = loss, candidate
            spoilt = 1 - float(np.mean(shares <= 1)) ** num_needed  # chance that a sample is
            enough = np.log(_MISS_CHANCE) / np.log(np.clip(spoilt, 1e-300, 1 - 1e-12))
    fit = fit or solve(source, target)
    extent = extent_of(target)
    used = np.ones(len(source), bool)
    for _ in range(20):
        residuals = residuals_of(fit, source, target)
        sigma = max(float(np.median(residuals)) / MEDIAN_NORMAL_LENGTH, 1e-9 * extent)
        gates = np.minimum(OUTLIER_LENGTH * sigma, tolerances + reach * fit.scale)
        before, used = used, residuals <= gates
        if used.sum() < num_needed:
            raise NoSimilarityError(f"only {used.sum()} of {len(used)} positions agree")
        fit = solve(source[used], target[used])
        if np.array_equal(before, used):
            break
    # Inliers must correlate with their transformed positions
    turned_similarity(source[used], target[used], fit.rotation, 0.5)
    return fit, used


def residuals_of(fit: Sim3, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Distances (N,) between targets and transformed sources."""
    return np.linalg.norm(fit.points(source) - target, axis=1)


def is_mirrored(source: np.ndarray, target: np.ndarray) -> bool:
    """True if points (N, 3) fit a mirror image of the targets at least twice as well, by the RMS of
    residuals. Plane and straight paths, and three points, fit both alike."""
    own, mirrored = (
        residuals_of(similarity(source, ends), source, ends)
        for ends in (target, target * [-1.0, 1.0, 1.0])
    )
    extent = extent_of(target)
    return bool(np.sum(own**2) > 4 * np.sum(mirrored**2) + len(source) * (1e-9 * extent) ** 2)


def extents(positions: np.ndarray) -> np.ndarray:
    """Extents (3,) along the principal axes, as parts of the largest."""
    values = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
    values = np.concatenate([values, np.zeros(3)])[:3]
    return values / max(float(values[0]), 1e-12)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Name the file in the message where no similarity fits its positions."""
    try:
        yield
    except NoSimilarityError:
        raise GsbaError(
            f"{path}: its positions and the frames' are not correlated: check that the file is of "
            "this recording, that its times are on the frames' clock, and that the path is longer "
            "than the error of the positions"
        ) from None


def relative_similarity(
    points0: np.ndarray, points1: np.ndarray, seed: int, least: int = _MIN_POINTS
) -> tuple[Sim3, np.ndarray] | None:
    """Similarity from rig 1 to rig 0 by corresponding points (m, 3) in both, each rig with its own
    scale, and its inliers (m,) bool; None if fewer than `least`."""
    if len(points0) < least:
        return None
    # Inliers (T, m) bool of similarities that fit three points each, rows (T, 3)
    triples = _triples(len(points0), seed)
    source, target = points1[triples], points0[triples]
    s, t = source - source.mean(axis=1, keepdims=True), target - target.mean(axis=1, keepdims=True)
    u, _, vt = np.linalg.svd(np.swapaxes(t, 1, 2) @ s)
    u[:, :, 2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))[:, None]
    rotations = u @ vt
    s = s @ np.swapaxes(rotations, 1, 2)
    spread, across, wanted = (np.sum(a * b, axis=(1, 2)) for a, b in ((s, s), (s, t), (t, t)))
    fits = across > np.maximum(_MIN_CORRELATION * np.sqrt(spread * wanted), 0.0)
    scales = np.divide(across, spread, out=np.ones_like(across), where=fits)[:, None, None]
    turned = source.mean(axis=1, keepdims=True) @ np.swapaxes(rotations, 1, 2)
    shifts = target.mean(axis=1, keepdims=True) - scales * turned
    agree = are_aligned(scales * (points1 @ np.swapaxes(rotations, 1, 2)) + shifts, points0)
    agree &= are_aligned((points0 - shifts) @ rotations / scales, points1)
    inliers = agree & fits[:, None]
    best = inliers[np.argmax(inliers.sum(axis=1))]
    for _ in range(3):
        if best.sum() < least:
            return None
        try:
            fit = similarity(points1[best], points0[best])
        except NoSimilarityError:
            return None
        best = agreeing_points(points0, points1, fit)
    if best.sum() < least:
        return None
    return similarity(points1[best], points0[best]), best


@lru_cache(maxsize=256)
def _triples(num: int, seed: int) -> np.ndarray:
    """Rows (T, 3) of three of `num` points each: the same for all pairs of frames."""
    rng = np.random.default_rng(seed)
    return np.array([rng.choice(num, 3, replace=False) for _ in range(_NUM_TRIALS)])


def similarity_along(
    points0: np.ndarray, points1: np.ndarray, f0_T_f1: np.ndarray, least: int = _MIN_POINTS
) -> tuple[Sim3, np.ndarray] | None:
    """Similarity of two rigs whose rotation and direction of translation are given.

    Three points with uncertain distances give a poor rotation; bearings give a good one. Each point
    alone then determines the length of the step and the scale.

    Args:
        points0, points1: (m, 3) points in the rigs of both frames, each in its own unit.
        f0_T_f1: (4, 4) relative pose, whose translation has any length.

    Returns:
        similarity from rig 1 to rig 0, and its inliers (m,) bool; None if too few.
    """
    rotation, direction = f0_T_f1[:3, :3], f0_T_f1[:3, 3]
    direction = direction / max(float(np.linalg.norm(direction)), 1e-12)
    turned = points1 @ rotation.T
    # Along each bearing of frame 0 lies turned + ratio * direction.
    across, normal = np.cross(points0, direction), np.cross(points0, turned)
    squares = np.sum(across**2, axis=1)
    ratios = -np.sum(across * normal, axis=1) / np.maximum(squares, 1e-24)
    best, agree = None, np.zeros(len(points0), bool)
    tried = np.concatenate([[0.0], ratios])
    for some in np.split(tried, range(_RATIOS_AT_ONCE, len(tried), _RATIOS_AT_ONCE)):
        at = turned + some[:, None, None] * direction
        lengths = np.maximum(np.linalg.norm(at, axis=2), 1e-12)
        scales = np.median(np.linalg.norm(points0, axis=1) / lengths, axis=1)
        in1 = (points0 / scales[:, None, None] - some[:, None, None] * direction) @ rotation
        inliers = are_aligned(at, points0) & are_aligned(in1, points1)
        n = int(np.argmax(inliers.sum(axis=1)))
        if inliers[n].sum() > agree.sum():
            step = scales[n] * some[n] * direction
            best, agree = Sim3(float(scales[n]), rotation, step), inliers[n]
    for _ in range(2 if agree.sum() >= least else 0):
        ratio = float(np.median(ratios[agree]))
        at = turned[agree] + ratio * direction
        lengths0, lengths1 = (np.linalg.norm(points, axis=1) for points in (points0[agree], at))
        scale = float(np.median(lengths0 / np.maximum(lengths1, 1e-12)))
        fit = Sim3(scale, rotation, scale * (ratio * direction))
        fits = agreeing_points(points0, points1, fit)
        if fits.sum() < agree.sum():
            break
        best, agree = fit, fits
    return None if best is None or agree.sum() < least else (best, agree)


def agreeing_points(points0: np.ndarray, points1: np.ndarray, fit: Sim3) -> np.ndarray:
    """Inliers (m,) bool: points (m, 3) whose bearings agree in both rigs; `fit`: rig 1 to rig 0."""
    in0, in1 = fit.points(points1), fit.points_back(points0)
    return are_aligned(in0, points0) & are_aligned(in1, points1)


def are_aligned(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """True (..., m) where vectors (..., m, 3) and (m, 3) are less than a degree apart."""
    lengths = np.linalg.norm(one, axis=-1) * np.linalg.norm(other, axis=-1)
    limit = np.cos(np.deg2rad(1.0))
    return np.einsum("...mi,...mi->...m", one, other) > limit * np.maximum(lengths, 1e-12)
