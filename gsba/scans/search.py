"""Candidate placements of a cloud in a scan, by the main axes of their surfaces, along which
profiles correlate at one scale and shift; all rotations that map axes to axes are tried."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import permutations, product

import numpy as np

from gsba.scans.types import Cloud, Scan, size_of
from gsba.similarity import Sim3

_SCALE_RANGE = (0.125, 2.5)  # of the ratio of both sizes: a cloud is rarely larger than its scan
_BINS = 512  # of a profile, over the scan's extent
_PEAKS = 4  # maxima of a correlation that are tried
_MIN_DISTANCE = 0.15  # of distinct candidates, part of the cloud's size


@dataclass(frozen=True, slots=True)
class Guess:
    """Prior knowledge of a similarity; None = unknown."""

    similarity: Sim3 | None = None  # initial similarity, near the result
    scale: float | None = None
    axis: tuple[np.ndarray, np.ndarray] | None = None  # unit vectors (3,) of cloud and scan: the
    # similarity maps one to the other
    rotation: np.ndarray | None = None  # (3, 3)
    scale_ratio: float = 1.1  # largest ratio of the true scale to `scale`, and its inverse
    angle_deg: float = 15.0  # largest angle to the true axis, or of the true rotation to `rotation`

    def without(self, offset: np.ndarray) -> "Guess":
        """Guess for a scan whose offset (3,) is split off."""
        if self.similarity is None:
            return self
        near = self.similarity
        return replace(self, similarity=replace(near, translation=near.translation - offset))

    def allows(self, candidate: Sim3) -> bool:
        """True if a similarity agrees with the known scale, axis and rotation."""
        least = np.cos(np.radians(self.angle_deg))
        if self.scale is not None:
            ratio = candidate.scale / self.scale
            if not 1 / self.scale_ratio < ratio < self.scale_ratio:
                return False
        if self.axis is not None and self.axis[1] @ candidate.rotation @ self.axis[0] < least:
            return False
        if self.rotation is None:
            return True
        return (np.trace(self.rotation.T @ candidate.rotation) - 1) / 2 >= least


def candidates(cloud: Cloud, scan: Scan, guess: Guess, most: int) -> list[Sim3]:
    """Distinct candidate similarities from a cloud to a scan, the best first, at most `most`."""
    if guess.similarity is not None:
        return [guess.similarity]
    found = list(_by_axes(cloud, scan, guess))
    for points in (80, 400):
        scores = np.array([score(fit, cloud, scan, points) for fit in found])
        found = [found[n] for n in np.argsort(-scores, kind="stable")[:300]]
    distinct: list[Sim3] = []
    for fit in found:
        if (distances(fit, distinct, cloud) > _MIN_DISTANCE).all():
            distinct.append(fit)
        if len(distinct) == most:
            break
    return distinct


def distances(fit: Sim3, others: Sequence[Sim3], cloud: Cloud) -> np.ndarray:
    """Distances (S,) of a similarity from others: 90th percentile over the cloud's points, part of
    its size."""
    some, scales = _some(cloud.points, 50), np.array([other.scale for other in others])
    there = np.array([other.points(some) for other in others]).reshape(-1, len(some), 3)
    apart = np.quantile(np.linalg.norm(there - fit.points(some), axis=2), 0.9, axis=1)
    return apart / (np.minimum(scales, fit.scale) * cloud.size)


def score(fit: Sim3, cloud: Cloud, scan: Scan, points: int = 400) -> float:
    """Mean score, 0 to 1, of a sample of the cloud's points near surfaces with similar normals."""
    rows = _rows(len(cloud.points), points)
    reach = 0.03 * cloud.size * fit.scale
    gaps, nearest = scan.tree.query(fit.points(cloud.points[rows]), distance_upper_bound=reach)
    found = gaps < reach
    normals = scan.normals[np.asarray(nearest)[found]]
    turned = cloud.normals[rows][found] @ fit.rotation.T
    alike = np.abs(np.einsum("ni,ni->n", normals, turned)) > 0.8
    return float(np.sum((1 - gaps[found] / reach) * alike)) / len(rows)


@cache
def _rows(num: int, most: int) -> np.ndarray:
    """Random sample, with a fixed seed, of at most `most` rows of `num`, ascending."""
    return np.sort(np.random.default_rng(0).permutation(num)[:most])


def _some(points: np.ndarray, most: int) -> np.ndarray:
    return points[_rows(len(points), most)]


def main_axes(normals: np.ndarray) -> np.ndarray:
    """Right-handed frame as rows (3, 3): the most frequent direction of normals, the most frequent
    one perpendicular to it, and their cross product."""
    some = _some(normals, 4000)
    z = (np.arange(1500) + 0.5) / 1500  # over half the sphere, by Fibonacci's lattice
    turn, flat = np.pi * (1 + np.sqrt(5)) * np.arange(1500), np.sqrt(1 - z * z)
    tried = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
    votes = np.zeros(len(tried))
    cosines = tried @ some.T
    for rows in np.split(np.arange(len(tried)), 50):  # few at a time stay in the processor's cache
        exponents = (cosines[rows] ** 2 - 1) / np.radians(5) ** 2 / 2
        votes[rows] = np.sum(np.exp(exponents, out=exponents), axis=1)
    first = _centred(some, tried[np.argmax(votes)])
    level = np.abs(tried @ first) < np.sin(np.radians(8))
    second = _centred(some, tried[np.argmax(np.where(level, votes, -1))])
    second = second - first * (first @ second)
    second /= np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)])


