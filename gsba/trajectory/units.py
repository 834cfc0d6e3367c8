"""True if the times of frames and of a trajectory can be of one clock, or what is wrong there."""

import numpy as np

from gsba.log import GsbaError

_UNITS = {3: "milliseconds", 6: "microseconds", 9: "nanoseconds"}  # by their power of ten
_SURE = np.log10(1.5)  # of the durations' ratio: as close to that power, times are in that unit
_ROUGH = np.log10(5.0)  # the same where times as they are make no sense
_SPARSE = 8.0  # intervals of the others between two times: no SLAM and no camera is that slow
_AT_ONCE_S = 1e-9  # no camera is that fast


def refuse_intervals(frame_times: np.ndarray, entries: np.ndarray) -> None:
    """Refuse times (F,), (N,) that lie closer together than any clock tells.

    Raises:
        GsbaError: naming them.
    """
    for owner, times in (("two frames are", frame_times), ("two poses are", entries)):
        if np.diff(times).min() <= _AT_ONCE_S:
            at = float(times[np.argmin(np.diff(times))])
            raise GsbaError(
                f"{owner} less than {_AT_ONCE_S:g} s apart, at {at!r} s: check the times"
            )


def refuse_other_unit(
    frame_times: np.ndarray, entries: np.ndarray, senseless: bool = False
) -> None:
    """Refuse times of which one side is in milli-, micro- or nanoseconds where the other is not.

    Both last about as long, but for a power of a thousand. A clip of a long trajectory may do so
    by chance, or poses for a few of many frames: then neither are much sparser than the others.

    Args:
        frame_times: (F,) as given, ascending.
        entries: (N,) of the trajectory, as given, ascending.
        senseless: True if times as they are make no sense; then less will do.

    Raises:
        GsbaError: naming the unit and what to do.
    """
    ratio = float(np.log10(np.ptp(entries) / np.ptp(frame_times)))
    power = int(np.clip(3 * round(ratio / 3), -9, 9))
    intervals = np.median(np.diff(entries)), np.median(np.diff(frame_times))
    sparse = max(intervals) > _SPARSE * min(intervals) and (power > 0) == (
        intervals[0] > intervals[1]
    )
    sure = abs(ratio - power) <= _SURE and sparse
    if power == 0 or not (sure or (senseless and abs(ratio - power) <= _ROUGH)):
        return
    whose, others = ("the trajectory's times", "the frames'")
    what = "divide them"
    if power < 0:
        whose, others = "the frames' times", "the trajectory's"
        what = "check --fps, or divide the times"
    raise GsbaError(
        f"{whose} look like {_UNITS[abs(power)]} where {others} are seconds (frames span "
        f"{span(frame_times)}, the trajectory {span(entries)}): {what} by 1e{abs(power)}"
    )


def refuse_apart(frame_times: np.ndarray, entries: np.ndarray, margin: float) -> None:
    """Refuse a trajectory that has next to nothing to do with the frames' time.

    Args:
        frame_times: (F,) on the trajectory's clock, ascending.
        entries: (N,), ascending.
        margin: seconds by which the span of either reaches further.

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
