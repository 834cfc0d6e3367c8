"""The trajectory's clock against the video's: offset and rate, from how both say the camera turned.

Relative rotations of neighbouring frames come from the images alone. The trajectory has to turn by
as much between the same two instants, whatever its drift and scale. Angular velocities are
compared over a grid of offsets and rates first; the best few are then refined on relative
rotations under a robust loss (cf. the temporal calibration of Furgale et al., IROS 2013). Another
clock than the given one is believed only where turns pin it down, where no third one does nearly
as well, and where it explains the images markedly better.
"""

from dataclasses import dataclass

import numpy as np

from gsba.trajectory.clock_search import ClockFit, merged, noise
from gsba.trajectory.steps import Steps
from gsba.types import Trajectory

MIN_STEPS = 5  # fewer cannot tell a clock
_KNOWN, _KNOWN_S = 0.25, 0.05  # of the frames' interval, and seconds: a clock less sure is unknown
_SIGNIFICANT = 2.5  # standard deviations
_TURNING, _AGREEING = 4.0, 3.0  # standard deviations: what counts as a turn, and as the same
_MIN_TURNS = 4  # steps that turn
_EXPLAINED = 0.4  # part of them that the right clock explains at least
_SURE = 0.6  # part of them that makes a search for other clocks needless
_BETTER = 0.2  # part of them that another clock must explain besides
_RIVAL = 0.75  # of what the best explains that no third one may reach


@dataclass(frozen=True, slots=True)
class Clock:
    """How to read the trajectory's clock off that of the frames."""

    start: float  # seconds on the frames' clock, the first frame
    offset: float  # seconds to add at the start
    rate: float  # seconds of the trajectory per second of the frames

    def times(self, timestamps: np.ndarray) -> np.ndarray:
        """Times (n,) on the trajectory's clock of times (n,) on the frames'."""
        return self.start + self.offset + self.rate * (timestamps - self.start)

    def on_frames(self, trajectory: Trajectory) -> Trajectory:
        """A trajectory with its times on the frames' clock."""
        times = self.start + (trajectory.timestamps - self.start - self.offset) / self.rate
        return Trajectory(times, trajectory.world_T_rigs)


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """What rotations say of a clock."""

    clock: Clock  # to use: as given, unless corrected
    found: Clock  # of the best agreement
    offset_sigma: float  # seconds, standard deviation; NaN = not estimated
    rate_sigma: float  # 0 where no rate but the given one was needed
    before_deg: float  # median disagreement of a step's rotation under the given clock
    after_deg: float  # the same under the one found
    verdict: str  # "agrees", "corrected" or "unclear"
    note: str  # for the user; empty if the clocks agree


def estimate(
    timestamps: np.ndarray,
    found: Steps,
    trajectory: Trajectory,
    offset: float,
    reach_s: float,
) -> ClockEstimate:
    """Compare the given clock with all others within reach.

    Args:
        timestamps: (F,) of frames, seconds.
        found: steps of the images.
        trajectory: all entries, N.
        offset: that the trajectory was associated with, seconds to add to times of frames.
        reach_s: largest change of it that is tried, seconds.
    """
    given = Clock(float(timestamps[0]), offset, 1.0)
    turns = merged(timestamps, found.f_T_nexts[:, :3, :3], found.verified)
    if len(turns) < MIN_STEPS:
        nan, why = (
            float("nan"),
            f"the clock could not be checked: {len(turns)} steps of images to compare",
        )
        return ClockEstimate(given, given, nan, nan, nan, nan, "unclear", why)
    fit = ClockFit(turns, trajectory)
    start = np.array([offset, 1.0])
    interval = float(np.median(np.diff(timestamps)))
    best, covariance = simplest(fit, fit.refine(start))
    others: list[np.ndarray] = []
    if fit.apart(best, start) > interval or _explained(fit, best, best) < _SURE:
        tried = [best, *(fit.refine(p) for p in fit.candidates(start, reach_s))]
        sigma = min(noise(fit.residuals(p)) for p in tried)
        best, covariance = simplest(fit, min(tried, key=lambda p: fit.cost(p, sigma)))
        others = [p for p in tried if fit.apart(p, best) > interval]
    return _judged(fit, given, best, covariance, others, interval)


