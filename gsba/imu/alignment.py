"""Clock, bias and axes of a gyro from camera rotations by images, and the vertical by forces.

Each offset on a grid gives its best axes and bias in closed form (Kabsch 1976, on rotation
vectors; the bias is the part that grows with time alone). The best few are refined; scale errors
of a percent are estimated for each axis where rotations determine them.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from gsba.containers.insta360 import STANDARD_GRAVITY
from gsba.geometry import median_direction, nearest_rotation, pose
from gsba.imu.readings import Readings, Sensor
from gsba.trajectory.clock import MIN_STEPS, MIN_TURNS, Clock, simplest
from gsba.trajectory.clock_search import LOSS_WIDTH_SIGMAS, ClockFit, Turns, merged, noise
from gsba.types import Counts, GyroConstraints, Trajectory

logger = logging.getLogger(__name__)

_MAX_SPACING_STEPS, _MAX_SPACING_S = 0.25, 0.05  # largest spacing of tried offsets: in steps, and
# in seconds
_MIN_EXPLAINED = 0.6  # least share of the turns that a gyro must explain
_SCALE_SIGMA = 0.01  # prior standard deviation of a gyro's scale
_RATE_SPAN_S = 0.01  # s over which an angular velocity is averaged
_MAX_UP_SCATTER_DEG = 5.0  # median angle of a second's vertical to that of all


@dataclass(frozen=True, slots=True)
class Alignment:
    """The relation of a gyro's readings to the frames."""

    clock: Clock  # from the frames' clock to the sensor's
    offset_sigma: float  # s, standard deviation
    sensor: Sensor  # bias and scales
    rig_R_imu: np.ndarray  # (3, 3) float64, from the sensor's axes to the rig's
    axes_sigma: float  # rad, standard deviation of the least certain axis
    noise: float  # rad per axis, of a rotation between frames, including the images' errors
    explained: float  # share of the frames' turns that the gyro explains
    counts: Counts  # of steps
    reason: str = ""  # why the gyro is not used; empty if it is


def align(
    timestamps: np.ndarray,
    f_R_nexts: np.ndarray,
    known: np.ndarray,
    readings: Readings,
    former: Alignment | None = None,
) -> Alignment:
    """Estimate clock, bias, scales and axes of a gyro from rotations (F - 1, 3, 3) by images, some
    of which are known, between consecutive frames at timestamps (F,), seconds; former: the estimate
    from less accurate rotations, None = try all offsets."""
    turns = merged(timestamps, f_R_nexts, known)
    num_known = int(known.sum())
    dropped = {"rotation not known from images": len(f_R_nexts) - num_known}
    counts = Counts(len(f_R_nexts), num_known, "steps", dropped)
    if len(turns) < MIN_STEPS:
        clock, nan = Clock(float(timestamps[0]), 0.0, 1.0), float("nan")
        why = f"only {len(turns)} rotations are known from images"
        return Alignment(clock, nan, Sensor.ideal(), np.eye(3), nan, nan, 0.0, counts, why)
    if former is None:
        starts = [(p, np.zeros(3)) for p in _candidates(turns, readings)]  # no bias
    else:
        shift = former.clock.times(np.array([turns.middle]))[0] - turns.middle
        starts = [(np.array([shift, former.clock.rate]), former.sensor.bias)]
    found = [_Candidate.of(turns, readings, *start).refined() for start in starts]
    sigma = min(noise(one.fit.residuals(one.parameters)) for one in found)
    best = min(found, key=lambda one: one.fit.cost(one.parameters, sigma))
    others = [one for one in found if one is not best]
    return _with_reason(best.settled(), others, timestamps, counts)


