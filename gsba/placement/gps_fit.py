"""Where a map lies on the earth, by GPS fixes of its frames and what else is known of it."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from gsba.bundle.fixes import FrameFixes
from gsba.similarity import Sim3, level_similarity, robust_similarity, similarity

_MEDIAN_LENGTH = 1.538  # of a 3-vector of independent unit normals
_OUTLIER_SIGMAS = 4.6  # 99.99 % of such vectors are shorter
_ROUNDS, _STEPS = 20, 20  # of choosing fixes, and of Gauss-Newton in each
_SETTLED = 1e-10  # step in units of the unknowns' own scale
_LEVEL = (0, 3, 4, 5, 6)  # unknowns that are free where up is known
_FREE = tuple(range(7))


@dataclass(frozen=True, slots=True)
class GpsFit:
    """A similarity onto local level metres, and how well the fixes determine it."""

    similarity: Sim3
    used: np.ndarray  # (G,) bool, fixes that it rests on
    centre: np.ndarray  # (3,) float64, map units: where `covariance` has the translation
    covariance: np.ndarray  # (7, 7) float64: log scale; turn about east, north and up, radians;
    # shift of the centre, metres. Its errors multiply and turn from the left
    rms_m: float  # of the distances of the fixes used
    misfit: float  # of residuals in their standard deviations, rms; above 1 covariances grow by it

    @property
    def scale_sigma(self) -> float:
        """Standard deviation of the scale, as a part of it."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def heading_sigma(self) -> float:
        """Standard deviation of the heading, radians."""
        return float(np.sqrt(self.covariance[3, 3]))

    @property
    def tilt_sigma(self) -> float:
        """Standard deviation of the vertical in its worst direction, radians."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[1:3, 1:3])[-1]))

    def position_sigmas(self, points: np.ndarray) -> np.ndarray:
        """Standard deviations (N, 3) east, north and up, metres, of points (N, 3) of the map."""
        columns = _columns(self.similarity, points - self.centre)
        return np.sqrt(np.einsum("nia,ab,nib->ni", columns, self.covariance, columns))


def fit_fixes(
    positions: np.ndarray,
    fixes: FrameFixes,
    up_sigma: float | None = None,
    scale: tuple[float, float] | None = None,
) -> GpsFit:
    """Most probable similarity of a map onto GPS fixes whose errors last, without false fixes.

    Least squares with the inverse covariance of all fixes (`gsba.bundle.fixes`), from a start
    by `gsba.similarity.robust_similarity`. A fix is false where it is further off than 4.6 of its
    standard deviations, or than as many of what the fixes scatter where that is more.

    Args:
        positions: (G, 3) frames of the fixes in the map, map units, not all on one point.
        fixes: where GPS had them.
        up_sigma: of the direction +z of the map, radians, which is up then and stays so.
            None = up is not known.
        scale: metres per map unit, known from elsewhere, and its standard deviation.

    Raises:
        NoSimilarityError: positions and fixes have little in common.
    """
    solve, num = (similarity, 3) if up_sigma is None else (level_similarity, 2)
    fit, used, _ = robust_similarity(positions, fixes.positions, solve, num)
    centre, free = positions[used].mean(axis=0), _FREE if up_sigma is None else _LEVEL
    information = np.zeros((7, 7))
    for _ in range(_ROUNDS):
        fit, information = _most_probable(fit, positions, fixes, used, centre, free, scale)
        distances = np.linalg.norm(_residuals(fit, positions, fixes) / fixes.sigmas, axis=1)
        wide = max(1.0, float(np.median(distances)) / _MEDIAN_LENGTH)
        before, used = used, distances <= _OUTLIER_SIGMAS * wide
        if np.array_equal(before, used):
            break
    off = _residuals(fit, positions, fixes)[used]
    misfit = np.mean((off / fixes.sigmas[used]) ** 2)
    covariance = np.zeros((7, 7))
    covariance[np.ix_(free, free)] = np.linalg.pinv(information[np.ix_(free, free)], hermitian=True)
    covariance *= max(1.0, float(misfit))
    if up_sigma is not None:
        covariance[1, 1] = covariance[2, 2] = up_sigma**2
    rms = float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    return GpsFit(fit, used, centre, covariance, rms, float(np.sqrt(misfit)))


def _residuals(fit: Sim3, positions: np.ndarray, fixes: FrameFixes) -> np.ndarray:
    """Fixes (G, 3) less where the map has their frames, metres."""
    return fixes.positions - fit.points(positions)


def _columns(fit: Sim3, from_centre: np.ndarray) -> np.ndarray:
    """Derivative (G, 3, 7) of placed positions by the unknowns of `GpsFit.covariance`."""
    placed = fit.scale * from_centre @ fit.rotation.T
    columns = np.zeros((len(placed), 3, 7))
    columns[:, :, 0] = placed
    for axis, unit in enumerate(np.eye(3)):
        columns[:, :, 1 + axis] = np.cross(unit, placed)
    columns[:, :, 4:] = np.eye(3)
    return columns


def _most_probable(
    fit: Sim3,
    positions: np.ndarray,
    fixes: FrameFixes,
    used: np.ndarray,
    centre: np.ndarray,
    free: tuple[int, ...],
    scale: tuple[float, float] | None,
) -> tuple[Sim3, np.ndarray]:
    """Gauss-Newton over the fixes used; the similarity and its information (7, 7)."""
    chosen, some = fixes.taken(used), positions[used]
    information, rows = np.zeros((7, 7)), list(free)
    for _ in range(_STEPS):
        columns = chosen.whitened(_columns(fit, some - centre)).reshape(-1, 7)
        off = chosen.whitened(chosen.positions - fit.points(some)).ravel()
        information, right = columns.T @ columns, columns.T @ off
        if scale is not None:
            weight = (scale[0] / max(scale[1], 1e-9 * scale[0])) ** 2
            information[0, 0] += weight
            right[0] += weight * np.log(scale[0] / fit.scale)
        inverse = np.linalg.pinv(information[np.ix_(rows, rows)], hermitian=True)
        step = np.zeros(7)
        step[rows] = inverse @ right[rows]
        step[0] = np.clip(step[0], -1, 1)
        turn = Rotation.from_rotvec(step[1:4]).as_matrix()
        grown, rotation = fit.scale * np.exp(step[0]), turn @ fit.rotation
        placed = fit.points(centre[None])[0] + step[4:]
        fit = Sim3(grown, rotation, placed - grown * rotation @ centre)
        reach = np.array([1.0, 1, 1, 1, *[max(float(np.ptp(chosen.positions)), 1e-9)] * 3])
        if np.all(np.abs(step) <= _SETTLED * reach):
            break
    return fit, information
