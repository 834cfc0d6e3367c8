"""Clock, bias and axes of a gyro, from how images say that the camera turned.

Between two instants the gyro has to turn by as much as the images, in axes of its own. Over a grid
of offsets each gives its best axes and bias in closed form (Kabsch 1976, on rotation vectors; what
grows with time alone is the bias), and says how much of the turns it explains. The best few are
refined as the clocks of trajectories are. Gyros are off by a percent of what they show: that of
each of its axes is found as well, from turns good enough to tell.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from gsba.geometry import nearest_rotation, pose
from gsba.imu.readings import Readings, Sensor
from gsba.trajectory.clock import MIN_STEPS, Clock, simplest
from gsba.trajectory.clock_search import ClockFit, Turns, merged, noise
from gsba.types import Counts, GyroConstraints, Trajectory

_SPACING, _SPACING_S = 0.25, 0.05  # of a step, and seconds, between offsets tried at most
_MOST_TRIED = 60_000  # offsets
_MOST_AT_ONCE = 200_000  # turns of all offsets tried together
_OVER = 0.4  # part of the video that may lie outside the readings
_TRIED = 6  # offsets of the grid that are refined
_ROUNDS = 3  # of clock, then bias and axes
_SETTLED = 1e-5  # s of change after which no more are needed
_REWEIGHTED = 10  # passes over bias and axes
_WIDTH = 2.0  # of their loss, standard deviations
_TURNING, _AGREEING = 4.0, 3.0  # standard deviations: what counts as a turn, and as the same
_MIN_TURNS = 4  # steps that turn
_EXPLAINED = 0.6  # part of them that a gyro explains at least
_RIVAL = 0.75  # of what the best offset explains that no other may reach
_SCALE = 0.01  # standard deviation of what a gyro shows of a rate, part of it
_AXES = np.deg2rad(5.0)  # standard deviation of the axes, at most
_TURN = np.deg2rad(1.0)  # of a step: a tenth of them has to turn by as much
_LEAST_NOISE = np.deg2rad(0.003)  # of a turn: steady gyros on the move know no better
_EVERY = 0.004  # s between rotations that are kept: turns are even in between
_READOUT = 0.01  # s that a rate is the mean of


@dataclass(frozen=True, slots=True)
class Alignment:
    """How a gyro's readings belong to the frames."""

    clock: Clock  # the sensor's
    offset_sigma: float  # s, standard deviation
    sensor: Sensor  # bias and scales
    rig_R_imu: np.ndarray  # (3, 3) float64, the sensor's axes in the rig's
    axes_sigma: float  # rad, standard deviation of the axis known worst
    noise: float  # rad per axis, of a turn between frames, what images are off included
    explained: float  # part of the frames' turns that the gyro shares
    counts: Counts  # of steps
    reason: str = ""  # why it is not believed; empty if it is


def align(
    timestamps: np.ndarray,
    f_R_nexts: np.ndarray,
    known: np.ndarray,
    readings: Readings,
    former: Alignment | None = None,
) -> Alignment:
    """Find which clock, bias and axes make the gyro turn as the images do.

    Args:
        timestamps: (F,) of frames, seconds.
        f_R_nexts: (F - 1, 3, 3) rotations between frames that follow one another, by the images.
        known: (F - 1,) bool, which of them images show.
        readings: of the gyro.
        former: what was found from worse rotations; None = any offset is tried.
    """
    turns = merged(timestamps, f_R_nexts, known)
    counts = Counts(len(f_R_nexts), int(known.sum()), "steps")
    if len(turns) < MIN_STEPS:
        return _nothing(timestamps, f"{len(turns)} turns of images to compare with", counts)
    if former is None:
        starts = [(p, np.zeros(3)) for p in _candidates(turns, readings)]  # no bias
    else:
        shift = former.clock.times(np.array([turns.middle]))[0] - turns.middle
        starts = [(np.array([shift, former.clock.rate]), former.sensor.bias)]
    found = [_Guess.of(turns, readings, *start).refined() for start in starts]
    sigma = min(noise(one.fit.residuals(one.parameters)) for one in found)
    best = min(found, key=lambda one: one.fit.cost(one.parameters, sigma))
    others = [one for one in found if one is not best]
    return _judged(best.settled(), others, timestamps, counts)


def turning_of(readings: Readings, found: Alignment, timestamps: np.ndarray) -> GyroConstraints:
    """What the gyro says of frames at timestamps (F,): between them, and during each."""
    times = found.clock.times(timestamps)
    readings = readings.between(times[0] - _READOUT, times[-1] + _READOUT)
    spans = np.column_stack([times[:-1], times[1:]])
    turned = _turned(readings, found.sensor, spans) @ found.rig_R_imu.T
    rates = found.sensor.true(readings.mean_rates(times, _READOUT)) @ found.rig_R_imu.T
    noisy, every = readings.noise(), float(np.median(np.diff(readings.timestamps)))
    bent = float(np.std(np.diff(readings.rates, axis=0) / np.diff(readings.timestamps)[:, None]))
    bent = max(bent**2 - 2 * (noisy / every) ** 2, 0.0) ** 0.5  # rad/s^2, without that noise
    sigma = np.hypot(noisy / np.sqrt(max(_READOUT / every, 1.0)), found.offset_sigma * bent)
    known = readings.covers(spans)
    return GyroConstraints(turned, np.where(known, found.noise, np.inf), rates, float(sigma))