def turning_of(readings: Readings, found: Alignment, timestamps: np.ndarray) -> GyroConstraints:
    """Rotations between frames at timestamps (F,), and angular velocity during each, by the
    gyro."""
    times = found.clock.times(timestamps)
    readings = readings.between(times[0] - _RATE_SPAN_S, times[-1] + _RATE_SPAN_S)
    spans = np.column_stack([times[:-1], times[1:]])
    free = Turns(spans, np.zeros((len(spans), 3)))
    fit = ClockFit(free, _orientation_trajectory(readings, found.sensor))
    turned = fit.residuals(np.array([0.0, 1.0])) @ found.rig_R_imu.T
    rates = found.sensor.true(readings.mean_rates(times, _RATE_SPAN_S)) @ found.rig_R_imu.T
    noisy, every = readings.noise(), float(np.median(np.diff(readings.timestamps)))
    bent = float(np.std(np.diff(readings.rates, axis=0) / np.diff(readings.timestamps)[:, None]))
    bent = max(bent**2 - 2 * (noisy / every) ** 2, 0.0) ** 0.5  # rad/s^2, without that noise
    sigma = np.hypot(noisy / np.sqrt(max(_RATE_SPAN_S / every, 1.0)), found.offset_sigma * bent)
    known = readings.covers(spans)
    return GyroConstraints(turned, np.where(known, found.noise, np.inf), rates, float(sigma))


def orientations(readings: Readings, found: Alignment, times: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) of the rig at times (n,) of the sensor's clock, in a world of their
    own."""
    from scipy.spatial.transform import Rotation, Slerp

    near = readings.between(times.min(), times.max())
    turned = Slerp(near.timestamps, Rotation.from_matrix(near.turned(found.sensor)))
    inside = np.clip(times, *near.timestamps[[0, -1]])
    return found.rig_R_imu @ turned(inside).as_matrix() @ found.rig_R_imu.T


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A candidate clock of a gyro, and the bias and axes that fit it."""

    turns: Turns
    readings: Readings  # those around the turns, if the clock is about right
    parameters: np.ndarray  # (2,) see `ClockFit`
    sensor: Sensor
    rig_R_imu: np.ndarray  # (3, 3)
    axes_sigma: float
    fit: ClockFit  # of the turns to the gyro, in the rig's axes

    @classmethod
    def of(
        cls, turns: Turns, readings: Readings, parameters: np.ndarray, bias: np.ndarray
    ) -> "_Candidate":
        """The best bias, scales and axes for a clock, linearised around a bias."""
        begin, end = turns.middle + parameters[0] + 1.1 * turns.ends
        near = readings.between(begin - 2 * turns.step, end + 2 * turns.step)
        near = near if len(near.timestamps) > 2 else readings
        free = replace(turns, rotvecs=np.zeros_like(turns.rotvecs))
        plain = Sensor(bias, np.ones(3))
        turned = ClockFit(free, _orientation_trajectory(near, plain)).residuals(parameters)
        left, axes, sigma = _sensor_and_axes(turns, turned)
        sensor = replace(left, bias=bias + left.bias)
        fit = ClockFit(turns, _orientation_trajectory(near, sensor, axes))
        return cls(turns, readings, parameters, sensor, axes, sigma, fit)

    def refined(self) -> "_Candidate":
        """The candidate with a refined offset, at its current rate."""
        parameters = self.fit.refine(self.parameters, with_rate=False)
        return _Candidate.of(self.turns, self.readings, parameters, self.sensor.bias)

    def settled(self) -> "_Candidate":
        """The candidate with clock, bias and axes refined in turn."""
        one = self
        for _ in range(3):  # rounds of clock, then bias and axes
            parameters = simplest(one.fit, one.fit.refine(one.parameters))[0]
            moved = abs(float(parameters[0] - one.parameters[0]))
            one = _Candidate.of(self.turns, self.readings, parameters, one.sensor.bias)
            if moved < 1e-5:  # s of change of the offset below which rounds end
                break
        return one