def _turning(fit: ClockFit, best: np.ndarray) -> np.ndarray:
    """Steps (N,) with more turn than noise."""
    sigma = noise(fit.residuals(best))
    return np.linalg.norm(fit.turns.rotvecs, axis=1) > _TURNING * sigma


def _explained(fit: ClockFit, parameters: np.ndarray, best: np.ndarray) -> float:
    """Part of the steps that turn in which a clock makes the trajectory turn as much."""
    turning, sigma = _turning(fit, best), noise(fit.residuals(best))
    off = np.linalg.norm(fit.residuals(parameters), axis=1)
    return float(np.mean(off[turning] < _AGREEING * sigma)) if turning.any() else 0.0


def simplest(fit: ClockFit, best: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The clock without an error of rate, unless there evidently is one; and its covariance."""
    best = fit.settle(best)
    covariance = fit.covariance(best)
    held = fit.settle(np.array([best[0], 1.0]), with_rate=False)
    sigma = noise(fit.residuals(best))
    worse = fit.cost(held, sigma) > fit.cost(best, sigma)
    if worse and abs(best[1] - 1) > _SIGNIFICANT * np.sqrt(covariance[1, 1]):
        return best, covariance
    return held, fit.covariance(held, with_rate=False)


def _judged(
    fit: ClockFit,
    given: Clock,
    best: np.ndarray,
    covariance: np.ndarray,
    others: list[np.ndarray],
    interval: float,
) -> ClockEstimate:
    """Which clock to use, and why."""
    start = np.array([given.offset, 1.0])
    degrees = [
        float(np.degrees(np.median(np.linalg.norm(fit.residuals(p), axis=1))))
        for p in (start, best)
    ]
    begin = fit.turns.middle - given.start
    at_start = np.array([1.0, -begin])
    found = Clock(given.start, float(best[0] - (best[1] - 1) * begin), float(best[1]))
    offset_sigma = float(np.sqrt(at_start @ covariance @ at_start))
    rate_sigma, certain = float(np.sqrt(covariance[1, 1])), fit.time_sigma(covariance)
    before, after = (_explained(fit, p, best) for p in (start, best))
    same = fit.apart(best, start) < _SIGNIFICANT * certain or after < before + _BETTER
    verdict, note = "unclear", ""
    if _turning(fit, best).sum() < _MIN_TURNS or certain > max(_KNOWN * interval, _KNOWN_S):
        note = f"the camera turns too little to tell the clock (to {certain:.2g} s): not checked"
    elif after < _EXPLAINED:
        note = "at no offset does the trajectory turn as the images do: the clock was not checked"
    elif same:
        verdict = "agrees"
    elif max((_explained(fit, p, best) for p in others), default=0.0) > _RIVAL * after:
        note = f"several clocks fit, such as an offset of {found.offset:.3f} s: none was changed"
    else:
        verdict, note = "corrected", _correction(found, offset_sigma, rate_sigma, degrees)
    used = found if verdict == "corrected" else given
    before, after = degrees
    return ClockEstimate(used, found, offset_sigma, rate_sigma, before, after, verdict, note)


def _correction(found: Clock, offset_sigma: float, rate_sigma: float, degrees: list[float]) -> str:
    rate = ""
    if found.rate != 1:
        rate = f" and the rate {found.rate:.5f} +- {rate_sigma:.5f}"
    return (
        f"the trajectory's clock was corrected by how the camera turns: the offset is "
        f"{found.offset:.3f} +- {offset_sigma:.3f} s at the first frame{rate} "
        f"(disagreement of a step {degrees[0]:.2f} degrees before, {degrees[1]:.2f} after)"
    )
