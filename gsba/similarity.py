"""Similarities of two worlds, from points or poses that both have, some of them wrong."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gsba.geometry import nearest_rotation, pose
from gsba.log import GsbaError

_LEAST_ALIKE = 1e-6  # correlation of positions: below, the scale that carries them vanishes
_DRAWS, _SEED = 500, 0
_ALIKE = 0.5  # least correlation of the points and where the similarity carries them
_MEDIAN_LENGTH = 1.538  # of a 3-vector of independent unit normals
_OUTLIER_SIGMAS = 4.6  # 99.99% of such vectors are shorter
_TRIALS = 200  # of three points each
_POINT_DEG = 1.0  # a point of one frame's map seen in the other
_MIN_POINTS = 15


@dataclass(frozen=True, slots=True)
class Sim3:
    """A change of world: new = scale * rotation @ old + translation."""

    scale: float = 1.0  # new units per old one, positive
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))  # (3, 3) float64
    translation: np.ndarray = field(default_factory=lambda: np.zeros(3))  # (3,) float64, new units

    @classmethod
    def of(cls, scale: float, new_T_old: np.ndarray) -> "Sim3":
        """With the rotation and translation of a rigid pose (4, 4)."""
        return cls(scale, new_T_old[:3, :3], new_T_old[:3, 3])

    @property
    def new_T_old(self) -> np.ndarray:
        """Rotation and translation, without the scale, as a pose (4, 4)."""
        return pose(self.rotation, self.translation)

    def inverse(self) -> "Sim3":
        """From the new world to the old one."""
        rotation = self.rotation.T
        return Sim3(1 / self.scale, rotation, -rotation @ self.translation / self.scale)

    def after(self, first: "Sim3") -> "Sim3":
        """The change of world `first`, and then this one."""
        return Sim3.of(self.scale * first.scale, self.poses(first.new_T_old))

    def points(self, old: np.ndarray) -> np.ndarray:
        """Points (N, 3) of the old world in the new one."""
        return self.scale * old @ self.rotation.T + self.translation

    def points_back(self, new: np.ndarray) -> np.ndarray:
        """Points (N, 3) of the new world in the old one."""
        return (new - self.translation) @ self.rotation / self.scale

    def poses(self, old_T_rigs: np.ndarray) -> np.ndarray:
        """Poses (..., 4, 4) in the old world as they are in the new one."""
        positions = self.scale * old_T_rigs[..., :3, 3] @ self.rotation.T + self.translation
        return pose(self.rotation @ old_T_rigs[..., :3, :3], positions)


class NoSimilarityError(GsbaError):
    """No positive scale carries one set of positions onto the other."""


def similarity(source: np.ndarray, target: np.ndarray) -> Sim3:
    """Least-squares similarity of points: Umeyama, PAMI 13(4), 1991.

    Args:
        source, target: (N, 3) float64, N >= 3, not all on one point.

    Raises:
        NoSimilarityError: the targets are all on one point, or not where any turn has the sources.
    """
    s, t = source - source.mean(axis=0), target - target.mean(axis=0)
    return turned_similarity(source, target, nearest_rotation(t.T @ s / len(s)))


def pose_similarity(
    source_T_rigs: np.ndarray, target_T_rigs: np.ndarray, least_alike: float = _LEAST_ALIKE
) -> Sim3:
    """Similarity that carries one set of poses onto another of the same rigs.

    The rotation is the chordal mean over orientations, so that a straight path will do; scale and
    translation are least squares over positions; a rig that never moves leaves the scale at 1.

    Args:
        source_T_rigs, target_T_rigs: (N, 4, 4) poses of the same rigs in two worlds.
        least_alike: see `turned_similarity`.

    Raises:
        NoSimilarityError: the rigs are not where the targets have them, at no positive scale.
    """
    between = np.einsum("nij,nkj->ik", target_T_rigs[:, :3, :3], source_T_rigs[:, :3, :3])
    source, target = source_T_rigs[:, :3, 3], target_T_rigs[:, :3, 3]
    return turned_similarity(source, target, nearest_rotation(between), least_alike)


def turned_similarity(
    source: np.ndarray, target: np.ndarray, rotation: np.ndarray, least_alike: float = _LEAST_ALIKE
) -> Sim3:
    """The similarity with a given rotation, scale and translation being least squares.

    Every similarity of gsba ends here: an inverted or vanishing world is none.

    Args:
        source, target: (N, 3) float64, N >= 1; sources on one point leave the scale at 1.
        rotation: (3, 3).
        least_alike: correlation of both, once turned, from 0 to 1, that there must be.

    Raises:
        NoSimilarityError: positions correlate less, so that their scale would be nothing's.
    """
    turned = source @ rotation.T
    s, t = turned - turned.mean(axis=0), target - target.mean(axis=0)
    spread, across, wanted = (float(np.sum(a * b)) for a, b in ((s, s), (s, t), (t, t)))
    if spread <= 1e-24 * float(np.sum(source * source)):  # on one point, but for rounding
        scale = 1.0
    elif across > least_alike * np.sqrt(spread * wanted) > 0:
        scale = across / spread
    else:
        raise NoSimilarityError(
            "no positive scale carries one set of positions onto the other: they have nothing in "
            "common"
        )
    return Sim3(scale, rotation, target.mean(axis=0) - scale * turned.mean(axis=0))


def level_similarity(source: np.ndarray, target: np.ndarray) -> Sim3:
    """Least-squares similarity that turns around z only: scale, heading and shift.

    Closed form of the plane (Umeyama's with complex numbers); heights only help the scale.

    Raises:
        NoSimilarityError: see `gsba.similarity.turned_similarity`.
    """
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
) -> tuple[Sim3, np.ndarray, float]:
    """Similarity of most of the points, whatever fewer than half of them say.

    Least median of squares over random draws (Rousseeuw, JASA 79, 1984), then least squares over
    what lies within the noise, until that settles.

    Args:
        source, target: (N, 3) float64.
        solve: least squares over some of them.
        num_needed: how many it needs at least.

    Returns:
        the similarity, (N,) bool what it rests on, and their RMS residual in target units.

    Raises:
        NoSimilarityError: the points of both have little in common.
    """
    rng = np.random.default_rng(_SEED)
    best, fit = np.inf, None
    draws = (rng.choice(len(source), num_needed, replace=False) for _ in range(_DRAWS))
    for draw in draws if len(source) > num_needed else [np.arange(len(source))]:
        try:
            candidate = solve(source[draw], target[draw])
        except NoSimilarityError:
            continue
        median = float(np.median(residuals_of(candidate, source, target)))
        if median < best:
            best, fit = median, candidate
    fit = fit or solve(source, target)
    extent = float(np.linalg.norm(np.ptp(target, axis=0)))
    used = np.ones(len(source), bool)
    for _ in range(20):
        residuals = residuals_of(fit, source, target)
        sigma = max(float(np.median(residuals)) / _MEDIAN_LENGTH, 1e-9 * extent)
        before, used = used, residuals <= _OUTLIER_SIGMAS * sigma
        fit = solve(source[used], target[used])
        if np.array_equal(before, used):
            break
    turned_similarity(source[used], target[used], fit.rotation, _ALIKE)
    rms = float(np.sqrt(np.mean(residuals_of(fit, source, target)[used] ** 2)))
    return fit, used, rms


def residuals_of(fit: Sim3, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Distances (N,) between targets and carried sources."""
    return np.linalg.norm(fit.points(source) - target, axis=1)


def extents(positions: np.ndarray) -> np.ndarray:
    """Extents (3,) along the principal axes, as parts of the largest."""
    values = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
    values = np.concatenate([values, np.zeros(3)])[:3]
    return values / max(float(values[0]), 1e-12)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Say that it is this file's positions which no similarity fits."""
    try:
        yield
    except NoSimilarityError:
        raise GsbaError(
            f"{path}: its positions and the frames' have nothing in common: check that they are "
            "of this recording and on the frames' clock, and that the path is longer than they "
            "are wrong"
        ) from None


def relative_map(
    points0: np.ndarray, points1: np.ndarray, seed: int
) -> tuple[np.ndarray, int] | None:
    """Pose of one frame in another from the same points in both, each with a scale of its own.

    Args:
        points0, points1: (m, 3) points in the rigs of both frames, map units.
        seed: of the sampling.

    Returns:
        f0_T_f1 (4, 4) in the units of frame 0, and how many points agree; None if too few.
    """
    found = relative_similarity(points0, points1, seed)
    return None if found is None else (found[0].new_T_old, int(found[1].sum()))


def relative_similarity(
    points0: np.ndarray, points1: np.ndarray, seed: int, least: int = _MIN_POINTS
) -> tuple[Sim3, np.ndarray] | None:
    """As `relative_map`: rig 1 in rig 0, with its unit; and which points (m,) agree, if `least`."""
    if len(points0) < least:
        return None
    rng = np.random.default_rng(seed)
    best = np.zeros(len(points0), bool)
    for _ in range(_TRIALS):
        three = rng.choice(len(points0), 3, replace=False)
        agree = _agree(points0, points1, three)
        best = agree if agree.sum() > best.sum() else best
    for _ in range(3):
        if best.sum() < least:
            return None
        best = _agree(points0, points1, np.flatnonzero(best))
    if best.sum() < least:
        return None
    return similarity(points1[best], points0[best]), best


def similarity_along(
    points0: np.ndarray, points1: np.ndarray, f0_T_f1: np.ndarray, least: int = _MIN_POINTS
) -> tuple[Sim3, np.ndarray] | None:
    """Similarity of two rigs whose rotation and direction bearings have told already.

    Points whose distances are poorly known give a poor rotation, three at a time; bearings do not.
    What is left, the ratio of the step's length and the scale, each point tells alone.

    Args:
        points0, points1: (m, 3) points in the rigs of both frames, each in units of its own.
        f0_T_f1: (4, 4) relative pose, whose translation has any length.
        least: points that have to agree.

    Returns:
        rig 1 in rig 0, with its unit, and which points (m,) agree; None if too few.
    """
    rotation, direction = f0_T_f1[:3, :3], f0_T_f1[:3, 3]
    direction = direction / max(float(np.linalg.norm(direction)), 1e-12)
    turned = points1 @ rotation.T
    # Along each bearing of frame 0 lies turned + ratio * direction.
    across, normal = np.cross(points0, direction), np.cross(points0, turned)
    squares = np.sum(across**2, axis=1)
    ratios = -np.sum(across * normal, axis=1) / np.maximum(squares, 1e-24)
    best, agree = None, np.zeros(len(points0), bool)
    for ratio in [0.0, *ratios]:
        fit = _scaled(points0, turned + ratio * direction, rotation, ratio * direction)
        fits = agreeing_points(points0, points1, fit)
        if fits.sum() > agree.sum():
            best, agree = fit, fits
    for _ in range(2 if agree.sum() >= least else 0):
        ratio = float(np.median(ratios[agree]))
        at = turned[agree] + ratio * direction
        fit = _scaled(points0[agree], at, rotation, ratio * direction)
        fits = agreeing_points(points0, points1, fit)
        if fits.sum() < agree.sum():
            break
        best, agree = fit, fits
    return None if best is None or agree.sum() < least else (best, agree)


def _scaled(
    points0: np.ndarray, points1: np.ndarray, rotation: np.ndarray, step: np.ndarray
) -> Sim3:
    """The similarity whose scale is the median ratio of distances; `step` (3,) in unit 1."""
    lengths0, lengths1 = (np.linalg.norm(points, axis=1) for points in (points0, points1))
    scale = float(np.median(lengths0 / np.maximum(lengths1, 1e-12)))
    return Sim3(scale, rotation, scale * step)


def _agree(points0: np.ndarray, points1: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Which points (m,) are seen alike from both frames under the fit to some of them."""
    try:
        fit = similarity(points1[chosen], points0[chosen])
    except NoSimilarityError:
        return np.zeros(len(points0), bool)
    return agreeing_points(points0, points1, fit)


def agreeing_points(points0: np.ndarray, points1: np.ndarray, fit: Sim3) -> np.ndarray:
    """Which points (m, 3) of two rigs are seen alike from both (m,) bool; `fit`: rig 1 in rig 0."""
    in0, in1 = fit.points(points1), fit.points_back(points0)
    limit = np.cos(np.deg2rad(_POINT_DEG))
    return (_cosines(in0, points0) > limit) & (_cosines(in1, points1) > limit)


def _cosines(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    return np.einsum("mi,mi->m", a, b) / np.maximum(lengths, 1e-12)
