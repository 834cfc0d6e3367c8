"""Readings of an inertial unit, and their integration to rotations."""

import hashlib
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Sensor:
    """Calibration of a gyro: true rate = scales * (measured rate - bias)."""

    bias: np.ndarray  # (3,) float64, rad/s, reading at rest
    scales: np.ndarray  # (3,) float64, true over measured rate without bias, about one

    @classmethod
    def ideal(cls) -> "Sensor":
        """A gyro without bias and scale error."""
        return cls(np.zeros(3), np.ones(3))

    def true(self, shown: np.ndarray) -> np.ndarray:
        """True rates (n, 3) of measured rates (n, 3)."""
        return self.scales * (shown - self.bias)


@dataclass(frozen=True, slots=True)
class Readings:
    """Readings of a gyro and an accelerometer with common axes, right-handed, fixed to the camera;
    their rotation against the camera and the gyro's bias are not known."""

    timestamps: np.ndarray  # (N,) float64, seconds on a clock of their own, strictly increasing
    rates: np.ndarray  # (N, 3) float64, rad/s
    forces: np.ndarray | None = None  # (N, 3) float64, m/s^2, 9.8 upwards at rest; None = none

    @property
    def digest(self) -> str:
        """Hash of the readings: equal readings have equal digests."""
        forces = () if self.forces is None else (self.forces,)
        parts = [np.ascontiguousarray(part) for part in (self.timestamps, self.rates, *forces)]
        return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()

    def between(self, begin: float, end: float) -> "Readings":
        """Readings of a span of time, and one more at either end."""
        first = max(int(np.searchsorted(self.timestamps, begin)) - 1, 0)
        last = int(np.searchsorted(self.timestamps, end, side="right")) + 1
        forces = None if self.forces is None else self.forces[first:last]
        return Readings(self.timestamps[first:last], self.rates[first:last], forces)

    def covers(self, times: np.ndarray) -> np.ndarray:
        """True (n,) for spans of time (n, 2) within the readings, without a gap."""
        late = np.diff(self.timestamps, append=np.inf) > 0.1  # s: the rotation is unknown
        gaps = np.concatenate([[0], np.cumsum(late)])
        first = np.searchsorted(self.timestamps, times[:, 0], side="right") - 1
        last = np.searchsorted(self.timestamps, times[:, 1]) - 1
        inside = (first >= 0) & (times[:, 1] <= self.timestamps[-1])
        return inside & (gaps[last + 1] == gaps[np.maximum(first, 0)])

    def turned(self, sensor: Sensor) -> np.ndarray:
        """Rotations (N, 3, 3) from the sensor's axes at each reading to those at the first."""
        from scipy.spatial.transform import Rotation

        rates = sensor.true(self.rates)
        onward = 0.5 * (rates[:-1] + rates[1:]) * np.diff(self.timestamps)[:, None]
        num, block = len(onward), max(int(np.sqrt(len(onward))), 1)
        padded = np.concatenate([onward, np.zeros((-num % block, 3))])
        turned = Rotation.from_rotvec(padded).as_matrix().reshape(-1, block, 3, 3)
        for n in range(1, block):
            turned[:, n] = turned[:, n - 1] @ turned[:, n]
        for k in range(1, len(turned)):
            turned[k] = turned[k - 1, -1] @ turned[k]
        turned = turned.reshape(-1, 3, 3)[:num]
        return np.concatenate([np.eye(3)[None], turned])

    def mean_rates(self, times: np.ndarray, span: float) -> np.ndarray:
        """Mean rates (n, 3) over a span of seconds around times (n,); NaN where unknown."""
        angles = np.zeros_like(self.rates)
        steps = 0.5 * (self.rates[:-1] + self.rates[1:]) * np.diff(self.timestamps)[:, None]
        np.cumsum(steps, axis=0, out=angles[1:])
        ends = times[:, None] + 0.5 * span * np.array([-1.0, 1.0])
        at = np.stack([np.interp(ends, self.timestamps, column) for column in angles.T], axis=2)
        return np.where(self.covers(ends)[:, None], (at[:, 1] - at[:, 0]) / span, np.nan)

    def noise(self) -> float:
        """Noise of a rate, rad/s per axis, from second differences of neighbours."""
        bent = self.rates[2:] - 2 * self.rates[1:-1] + self.rates[:-2]
        return float(1.4826 * np.median(np.abs(bent)) / np.sqrt(6)) if len(bent) else 0.0
