"""A gyro and an accelerometer that ride with a camera which turns about all axes."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from gsba.imu.alignment import Alignment, align
from gsba.imu.readings import Readings

BIAS = np.deg2rad([0.6, -0.4, 0.3])  # rad/s
IMU_R_RIG = Rotation.from_rotvec([2.0, -0.7, 1.1]).as_matrix()
SIGMA = np.deg2rad(0.1)  # of turns that images show, per axis
OFFSET_S = 7.31  # the sensor's clock is ahead
UP = np.array([0.1, -0.9, 0.2]) / np.linalg.norm([0.1, -0.9, 0.2])  # in the world
_SWINGS = np.array([[7.0, 1.2, 1.0], [11.0, 0.8, 0.8], [5.0, 1.5, 1.2]])  # degrees, about axes
_HZ = np.array([[0.11, 0.95, 1.9], [0.07, 0.95, 1.9], [0.05, 0.95, 1.9]])


@dataclass(frozen=True)
class Ride:
    """A ride whose true orientations are known at any time."""

    timestamps: np.ndarray  # (F,) of frames, seconds
    seed: int = 0

    def rotations(self, times: np.ndarray) -> np.ndarray:
        """world_R_rig (n, 3, 3) at times (n,)."""
        phases = np.random.default_rng([self.seed, 1]).uniform(0, 2 * np.pi, (3, 3))
        swung = _SWINGS * np.sin(2 * np.pi * times[:, None, None] * _HZ + phases)
        return Rotation.from_rotvec(np.deg2rad(swung.sum(axis=2))).as_matrix()

    def steps(self, sigma: float = 0.0) -> np.ndarray:
        """f_R_next (F - 1, 3, 3), as images with a noise (rad per axis) have them."""
        found = self.rotations(self.timestamps)
        noise = np.random.default_rng([self.seed, 2]).normal(0, sigma, (len(found) - 1, 3))
        steps = np.swapaxes(found[:-1], 1, 2) @ found[1:]
        return steps @ Rotation.from_rotvec(noise).as_matrix()

    def rates(self, times: np.ndarray) -> np.ndarray:
        """Rates (n, 3) in the rig's axes, rad/s."""
        before, after = self.rotations(times - 1e-4), self.rotations(times + 1e-4)
        return Rotation.from_matrix(np.swapaxes(before, 1, 2) @ after).as_rotvec() / 2e-4

    def readings(self, sigma: float = 1e-3, hz: float = 200.0) -> Readings:
        """What a sensor with noise (rad/s) measures, from 3 s before the frames to 2 s after."""
        times = np.arange(self.timestamps[0] - 3, self.timestamps[-1] + 2, 1 / hz)
        rng = np.random.default_rng([self.seed, 3])
        rates = self.rates(times) @ IMU_R_RIG.T + BIAS + rng.normal(0, sigma, (len(times), 3))
        sway = 1.5 * np.sin(2 * np.pi * 1.9 * times)[:, None] * np.array([0.3, 1.0, -0.2])
        forces = np.einsum("nji,nj->ni", self.rotations(times), 9.80665 * UP + sway)
        forces = forces @ IMU_R_RIG.T + rng.normal(0, 0.05, forces.shape)
        return Readings(times + OFFSET_S, rates, forces)


def ride(num_frames: int = 50, interval_s: float = 0.5, seed: int = 0) -> Ride:
    """A ride with evenly spaced frames."""
    return Ride(100.0 + interval_s * np.arange(num_frames), seed)


def aligned(
    on: Ride, readings: Readings, sigma: float = SIGMA, former: Alignment | None = None
) -> Alignment:
    """Alignment of readings with all turns of a ride, as images with a noise show them."""
    known = np.ones(len(on.timestamps) - 1, bool)
    return align(on.timestamps, on.steps(sigma), known, readings, former)
