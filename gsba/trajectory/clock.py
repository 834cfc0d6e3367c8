"""The trajectory's clock against the video's: offset and rate by which it rotates as the images do.
Angular velocities are compared over a grid; the best are refined on relative rotations under a
robust loss (cf. Furgale et al., IROS 2013)."""

from dataclasses import dataclass, replace

import numpy as np

from gsba.significance import outweighs
from gsba.trajectory.clock_search import ClockFit, merged, noise
from gsba.trajectory.steps import Steps
from gsba.types import Trajectory

MIN_STEPS = 5  # least number of steps that determine a clock
_MAX_SIGMA_INTERVALS, _MAX_SIGMA_S = 0.25, 0.05  # largest standard deviation of a known clock: in
# frame intervals, and in seconds
_SIGNIFICANT_SIGMAS = 2.5  # standard deviations from 1 of a significant rate
MIN_TURNS = 4  # least number of steps that turn
_MIN_EXPLAINED = 0.4  # least share of the turns that the right clock explains
_SURE_EXPLAINED = 0.6  # share of the turns from which no other clocks are searched
_MIN_GAIN = 0.2  # share of the turns by which another clock must explain more
_MAX_NOISE_RATIO = 0.5  # largest noise of rotations under another rate, in that under the given one


@dataclass(frozen=True, slots=True)
class Clock:
    """Mapping from the frames' clock to the trajectory's."""

    start: float  # seconds on the frames' clock, the first frame
    offset: float  # seconds to add at the start
    rate: float  # seconds of the trajectory per second of the frames

    def times(self, timestamps: np.ndarray) -> np.ndarray:
        """Times (n,) on the trajectory's clock of times (n,) on the frames'."""
        return self.start + self.offset + self.rate * (timestamps - self.start)

    def on_frames(self, trajectory: Trajectory) -> Trajectory:
        """A trajectory with its times on the frames' clock."""
        times = self.start + (trajectory.timestamps - self.start - self.offset) / self.rate
        return replace(trajectory, timestamps=times)


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """The clock estimated from rotations, and the verdict on the given one."""

    clock: Clock  # to use: the given one, unless corrected
    found: Clock  # the best fit
    offset_sigma: float  # seconds, standard deviation; NaN = not estimated
    rate_sigma: float  # 0 if the rate is the given one
    before_deg: float  # median rotation residual of a step under the given clock
    after_deg: float  # median rotation residual of a step under the clock found
    verdict: str  # "agrees", "corrected" or "unclear"
    note: str  # for the user; empty if the clocks agree


def estimate_clock(
    timestamps: np.ndarray, found: Steps, trajectory: Trajectory, offset: float
) -> ClockEstimate:
    """Compare the given clock, by its offset to times (F,) of frames, with all others whose offset
    differs by up to 10 s; all in seconds."""
    given = Clock(float(timestamps[0]), offset, 1.0)
    turns = merged(timestamps, found.f_T_nexts[:, :3, :3], found.verified)
    if len(turns) < MIN_STEPS:
        nan = float("nan")
        why = f"the clock could not be checked: only {len(turns)} steps are known from images"
        return ClockEstimate(given, given, nan, nan, nan, nan, "unclear", why)
    fit = ClockFit(turns, trajectory)
    start = np.array([offset, 1.0])
    interval = float(np.median(np.diff(timestamps)))
    best, covariance = simplest(fit, fit.refine(start))
    others: list[np.ndarray] = []
    explained = fit.explained(best, noise(fit.residuals(best)))
    if fit.apart(best, start) > interval or explained < _SURE_EXPLAINED:
        tried = [best, *(fit.refine(p) for p in fit.candidates(start, 10.0))]
        sigma = min(noise(fit.residuals(p)) for p in tried)
        best, covariance = simplest(fit, min(tried, key=lambda p: fit.cost(p, sigma)))
        others = [p for p in tried if fit.apart(p, best) > interval]
    degrees = [
        float(np.degrees(np.median(np.linalg.norm(fit.residuals(p), axis=1))))
        for p in (start, best)
    ]
    begin = fit.turns.middle - given.start
    at_start = np.array([1.0, -begin])
    clock = Clock(given.start, float(best[0] - (best[1] - 1) * begin), float(best[1]))
    offset_sigma = float(np.sqrt(at_start @ covariance @ at_start))
    rate_sigma, certain = float(np.sqrt(covariance[1, 1])), fit.time_sigma(covariance)
    sigma = noise(fit.residuals(best))
    before, after = (fit.explained(p, sigma) for p in (start, best))
    same = fit.apart(best, start) < _SIGNIFICANT_SIGMAS * certain or after < before + _MIN_GAIN
    verdict, note = "unclear", ""
    if fit.turning(sigma).sum() < MIN_TURNS or certain > max(
        _MAX_SIGMA_INTERVALS * interval, _MAX_SIGMA_S
    ):
        note = f"the camera turns too little to check the clock (uncertain by {certain:.2g} s)"
    # by three times as much, steps contradict the images (see `TwoViewLimits`)
    elif after < _MIN_EXPLAINED or sigma > np.deg2rad(2.0):
        note = "the trajectory's rotations fit the images at no clock offset: clock not checked"
    elif same:
        verdict = "agrees"
    elif max((fit.explained(p, sigma) for p in others), default=0.0) > 0.75 * after:
        note = f"several clock offsets fit, such as {clock.offset:.3f} s: the given one is kept"
    else:
        rate = ""
        if clock.rate != 1:
            rate = f" and the rate {clock.rate:.5f} +- {rate_sigma:.5f}"
        verdict = "corrected"
        note = (
            f"the trajectory's clock was corrected by camera rotations: the offset is "
            f"{clock.offset:.3f} +- {offset_sigma:.3f} s at the first frame{rate} "
            f"(median rotation residual of a step: {degrees[0]:.2f} degrees before, "
            f"{degrees[1]:.2f} after)"
        )
    used = clock if verdict == "corrected" else given
    before, after = degrees
    return ClockEstimate(used, clock, offset_sigma, rate_sigma, before, after, verdict, note)