def orientations(readings: Readings, found: Alignment, times: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) of the rig at times (n,) of the sensor's clock, in a world of theirs."""
    from scipy.spatial.transform import Rotation, Slerp

    near = readings.between(times.min(), times.max())
    turned = Slerp(near.timestamps, Rotation.from_matrix(near.turned(found.sensor)))
    inside = np.clip(times, *near.timestamps[[0, -1]])
    return found.rig_R_imu @ turned(inside).as_matrix() @ found.rig_R_imu.T


@dataclass(frozen=True, slots=True)
class _Guess:
    """One clock of a gyro, and the bias and the axes that go with it."""

    turns: Turns
    readings: Readings  # those around the turns, if the clock is about right
    parameters: np.ndarray  # (2,) see `ClockFit`
    sensor: Sensor
    rig_R_imu: np.ndarray  # (3, 3)
    axes_sigma: float
    fit: ClockFit  # of the turns with the gyro, in the rig's axes

    @classmethod
    def of(
        cls, turns: Turns, readings: Readings, parameters: np.ndarray, bias: np.ndarray
    ) -> "_Guess":
        """The best bias, scales and axes for a clock, around a bias."""
        begin, end = turns.middle + parameters[0] + 1.1 * turns.ends
        near = readings.between(begin - 2 * turns.step, end + 2 * turns.step)
        near = near if len(near.timestamps) > 2 else readings
        free = replace(turns, rotvecs=np.zeros_like(turns.rotvecs))
        plain = Sensor(bias, np.ones(3))
        turned = ClockFit(free, _trajectory(near, plain)).residuals(parameters)
        left, axes, sigma = _sensor_and_axes(turns, turned)
        sensor = replace(left, bias=bias + left.bias)
        fit = ClockFit(turns, _trajectory(near, sensor, axes))
        return cls(turns, readings, parameters, sensor, axes, sigma, fit)

    def refined(self) -> "_Guess":
        """The same with a better clock, of the rate that it has."""
        parameters = self.fit.refine(self.parameters, with_rate=False)
        return _Guess.of(self.turns, self.readings, parameters, self.sensor.bias)

    def settled(self) -> "_Guess":
        """The same with the clock that fits best."""
        one = self
        for _ in range(_ROUNDS):
            parameters = simplest(one.fit, one.fit.refine(one.parameters))[0]
            moved = abs(float(parameters[0] - one.parameters[0]))
            one = _Guess.of(self.turns, self.readings, parameters, one.sensor.bias)
            if moved < _SETTLED:
                break
        return one

    def explained(self, turning: np.ndarray, sigma: float) -> float:
        """Part of the turns `turning (n,)` that are the gyro's, too, but for noise."""
        off = np.linalg.norm(self.fit.residuals(self.parameters), axis=1)
        return float(np.mean(off[turning] < _AGREEING * sigma)) if turning.any() else 0.0


def _sensor_and_axes(turns: Turns, turned: np.ndarray) -> tuple[Sensor, np.ndarray, float]:
    """Bias and scales, axes (3, 3) and their standard deviation, that carry turns (n, 3) of the
    sensor to those of the images, under a Cauchy loss."""
    spans, seen = np.diff(turns.times, axis=1), turns.rotvecs
    weights, scales, sigma = np.ones((len(spans), 1)), np.ones(3), float(np.std(seen))
    for _ in range(_REWEIGHTED):
        total = np.sum(weights * spans**2)
        by_time = [np.sum(weights * spans * some, axis=0) / total for some in (seen, turned)]
        left = seen - spans * by_time[0], turned - spans * by_time[1]
        axes = nearest_rotation((weights * left[0]).T @ (left[1] * scales))
        said = np.sum(weights * left[1] * (left[0] @ axes), axis=0) + (sigma / _SCALE) ** 2
        scales = said / (np.sum(weights * left[1] ** 2, axis=0) + (sigma / _SCALE) ** 2)
        bias = by_time[1] - axes.T @ by_time[0] / scales
        off = seen - scales * (turned - spans * bias) @ axes.T
        sigma = noise(off)
        weights = 1 / (1 + np.sum(off**2, axis=1, keepdims=True) / (_WIDTH * sigma) ** 2)
    scatter = (weights * left[1]).T @ left[1]
    information = np.linalg.eigvalsh(np.trace(scatter) * np.eye(3) - scatter)[0]
    return Sensor(bias, scales), axes, float(sigma / np.sqrt(max(information, 1e-300)))