def _sensor_and_axes(turns: Turns, turned: np.ndarray) -> tuple[Sensor, np.ndarray, float]:
    """Bias and scales, axes (3, 3) and their sigma, by sensor and image rotations (n, 3)."""
    spans, seen = np.diff(turns.times, axis=1), turns.rotvecs
    weights, scales, sigma = np.ones((len(spans), 1)), np.ones(3), float(np.std(seen))
    for _ in range(10):  # reweighting passes over bias and axes
        total = np.sum(weights * spans**2)
        by_time = [np.sum(weights * spans * some, axis=0) / total for some in (seen, turned)]
        left = seen - spans * by_time[0], turned - spans * by_time[1]
        axes = nearest_rotation((weights * left[0]).T @ (left[1] * scales))
        moments = np.sum(weights * left[1] * (left[0] @ axes), axis=0) + (sigma / _SCALE_SIGMA) ** 2
        scales = moments / (np.sum(weights * left[1] ** 2, axis=0) + (sigma / _SCALE_SIGMA) ** 2)
        bias = by_time[1] - axes.T @ by_time[0] / scales
        off = seen - scales * (turned - spans * bias) @ axes.T
        sigma = noise(off)
        weights = 1 / (1 + np.sum(off**2, axis=1, keepdims=True) / (LOSS_WIDTH_SIGMAS * sigma) ** 2)
    scatter = (weights * left[1]).T @ left[1]
    information = np.linalg.eigvalsh(np.trace(scatter) * np.eye(3) - scatter)[0]
    return Sensor(bias, scales), axes, float(sigma / np.sqrt(max(information, 1e-300)))


