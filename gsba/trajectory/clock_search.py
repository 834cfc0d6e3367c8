"""Search for the clock under which trajectory and images rotate alike: a grid, then least
squares."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gsba.geometry import quaternion_from_rotation
from gsba.types import Trajectory

_MAX_STEPS = 600  # largest number of steps; more are merged, as people turn slowly
_MAX_RATE_DEVIATION = 0.03  # largest tried deviation of the rate from one
_RATE_SIGMA = 0.02  # prior standard deviation of the rate
_NUM_CANDIDATES = 5  # candidates taken from the grid
_MAX_CLOCKS, _MAX_RATES = 60_000, 100  # largest number of clocks on the grid, and of rates among
# them
LOSS_WIDTH_SIGMAS = 2.0  # width of the loss, standard deviations
_MIN_SIGMA_RAD = np.deg2rad(0.03)  # least noise of a rotation per axis: images are no more accurate
_NOISE_QUANTILE, _UNIT_NOISE_QUANTILE = 0.4, 1.367  # quantile from which noise is estimated; its
# value for unit Gaussian 3-vectors
_NUM_SHIFTS = 41  # shifts within one step of the best, tried for its uncertainty
_CERTAIN_SIGMAS = 4.0  # standard deviations beyond which every shift must fit worse


@dataclass(frozen=True, slots=True)
class Turns:
    """Rotations of the camera between pairs of instants, estimated from images."""

    times: np.ndarray  # (N, 2) float64, seconds on the frames' clock
    rotvecs: np.ndarray  # (N, 3) float64, radians, first_R_second

    def __len__(self) -> int:
        return len(self.times)

    @property
    def middle(self) -> float:
        """Instant that shift and rate refer to, seconds."""
        return float(self.times.mean())

    @property
    def ends(self) -> np.ndarray:
        """First and last instant (2,), relative to the middle, seconds."""
        return np.array([self.times.min(), self.times.max()]) - self.middle

    @property
    def step(self) -> float:
        """Median duration of a turn, seconds."""
        return float(np.median(np.diff(self.times, axis=1)))


def merged(timestamps: np.ndarray, f_R_nexts: np.ndarray, verified: np.ndarray) -> Turns:
    """Turns from the steps of frames at times (F,), seconds, short ones merged: rotations (F - 1,
    3, 3), and which of them are known, (F - 1,) bool."""
    from scipy.spatial.transform import Rotation

    least = max(0.2, np.ptp(timestamps) / _MAX_STEPS) if len(timestamps) else 0.0
    times, rotations, last = [], [], -1
    for f in np.flatnonzero(verified):
        begin, end = timestamps[f], timestamps[f + 1]
        if last == f and times[-1][1] - times[-1][0] < least:
            times[-1][1], rotations[-1] = end, rotations[-1] @ f_R_nexts[f]
        else:
            times.append([begin, end])
            rotations.append(f_R_nexts[f])
        last = f + 1
    rotvecs = Rotation.from_matrix(np.reshape(rotations, (-1, 3, 3))).as_rotvec()
    return Turns(np.reshape(times, (-1, 2)), rotvecs)


class ClockFit:
    """Agreement of turns with a trajectory, as a function of (shift, rate).

    An instant `t` of a frame is at `middle + shift + rate * (t - middle)` on the trajectory's
    clock, `middle` being that of the turns.
    """

    def __init__(self, turns: Turns, trajectory: Trajectory) -> None:
        self.turns, entries = turns, trajectory.timestamps
        self.span = entries[[0, -1]]
        self._entries = entries
        self._at = quaternion_from_rotation(trajectory.world_T_rigs[:, :3, :3])
        self._onward = _log(_product(_conjugate(self._at[:-1]), self._at[1:]))
        self._seen = _exp(turns.rotvecs)
        typical = float(np.quantile(np.linalg.norm(turns.rotvecs, axis=1), 0.75))
        self._rough_sigma = max(0.5 * typical, np.deg2rad(1.0))  # on the grid

    def residuals(self, parameters: np.ndarray) -> np.ndarray:
        """Rotation residuals (..., N, 3), radians, from the images' to the trajectory's, at shifts
        and rates (..., 2); outside its span the trajectory counts as not rotating."""
        shifts, rates = parameters[..., 0, None, None], parameters[..., 1, None, None]
        times = self.turns.middle + shifts + rates * self._from_middle()
        inside = ((times >= self.span[0]) & (times <= self.span[1])).all(axis=-1)
        at = self._rotations(np.clip(times, *self.span))
        turned = _product(_conjugate(at[..., 0, :]), at[..., 1, :])
        found = _log(_product(_conjugate(self._seen), turned))
        return np.where(inside[..., None], found, -self.turns.rotvecs)

    def _rotations(self, times: np.ndarray) -> np.ndarray:
        """Quaternions (..., 4) in the trajectory's span, at constant velocity between entries."""
        before = np.clip(np.searchsorted(self._entries, times) - 1, 0, len(self._onward) - 1)
        span = self._entries[before + 1] - self._entries[before]
        share = (times - self._entries[before]) / span
        return _product(self._at[before], _exp(share[..., None] * self._onward[before]))

    def cost(self, parameters: np.ndarray, sigma: float) -> float:
        """Mean bounded residual of a step, 0 to 1 (Geman and McClure, 1987), at (2,) shift and
        rate."""
        return _bounded(self.residuals(parameters), sigma)

    def turning(self, sigma: float) -> np.ndarray:
        """Turns (N,) bool that rotate by more than noise."""
        return np.linalg.norm(self.turns.rotvecs, axis=1) > 4.0 * sigma

    def explained(self, parameters: np.ndarray, sigma: float) -> float:
        """Share of what turns that the trajectory explains within noise, at shift and rate (2,)."""
        off = np.linalg.norm(self.residuals(parameters), axis=1)[self.turning(sigma)]
        return float(np.mean(off < 3.0 * sigma)) if len(off) else 0.0

    def refine(
        self, start: np.ndarray, with_rate: bool = True, widening: float = 3.0
    ) -> np.ndarray:
        """Parameters (2,), shift and rate, of the best fit around a start under a Cauchy loss,
        `widening` times the noise wide at first."""
        parameters, free = start.copy(), 1 + with_rate
        residuals = self.residuals(parameters)
        sigma, damping = widening * noise(residuals), 1e-3
        for _ in range(20):
            jacobian, prior = self._jacobian(parameters)[..., :free], self._prior(free)
            weights = 1 / (1 + np.sum(residuals**2, axis=1) / (LOSS_WIDTH_SIGMAS * sigma) ** 2)
            normal = np.einsum("n,nij,nik->jk", weights, jacobian, jacobian)
            slope = np.einsum("n,nij,ni->j", weights, jacobian, residuals)
            slope[1:] += prior[1:, 1:] @ (parameters[1:free] - 1) * sigma**2
            normal += prior * sigma**2 + damping * np.diag(np.diag(normal)) + 1e-15 * np.eye(free)
            step = np.linalg.solve(normal, -slope)
            step /= max(1.0, float(np.abs(step[0])) / (0.5 * self.turns.step))
            moved = parameters.copy()
            moved[:free] += step
            after = self.residuals(moved)
            if self._total(after, moved, sigma) < self._total(residuals, parameters, sigma):
                parameters, residuals, damping = moved, after, damping / 3
            else:
                damping *= 10
            narrowed = max(0.7 * sigma, noise(residuals))
            if damping > 1e6 or (narrowed == sigma and np.abs(step[0]) < 1e-4 * self.turns.step):
                break
            sigma = narrowed
        return parameters

    def covariance(self, parameters: np.ndarray, with_rate: bool = True) -> np.ndarray:
        """Covariance (2, 2) of the parameters; a fixed rate is exact.

        Residuals of consecutive steps correlate, since trajectories drift smoothly: the estimate
        follows Newey and West (Econometrica 55, 1987), but is never below that of independent
        residuals, nor below the spread of shifts that fit nearly as well. It is inflated as
        measured on simulated drift.
        """
        residuals, free = self.residuals(parameters), 1 + with_rate
        sigma = noise(residuals)
        jacobian = self._jacobian(parameters)[..., :free]
        weights = 1 / (1 + np.sum(residuals**2, axis=1) / (LOSS_WIDTH_SIGMAS * sigma) ** 2)
        normal = np.einsum("n,nij,nik->jk", weights, jacobian, jacobian)
        normal += self._prior(free) * sigma**2 + 1e-15 * np.eye(free)
        pulls = np.einsum("n,nij,ni->nj", weights, jacobian, residuals)
        spread = pulls.T @ pulls
        lags = min(4, len(pulls) - 1)
        for lag in range(1, lags + 1):
            along = pulls[:-lag].T @ pulls[lag:]
            spread += (1 - lag / (lags + 1)) * (along + along.T)
        inverse, choices = np.linalg.inv(normal), np.zeros((2, 2, 2))
        choices[:, :free, :free] = sigma**2 * inverse, inverse @ spread @ inverse
        larger = max(choices, key=self.time_sigma)
        # Standard deviation of the shift, from the range of shifts that fit nearly as well
        shifts, losses, _ = self._profile(parameters)
        here = losses[len(losses) // 2]
        as_good = np.abs(shifts[losses < here + _CERTAIN_SIGMAS**2])
        spacing = float(shifts[1] - shifts[0])
        width = max(float(as_good.max(initial=0)) - spacing, 0.0) / _CERTAIN_SIGMAS
        return larger * max(3.0**2, width**2 / larger[0, 0])  # sigmas are three times as large

    def settle(self, parameters: np.ndarray, with_rate: bool = True) -> np.ndarray:
        """The best of the minima within a step: the trajectory's entries make the loss jagged."""
        for _ in range(2):
            shifts, losses, sigma = self._profile(parameters)
            moved = parameters + np.array([shifts[np.argmin(losses)], 0.0])
            settled = self.refine(moved, with_rate, 1.0)
            best = min((parameters, moved, settled), key=lambda p: self.cost(p, sigma))
            if best is parameters:
                break
            parameters = best
        return parameters

    def _profile(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Shifts (n,) up to one step, the bounded loss under each, and the least noise."""
        shifts = self.turns.step * np.linspace(-1, 1, _NUM_SHIFTS)
        tried = parameters + np.column_stack([shifts, np.zeros(_NUM_SHIFTS)])
        residuals = self.residuals(tried)
        sigma = min(map(noise, residuals))
        losses = [LOSS_WIDTH_SIGMAS**2 * len(r) * _bounded(r, sigma) for r in residuals]
        return shifts, np.array(losses), sigma

    def time_sigma(self, covariance: np.ndarray) -> float:
        """Standard deviation in seconds of an instant's time, at the worse end of the video."""
        at = np.column_stack([np.ones(2), self.turns.ends])
        return float(np.sqrt(np.einsum("ki,ij,kj->k", at, covariance, at).max()))

    def apart(self, one: np.ndarray, other: np.ndarray) -> float:
        """Largest difference of two clocks in seconds during the video."""
        return float(np.abs((one - other)[0] + (one - other)[1] * self.turns.ends).max())

    def candidates(self, start: np.ndarray, reach_s: float) -> Iterator[np.ndarray]:
        """Parameters (2,) of the best clocks on a grid around a start, best first, up to `reach_s`
        away; less far where steps take a fraction of a second: the size of the grid is bounded."""
        spacing = 0.25 * self.turns.step
        rates = max(
            round(min(_MAX_RATE_DEVIATION * self.turns.ends[1] / spacing, _MAX_RATES / 2)), 1
        )
        rates = _MAX_RATE_DEVIATION * np.arange(-rates, rates + 1) / rates
        most = round(min(reach_s / spacing, _MAX_CLOCKS / len(rates) / 2))
        shifts = spacing * np.arange(-most, most + 1)
        tried = np.stack(np.meshgrid(shifts, rates), axis=-1).reshape(-1, 2) + start
        # Instants (n,) of the trajectory, its mean angular velocity (n, 3) over a step there
        middle = self.turns.middle + start[0]
        reach = shifts[-1]
        half = 0.5 * min(self.turns.step, float(np.ptp(self.span)))
        far = reach + (1 + _MAX_RATE_DEVIATION) * np.abs(self.turns.ends).max() + half
        begin, end = self.span[0] + half, self.span[1] - half
        begin, end = max(begin, min(middle - far, end)), min(end, max(middle + far, begin))
        count = int(np.clip((end - begin) / (0.5 * spacing), 2, 200_000))
        times = np.linspace(begin, end, count)
        begin, end = self._rotations(times - half), self._rotations(times + half)
        lookup = times, _log(_product(_conjugate(begin), end)) / (2 * half)
        order = np.argsort([self._rough_cost(p, *lookup) for p in tried], kind="stable")
        chosen: list[np.ndarray] = []
        for parameters in tried[order]:
            if all(self.apart(parameters, other) > 2.5 * spacing for other in chosen):
                chosen.append(parameters)
                yield parameters
            if len(chosen) == _NUM_CANDIDATES:
                return

    def _rough_cost(
        self, parameters: np.ndarray, times: np.ndarray, velocities: np.ndarray
    ) -> float:
        """Mean bounded residual of angular velocities, from 0 to 1."""
        duration = np.diff(self.turns.times, axis=1)
        at = self.turns.middle + parameters[0] + parameters[1] * self._from_middle().mean(axis=1)
        turned = [np.interp(at, times, velocities[:, k], 0, 0) for k in range(3)]
        squares = np.sum((np.column_stack(turned) * duration - self.turns.rotvecs) ** 2, axis=1)
        return float(np.mean(squares / (squares + self._rough_sigma**2)))

    def _from_middle(self) -> np.ndarray:
        return self.turns.times - self.turns.middle

    def _jacobian(self, parameters: np.ndarray) -> np.ndarray:
        """Derivatives (N, 3, 2) of residuals by differences: residuals are jagged."""
        reach = 0.1 * self.turns.step
        steps = np.diag([reach, reach / self.turns.ends[1]])
        ahead, back = self.residuals(parameters + np.stack([steps, -steps]))
        return np.moveaxis((ahead - back) / (2 * np.diag(steps))[:, None, None], 0, -1)

    @staticmethod
    def _prior(free: int) -> np.ndarray:
        """Prior information (free, free): rates are near one, shifts are free."""
        return np.diag([0, _RATE_SIGMA**-2])[:free, :free]

    def _total(self, residuals: np.ndarray, parameters: np.ndarray, sigma: float) -> float:
        squares = np.sum(residuals**2, axis=1) / (LOSS_WIDTH_SIGMAS * sigma) ** 2
        return float(LOSS_WIDTH_SIGMAS**2 * np.log1p(squares).sum()) + float(
            (parameters[1] - 1) ** 2 / _RATE_SIGMA**2
        )


def _bounded(residuals: np.ndarray, sigma: float) -> float:
    """Mean of r^2 / (r^2 + width^2) over rotations (N, 3)."""
    squares = np.sum(residuals**2, axis=1)
    return float(np.mean(squares / (squares + (LOSS_WIDTH_SIGMAS * sigma) ** 2)))


def noise(residuals: np.ndarray, least: float = _MIN_SIGMA_RAD) -> float:
    """Noise per axis of rotations (N, 3), from a quantile that outliers leave alone, at least
    `least`."""
    lengths = np.linalg.norm(residuals, axis=1)
    return max(float(np.quantile(lengths, _NOISE_QUANTILE)) / _UNIT_NOISE_QUANTILE, least)


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products (..., 4) of quaternions, wxyz."""
    p, q, r, s = np.moveaxis(a, -1, 0)
    w, x, y, z = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            p * w - q * x - r * y - s * z,
            p * x + q * w + r * z - s * y,
            p * y - q * z + r * w + s * x,
            p * z + q * y - r * x + s * w,
        ],
        axis=-1,
    )


def _conjugate(wxyz: np.ndarray) -> np.ndarray:
    return wxyz * [1, -1, -1, -1]


def _exp(rotvecs: np.ndarray) -> np.ndarray:
    """Unit quaternions (..., 4), wxyz, of rotation vectors (..., 3)."""
    half = 0.5 * np.linalg.norm(rotvecs, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * rotvecs], axis=-1)


def _log(wxyz: np.ndarray) -> np.ndarray:
    """Rotation vectors (..., 3), at most half a turn, of unit quaternions (..., 4)."""
    wxyz = np.where(wxyz[..., :1] < 0, -wxyz, wxyz)
    sine = np.linalg.norm(wxyz[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, wxyz[..., :1])
    return wxyz[..., 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)