def _candidates(turns: Turns, readings: Readings) -> Iterator[np.ndarray]:
    """Parameters (2,) of the offsets on a grid that explain most, best first."""
    free = replace(turns, rotvecs=np.zeros_like(turns.rotvecs))
    fit = ClockFit(free, _trajectory(readings, Sensor.ideal()))
    over = _OVER * float(np.ptp(turns.times))
    ends = fit.span - turns.middle - turns.ends
    low, high = min(ends) - over, max(ends) + over
    spacing = max(min(_SPACING * turns.step, _SPACING_S), (high - low) / _MOST_TRIED)
    shifts = np.arange(low, high + spacing, spacing)
    at_once = max(_MOST_AT_ONCE // len(turns), 1)
    spans, seen = np.diff(turns.times, axis=1), turns.rotvecs
    still = seen - spans * (np.sum(spans * seen, axis=0) / np.sum(spans**2))
    costs = []
    for n in range(0, len(shifts), at_once):
        some = shifts[n : n + at_once]
        turned = fit.residuals(np.column_stack([some, np.ones_like(some)]))
        by_time = np.sum(spans * turned, axis=1, keepdims=True) / np.sum(spans**2)
        turned = turned - spans * by_time
        scatter = np.einsum("ni,knj->kij", still, turned)
        u, sizes, vt = np.linalg.svd(scatter)
        sizes[:, 2] *= np.sign(np.linalg.det(u @ vt))
        costs.append(np.sum(turned**2, axis=(1, 2)) - 2 * sizes.sum(axis=1))
    chosen: list[float] = []
    for shift in shifts[np.argsort(np.concatenate(costs), kind="stable")]:
        if all(abs(shift - other) > 2.5 * spacing for other in chosen):
            chosen.append(float(shift))
            yield np.array([shift, 1.0])
        if len(chosen) == _TRIED:
            return


def _trajectory(readings: Readings, sensor: Sensor, axes: np.ndarray | None = None) -> Trajectory:
    """Orientations that rates add up to, none moving; in the sensor's axes or the rig's."""
    turned = readings.turned(sensor)
    every = max(int(_EVERY / float(np.median(np.diff(readings.timestamps)))), 1)
    turned = turned[::every] if axes is None else axes @ turned[::every] @ axes.T
    return Trajectory(readings.timestamps[::every], pose(turned, np.zeros((len(turned), 3))))


def _turned(readings: Readings, sensor: Sensor, spans: np.ndarray) -> np.ndarray:
    """Rotation vectors (n, 3) over spans of time (n, 2), on the sensor's clock and in its axes."""
    free = Turns(spans, np.zeros((len(spans), 3)))
    return ClockFit(free, _trajectory(readings, sensor)).residuals(np.array([0.0, 1.0]))


def _judged(
    best: _Guess, others: list[_Guess], timestamps: np.ndarray, counts: Counts
) -> Alignment:
    """True if the best is believed."""
    fit, parameters, turns = best.fit, best.parameters, best.turns
    sigma = noise(fit.residuals(parameters))
    turning = np.linalg.norm(turns.rotvecs, axis=1) > _TURNING * sigma
    share = best.explained(turning, sigma)
    begin = turns.middle - timestamps[0]
    offset = parameters[0] - (parameters[1] - 1) * begin
    found = Alignment(
        Clock(float(timestamps[0]), float(offset), float(parameters[1])),
        float(np.sqrt(fit.covariance(parameters, with_rate=False)[0, 0])),
        best.sensor,
        best.rig_R_imu,
        best.axes_sigma,
        noise(fit.residuals(parameters), _LEAST_NOISE),
        share,
        counts,
    )
    rivals = [o for o in others if abs(o.parameters[0] - parameters[0]) > turns.step]
    rival = max((one.explained(turning, sigma) for one in rivals), default=0.0)
    if np.quantile(np.linalg.norm(turns.rotvecs, axis=1), 0.9) < _TURN:
        return replace(found, reason="the camera turns too little to tell the gyro's clock")
    if share < _EXPLAINED or turning.sum() < _MIN_TURNS:
        return replace(found, reason="at no offset does the gyro turn as the images do")
    if rival > _RIVAL * share:
        return replace(found, reason="the gyro turns as the images do at several offsets")
    if best.axes_sigma > _AXES:
        return replace(found, reason="the camera turns about one axis alone: no axes can be told")
    return found


def _nothing(timestamps: np.ndarray, reason: str, counts: Counts) -> Alignment:
    clock, nan = Clock(float(timestamps[0]), 0.0, 1.0), float("nan")
    return Alignment(clock, nan, Sensor.ideal(), np.eye(3), nan, nan, 0.0, counts, reason)