def _candidates(turns: Turns, readings: Readings) -> Iterator[np.ndarray]:
    """Parameters (2,) of the grid's offsets that explain the most, best first."""
    free = replace(turns, rotvecs=np.zeros_like(turns.rotvecs))
    fit = ClockFit(free, _orientation_trajectory(readings, Sensor.ideal()))
    over = 0.4 * float(np.ptp(turns.times))  # part of the video that may lie outside the readings
    ends = fit.span - turns.middle - turns.ends
    low, high = min(ends) - over, max(ends) + over
    # at most 60,000 offsets
    spacing = max(min(_MAX_SPACING_STEPS * turns.step, _MAX_SPACING_S), (high - low) / 60_000)
    shifts = np.arange(low, high + spacing, spacing)
    at_once = max(200_000 // len(turns), 1)  # rotations of all offsets tried together
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
        if len(chosen) == 6:  # offsets of the grid that are refined
            return


def _orientation_trajectory(
    readings: Readings, sensor: Sensor, axes: np.ndarray | None = None
) -> Trajectory:
    """Orientations integrated from angular velocities of sensor or rig, without translation."""
    turned = readings.turned(sensor)
    # s: rotation is uniform in between
    every = max(int(0.004 / float(np.median(np.diff(readings.timestamps)))), 1)
    last = len(turned) - 1  # kept: after the last orientation nothing turns
    rows = np.append(np.arange(0, last, every), last)
    turned = turned[rows] if axes is None else axes @ turned[rows] @ axes.T
    return Trajectory(readings.timestamps[rows], pose(turned, np.zeros((len(turned), 3))))


def _with_reason(
    best: _Candidate, others: list[_Candidate], timestamps: np.ndarray, counts: Counts
) -> Alignment:
    """The alignment of the best candidate, with the reason if it is rejected."""
    fit, parameters, turns = best.fit, best.parameters, best.turns
    sigma = noise(fit.residuals(parameters))
    begin = turns.middle - timestamps[0]
    offset = parameters[0] - (parameters[1] - 1) * begin
    # steady gyros on the move are no better
    return Alignment(
        Clock(float(timestamps[0]), float(offset), float(parameters[1])),
        float(np.sqrt(fit.covariance(parameters, with_rate=False)[0, 0])),
        best.sensor,
        best.rig_R_imu,
        best.axes_sigma,
        noise(fit.residuals(parameters), np.deg2rad(0.003)),
        fit.explained(parameters, sigma),
        counts,
        _why_rejected(best, others, sigma),
    )


def _why_rejected(best: _Candidate, others: list[_Candidate], sigma: float) -> str:
    """Why the best candidate, which leaves noise `sigma`, is not used; "" = it is."""
    fit, parameters, turns = best.fit, best.parameters, best.turns
    share = fit.explained(parameters, sigma)
    rivals = [o for o in others if abs(o.parameters[0] - parameters[0]) > turns.step]
    rival = max((one.fit.explained(one.parameters, sigma) for one in rivals), default=0.0)
    # a tenth of the steps must turn by a degree
    if np.quantile(np.linalg.norm(turns.rotvecs, axis=1), 0.9) < np.deg2rad(1.0):
        return "the camera turns too little to determine the gyro's clock"
    reversed_ = replace(best.readings, rates=-best.readings.rates)
    other = _Candidate.of(turns, reversed_, parameters, -best.sensor.bias).fit
    if noise(other.residuals(parameters)) < 0.5 * sigma:  # of a mirror image of the axes
        return "the gyro's axes are left-handed: one is reversed, or two are exchanged"
    if share < _MIN_EXPLAINED or fit.turning(sigma).sum() < MIN_TURNS:
        return "the gyro's rotations fit the images at no clock offset"
    if rival > 0.75 * share:  # share of the best offset's explained turns that no rival may reach
        return "the gyro's rotations fit the images at several clock offsets"
    if best.axes_sigma > np.deg2rad(5.0):
        return "the camera turns about one axis only: the gyro's axes are undetermined"
    return ""


def up_axis(
    readings: Readings, found: Alignment, timestamps: np.ndarray, world_R_rigs: np.ndarray
) -> np.ndarray | None:
    """Unit vector (3,) along the vertical in the world; None if forces do not determine it.
    Timestamps (F,) of frames, seconds, are on their own clock.

    Forces are rotated into the world by the refined rotation (F, 3, 3) of the frame before and the
    gyro since then, and averaged over two steps each. Longer accelerations are outliers: the result
    is the geometric median of the means. Where these turn with the camera, the accelerometer has
    other axes than the gyro.
    """
    if readings.forces is None:
        return None
    times = found.clock.times(timestamps)
    inside = (readings.timestamps >= times[0]) & (readings.timestamps <= times[-1])
    if not inside.any():
        return None
    at, forces = readings.timestamps[inside], readings.forces[inside] @ found.rig_R_imu.T
    before = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 1)
    turned = orientations(readings, found, np.concatenate([times, at]))
    of_frames, of_forces = turned[: len(times)], turned[len(times) :]
    worlds = world_R_rigs @ np.swapaxes(of_frames, 1, 2)
    up = np.einsum("nij,njk,nk->ni", worlds[before], of_forces, forces)
    part = ((at - at[0]) / 1.05).astype(int)  # s: two steps, in which sways cancel out
    counts = np.bincount(part)
    full = counts > 0.5 * np.median(counts[counts > 0])
    means = np.column_stack([np.bincount(part, column) for column in up.T])
    means = means[full] / counts[full, None]
    lengths = np.linalg.norm(means, axis=1)
    right = np.abs(lengths - STANDARD_GRAVITY) < 0.2 * STANDARD_GRAVITY
    if right.sum() < 3:  # least number of such means
        return None
    directions = means[right] / lengths[right, None]
    up = median_direction(directions)
    scatter = float(np.degrees(np.median(np.arccos(np.clip(directions @ up, -1, 1)))))
    if scatter > _MAX_UP_SCATTER_DEG:
        logger.warning(
            "the accelerometer is not used: its vertical turns with the camera, by %.0f degrees in "
            "the median: check that its axes are those of the gyro",
            scatter,
        )
        return None
    return up
