"""Checks that the times of frames and of a trajectory can be of one clock, and in one unit."""

import numpy as np

from gsba.log import GsbaError

_UNIT_OF_POWER = {3: "milliseconds", 6: "microseconds", 9: "nanoseconds"}  # by their power of ten
_MAX_LOG_DEVIATION = np.log10(1.5)  # largest log10 deviation of the ratio of durations from a
# unit's power
_MAX_ROUGH_LOG_DEVIATION = np.log10(5.0)  # the same limit if times as given make no sense
_MAX_INTERVAL_RATIO = 8.0  # largest interval in the other side's intervals: no SLAM and no camera
# is that slow
_MIN_INTERVAL_S = 1e-9  # least interval: no camera is that fast


def refuse_intervals(frame_times: np.ndarray, entries: np.ndarray) -> None:
    """Refuse times (F,), (N,) that lie closer together than a clock resolves.

    Raises:
        GsbaError: two times are too close; the message names them.
    """
    for owner, times in (("two frames are", frame_times), ("two poses are", entries)):
        if np.diff(times).min() <= _MIN_INTERVAL_S:
            at = float(times[np.argmin(np.diff(times))])
            raise GsbaError(
                f"{owner} less than {_MIN_INTERVAL_S:g} s apart, at {at!r} s: check the times"
            )


def refuse_other_unit(
    frame_times: np.ndarray, entries: np.ndarray, senseless: bool = False
) -> None:
    """Refuse times of one side in milli-, micro- or nanoseconds while the other is in seconds.

    Both durations agree but for a power of a thousand. A clip of a long trajectory may do so by
    chance, or poses for a few of many frames: then neither side is much sparser than the other.

    Args:
        frame_times: (F,) frame times as given, ascending.
        entries: (N,) times of the trajectory as given, ascending.
        senseless: True if times as given make no sense; then the limit is looser.

    Raises:
        GsbaError: units differ; the message names the unit and the remedy.
    """
    ratio = float(np.log10(np.ptp(entries) / np.ptp(frame_times)))
    power = int(np.clip(3 * round(ratio / 3), -9, 9))
    intervals = np.median(np.diff(entries)), np.median(np.diff(frame_times))
    sparse = max(intervals) > _MAX_INTERVAL_RATIO * min(intervals) and (power > 0) == (
        intervals[0] > intervals[1]
    )
    sure = abs(ratio - power) <= _MAX_LOG_DEVIATION and sparse
    if power == 0 or not (sure or (senseless and abs(ratio - power) <= _MAX_ROUGH_LOG_DEVIATION)):
        return
    whose, others = ("the trajectory's times", "the frames'")
    what = "divide them"
    if power < 0:
        whose, others = "the frames' times", "the trajectory's"
        what = "check --fps, or divide the times"
    raise GsbaError(
        f"{whose} look like {_UNIT_OF_POWER[abs(power)]} where {others} are seconds (frames span "
        f"{span(frame_times)}, the trajectory {span(entries)}): {what} by 1e{abs(power)}"
    )


def refuse_apart(frame_times: np.ndarray, entries: np.ndarray, margin: float) -> None:
    """Refuse a trajectory that hardly overlaps the frames in time.

    Args:
        frame_times: (F,) frame times on the trajectory's clock, ascending.
        entries: (N,) times of the trajectory, ascending.
        margin: seconds by which both spans are extended.

    Raises:
        GsbaError: fewer than two frames lie in its span, or fewer than two poses in theirs.
    """
    inside = np.sum((frame_times >= entries[0] - margin) & (frame_times <= entries[-1] + margin))
    during = np.sum((entries >= frame_times[0] - margin) & (entries <= frame_times[-1] + margin))
    if min(inside, during) >= 2:
        return
    refuse_other_unit(frame_times, entries, senseless=True)
    what = f"only {inside} of {len(frame_times)} frames lie within the trajectory's time"
    if during < 2:
        what = f"only {during} of {len(entries)} poses lie within the frames' time"
    raise GsbaError(
        f"{what} (frames span {span(frame_times)} s, the trajectory {span(entries)} s): check "
        "--fps, --timestamps or read.clock_offset_s, or refine without it (--no-trajectory)"
    )


def span(times: np.ndarray) -> str:
    """First and last of times (N,), for a message."""
    return f"{times[0]:.6f} to {times[-1]:.6f}"
