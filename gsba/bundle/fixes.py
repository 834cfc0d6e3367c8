"""Positions of frames by GPS: how noisy they are, and how long an error lasts."""

import hashlib
from dataclasses import dataclass

import numpy as np

WHITE_SHARE = 0.1  # of the variance of a fix: independent from fix to fix, the rest lasts
_MEDIAN_LENGTH = 1.538  # median length of a 3-vector of independent unit normals
_OUTLIER_SIGMAS = 4.6  # 99.99 % of such vectors are shorter
# Largest ratio of the true noise of fixes to the claimed one. Claims hold under an open sky: with
# the default of 3 m it is 10.5 m per axis, a mean horizontal error of 13 m, the largest that
# Merry and Bettinger (PLoS ONE 14(7), e0219890, 2019) measured with a phone in a town.
_MAX_NOISE_RATIO = 3.5
MAX_DRIFT_SHARE = 0.05  # largest error of a map's positions, part of their extent


@dataclass(frozen=True, slots=True)
class FrameFixes:
    """GPS positions of frames in a local level frame, with a model of their errors.

    Errors of neighbouring fixes are alike: satellites, atmosphere and reflections change slowly.
    The error of each axis is a first-order Gauss-Markov process, with white noise beside it.
    "Comparison of Enhanced Noise Model Performance Based on Analysis of Civilian GPS Data"
    (Sensors 20(21), 6050, 2020) finds such processes to describe recordings of receivers at rest;
    D. L. Wilson measured a correlation time of about a minute on handheld receivers
    (erols.com/dlwilson/gpscorr.htm), and the Gazebo simulator's GPS has the same.
    """

    frames: np.ndarray  # (G,) int64, ascending
    positions: np.ndarray  # (G, 3) float64, metres east, north and up of the origin
    sigmas: np.ndarray  # (G, 3) float64, metres east, north and up, standard deviations
    times: np.ndarray | None  # (G,) float64, seconds, ascending; None = not known
    origin: np.ndarray  # (3,) float64, latitude, longitude (degrees), altitude (metres)
    correlation_s: float  # time constant of the errors, seconds

    def __len__(self) -> int:
        return len(self.frames)

    def taken(self, chosen: np.ndarray) -> "FrameFixes":
        """Some of the fixes, by a mask or ascending rows."""
        times = None if self.times is None else self.times[chosen]
        return FrameFixes(
            self.frames[chosen],
            self.positions[chosen],
            self.sigmas[chosen],
            times,
            self.origin,
            self.correlation_s,
        )

    def tolerances(self) -> np.ndarray:
        """Largest error (G,) of a fix, metres, by its claimed noise."""
        return _OUTLIER_SIGMAS * np.sqrt(np.mean(self.sigmas**2, axis=1))

    def inliers(self, residuals: np.ndarray, extent: float) -> tuple[np.ndarray, float]:
        """Fixes that agree with a map, and the scatter of all.

        The gate is 4.6 standard deviations, or 4.6 times the scatter of all fixes if that is
        larger. Where the scatter exceeds the largest noise of receivers and the largest drift of a
        map, most fixes are false: the gate is then the median that these two allow, which fewer
        than half of the fixes pass.

        Args:
            residuals: (G, 3) fixes less the transformed positions of their frames, metres.
            extent: of the frames' transformed positions, metres.

        Returns:
            (G,) bool, and the scatter in standard deviations of the fixes, at least 1.
        """
        distances = np.linalg.norm(residuals / self.sigmas, axis=1)
        drift = MAX_DRIFT_SHARE * extent / _OUTLIER_SIGMAS / float(np.median(self.sigmas[:, 0]))
        most = float(np.hypot(_MAX_NOISE_RATIO, drift))
        scatter = max(1.0, float(np.median(distances)) / _MEDIAN_LENGTH)
        if scatter > most:
            return distances < _MEDIAN_LENGTH * most, most
        return distances <= _OUTLIER_SIGMAS * scatter, scatter

    def digest(self) -> str:
        """Fingerprint of all that results rest on."""
        times = np.zeros(0) if self.times is None else self.times
        parts = self.frames, self.positions, self.sigmas, times, np.array([self.correlation_s])
        data = b"".join(np.ascontiguousarray(part, np.float64).tobytes() for part in parts)
        return hashlib.sha256(data).hexdigest()[:16]

    def correlations(self) -> np.ndarray:
        """Correlation (G - 1,) of the lasting part of the errors of each fix and the next."""
        if self.times is None:
            return np.full(max(len(self) - 1, 0), np.exp(-0.5))  # correlation times between fixes
        return np.exp(-np.diff(self.times) / self.correlation_s)

    def whitened(self, columns: np.ndarray) -> np.ndarray:
        """Columns of a linear model of the positions, in units of independent errors.

        The innovations of a Kalman filter of the errors: their sum of squares is that of
        `columns` weighted with the inverse covariance of all fixes (Kailath, IEEE TAC 13, 1968).

        Args:
            columns: (G, 3, ...) metres, residuals or Jacobians by anything.
        """
        scaled = columns / self.sigmas.reshape(*self.sigmas.shape, *[1] * (columns.ndim - 2))
        correlations = np.concatenate([[0.0], self.correlations()])
        lasting = 1 - WHITE_SHARE
        mean, variance = np.zeros(scaled.shape[1:]), lasting
        out = np.empty_like(scaled)
        for i, correlation in enumerate(correlations):
            mean = correlation * mean
            variance = correlation**2 * variance + (1 - correlation**2) * lasting
            total = variance + WHITE_SHARE
            innovation = scaled[i] - mean
            out[i] = innovation / np.sqrt(total)
            mean = mean + variance / total * innovation
            variance *= 1 - variance / total
        return out

    def independent_sigmas(self) -> np.ndarray:
        """Standard deviations (G, 3), metres, of independent errors that say as much.

        White noise of the same spectral density at long periods: what fixes say of drift, and of
        their mean, is then neither more nor less than their lasting errors allow. Of shorter
        periods, about which images know more, they say less.
        """
        steps = self.correlations()
        if not len(steps):
            return self.sigmas
        around = np.sqrt(np.append(steps, steps[-1]) * np.insert(steps, 0, steps[0]))
        lasting = (1 - WHITE_SHARE) * (1 + around) / np.maximum(1 - around, 1e-9)
        return self.sigmas * np.sqrt(lasting + WHITE_SHARE)[:, None]