def _centred(normals: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Axis (3,) moved to the mean direction of the normals around it."""
    for _ in range(10):
        near = normals[np.abs(normals @ axis) > np.cos(np.radians(8))]
        if not len(near):
            break
        axis = np.linalg.eigh(near.T @ near)[1][:, 2]
    return axis


def _turns() -> Iterator[np.ndarray]:
    """Yield the 24 rotations (3, 3) that map axes to axes."""
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = np.zeros((3, 3))
        turn[range(3), order] = signs
        if np.linalg.det(turn) > 0:
            yield turn


def _by_axes(cloud: Cloud, scan: Scan, guess: Guess) -> Iterator[Sim3]:
    """Yield candidates whose profiles along common axes correlate best, for each rotation."""
    of_cloud, of_scan = main_axes(cloud.normals), main_axes(scan.normals)
    here, there = cloud.points @ of_cloud.T, scan.points @ of_scan.T
    middle, low = np.median(here, axis=0), there.min(axis=0)
    width = float(np.ptp(there, axis=0).max()) * 1.02 / _BINS
    if guess.scale is None:
        low_scale, high_scale = np.array(_SCALE_RANGE) * size_of(scan.points) / cloud.size
    else:
        low_scale, high_scale = guess.scale / guess.scale_ratio, guess.scale * guess.scale_ratio
    scales = np.exp(np.arange(np.log(low_scale), np.log(high_scale), np.log(1.012)))
    profiles = [_profile(there[:, j] - low[j], scan.normals @ of_scan[j], width) for j in range(3)]
    spectra = np.fft.rfft(profiles, 2 * _BINS)
    values = np.zeros((3, 2, 3, len(scales), _PEAKS))  # by axis, its sign, and axis of the scan
    shifts = np.zeros_like(values)
    for i, flip, n in product(range(3), range(2), range(len(scales))):
        along = (1 - 2 * flip) * scales[n] * (here[:, i] - middle[i])
        start = along.min()
        own = _profile(along - start, cloud.normals @ of_cloud[i], width)
        correlated = np.fft.irfft(np.conj(np.fft.rfft(own, 2 * _BINS)) * spectra, axis=1)
        values[i, flip, :, n], bins = _peaks(correlated)
        shifts[i, flip, :, n] = bins * width - start + low[:, None]
    centre = of_cloud.T @ middle
    for turn in _turns():
        rotation = of_scan.T @ turn @ of_cloud
        centres = [scale * rotation @ centre for scale in scales]
        axes = np.argmax(np.abs(turn), axis=1)
        flips = (turn[range(3), axes] < 0).astype(int)
        x, y, z = (values[axes[j], flips[j], j] for j in range(3))
        sums = x[:, :, None, None] + y[:, None, :, None] + z[:, None, None, :]
        highest = np.argsort(-sums.ravel(), kind="stable")[:150]
        numbers, *peaks = np.unravel_index(highest, sums.shape)
        at = [shifts[axes[j], flips[j], j, numbers, peaks[j]] for j in range(3)]
        for n, shift in zip(numbers.tolist(), np.stack(at, axis=1), strict=True):
            fit = Sim3(float(scales[n]), rotation, of_scan.T @ shift - centres[n])
            if guess.allows(fit):
                yield fit


def _peaks(correlated: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Highest maxima (A, _PEAKS) of cyclic correlations (A, 2 _BINS), and their shifts in bins."""
    higher = np.maximum(np.roll(correlated, 1, axis=1), np.roll(correlated, -1, axis=1))
    tops = np.where(correlated >= higher, correlated, -1.0)
    at = np.argsort(-tops, axis=1, kind="stable")[:, :_PEAKS]
    return np.take_along_axis(tops, at, axis=1), np.where(at < _BINS, at, at - 2 * _BINS)


def _profile(along: np.ndarray, cosines: np.ndarray, width: float) -> np.ndarray:
    """Density (_BINS,) along an axis of surfaces perpendicular to it, of length 1 and mean 0."""
    facing = np.abs(cosines) > np.cos(np.radians(12.0))
    bins = (along[facing] / width).astype(np.int64)
    counts = np.bincount(bins[(bins >= 0) & (bins < _BINS)], minlength=_BINS).astype(np.float64)
    smooth = np.convolve(counts, [0.25, 0.5, 1, 0.5, 0.25], "same")
    profile = np.sqrt(smooth)
    profile -= profile.mean()
    return profile / max(float(np.linalg.norm(profile)), 1e-12)