def other_rate(
    timestamps: np.ndarray, found: Steps, trajectory: Trajectory, estimate: ClockEstimate
) -> float | None:
    """Rate of the trajectory's clock, 0.1 to 10, at which it turns as the images do from the first
    frame on, if the given rate and those near it contradict the images; else None.

    It is no correction, as rate and offset are hardly determined where the verdict is unclear.
    """
    turns = merged(timestamps, found.f_T_nexts[:, :3, :3], found.verified)
    if estimate.verdict != "unclear" or len(turns) < MIN_STEPS:
        return None
    given, start = estimate.clock, np.array([estimate.clock.offset, 1.0])
    begin = given.start + given.offset

    def at_rate(rate: float) -> ClockFit:
        times = begin + (trajectory.timestamps - begin) / rate
        return ClockFit(turns, replace(trajectory, timestamps=times))

    usual = ClockFit(turns, trajectory)
    before = usual.residuals(usual.refine(start))
    # spaced by twice what the search around each of them reaches
    rates = np.exp(np.delete(np.linspace(-1, 1, 81), 40) * np.log(10)).tolist()
    tried = [
        (fit.cost(p, noise(before)), rate, p)
        for rate, fit in ((rate, at_rate(rate)) for rate in rates)
        for p in fit.candidates(start, turns.step)
    ]
    tried.sort(key=lambda one: one[0])
    nearest = [(rate, at_rate(rate), p) for _, rate, p in tried[:4]]
    refined = [(rate, fit, fit.refine(p)) for rate, fit, p in nearest]
    sigma = min(noise(fit.residuals(p)) for _, fit, p in refined)
    rate, fit, best = min(refined, key=lambda one: one[1].cost(one[2], sigma))
    after = [np.linalg.norm(residuals, axis=1) for residuals in (before, fit.residuals(best))]
    nearer = np.count_nonzero(after[1] < after[0])
    sigma = noise(fit.residuals(best))
    contradicted = (
        fit.turning(sigma).sum() >= MIN_TURNS
        and fit.explained(best, sigma) >= _SURE_EXPLAINED
        and sigma < _MAX_NOISE_RATIO * noise(before)
        and outweighs(int(nearer), len(turns) - int(nearer), 1e-3)
    )
    return float(rate * best[1]) if contradicted else None


def simplest(fit: ClockFit, best: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The clock with the given rate, unless another is significant; and its covariance."""
    best = fit.settle(best)
    covariance = fit.covariance(best)
    held = fit.settle(np.array([best[0], 1.0]), with_rate=False)
    sigma = noise(fit.residuals(best))
    worse = fit.cost(held, sigma) > fit.cost(best, sigma)
    if worse and abs(best[1] - 1) > _SIGNIFICANT_SIGMAS * np.sqrt(covariance[1, 1]):
        return best, covariance
    return held, fit.covariance(held, with_rate=False)
