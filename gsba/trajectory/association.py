"""Coarse pose of every frame from a trajectory on its own clock."""

import logging

import numpy as np

from gsba.config import ReadSettings
from gsba.geometry import inverse, pose
from gsba.log import GsbaError
from gsba.types import CoarsePoses, FrameSet, PoseSource, Trajectory

_MAX_INTERPOLATION_S = 10.0  # between an entry and a frame; poses further away are reported

_log = logging.getLogger(__name__)

_UNIT_OF_POWER = {3: "milliseconds", 6: "microseconds", 9: "nanoseconds"}  # by their power of ten
_MAX_LOG_DEVIATION = np.log10(1.5)  # largest log10 deviation of the ratio of durations from a
# unit's power
_MAX_ROUGH_LOG_DEVIATION = np.log10(5.0)  # the same limit if times as given make no sense
_MAX_INTERVAL_RATIO = 8.0  # largest interval in the other side's intervals: no SLAM and no camera
# is that slow
_MIN_INTERVAL_S = 1e-9  # least interval: no camera is that fast


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
    whose, others, what = "the trajectory's times", "the frames'", "divide them"
    if power < 0:
        whose, others = "the frames' times", "the trajectory's"
        what = "check --fps, or divide the times"
    raise GsbaError(
        f"{whose} look like {_UNIT_OF_POWER[abs(power)]} where {others} are seconds (frames span "
        f"{span(frame_times)}, the trajectory {span(entries)}): {what} by 1e{abs(power)}"
    )


def refuse_apart(frame_times: np.ndarray, entries: np.ndarray, margin: float) -> None:
    """Refuse a trajectory (N,) that hardly overlaps the frames (F,) in time, seconds on its clock,
    both spans extended by `margin`."""
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


def associate(frames: FrameSet, trajectory: Trajectory, settings: ReadSettings) -> CoarsePoses:
    """Give each frame the trajectory's pose at its time, interpolated or extrapolated if needed.

    Between entries rotations are slerped and positions linear. Beyond the ends the velocity there
    is continued and fades out. A frame counts as tracked by the SLAM if an entry lies within half
    an interval of frames or entries, whichever is shorter.

    Args:
        trajectory: N entries; its clock may differ from the frames' by a constant.
        settings: `clock_offset_s` states that constant. Without it the clocks must agree, or
            exactly one offset must make all times meet; that one is then used, with a warning.

    Raises:
        GsbaError: no overlap in time, and no single offset that explains it; times in another unit;
            hardly any pose within the frames' time.
    """
    entries = trajectory.timestamps
    for owner, times in (("two frames are", frames.timestamps), ("two poses are", entries)):
        if np.diff(times).min() <= _MIN_INTERVAL_S:
            at = float(times[np.argmin(np.diff(times))])
            raise GsbaError(
                f"{owner} less than {_MIN_INTERVAL_S:g} s apart, at {at!r} s: check the times"
            )
    refuse_other_unit(frames.timestamps, entries)
    offset = _clock_offset(frames.timestamps, entries, settings.clock_offset_s)
    times = frames.timestamps + offset
    refuse_apart(times, entries, _half_interval(times, entries))
    away = np.abs(entries[nearest(entries, times)] - times)
    seen = away <= _half_interval(frames.timestamps, entries)
    outside = (times < entries[0]) | (times > entries[-1])
    sources = np.where(
        seen, PoseSource.SLAM, np.where(outside, PoseSource.EXTRAPOLATED, PoseSource.INTERPOLATED)
    ).astype(np.uint8)
    counts = np.bincount(sources, minlength=len(PoseSource))
    _log.log(
        logging.INFO if (sources != PoseSource.SLAM).any() else logging.DEBUG,
        "coarse poses: %d from the trajectory, %d interpolated, %d extrapolated",
        *(counts[s] for s in PoseSource if s != PoseSource.NONE),
    )
    inside = np.clip(np.searchsorted(entries, times), 1, len(entries) - 1)
    gaps = entries[inside] - entries[inside - 1]
    far = np.maximum(entries[0] - times, times - entries[-1])
    distance = np.where(sources == PoseSource.INTERPOLATED, gaps, far)
    long = (sources != PoseSource.SLAM) & (distance > _MAX_INTERPOLATION_S)
    if long.any():
        f = int(np.argmax(np.where(long, distance, 0)))
        _log.warning(
            "rough poses in gaps of the trajectory longer than %g s: %d (frame '%s': %.1f s)",
            _MAX_INTERPOLATION_S,
            long.sum(),
            frames.names[f],
            distance[f],
        )
    return CoarsePoses(poses_at(trajectory, times), sources, offset)


def without_trajectory(frames: FrameSet) -> CoarsePoses:
    """Placeholder poses for runs without a trajectory: one unit ahead for every frame."""
    positions = np.outer(np.arange(len(frames)), [0.0, 0.0, 1.0])
    poses = pose(np.tile(np.eye(3), (len(frames), 1, 1)), positions)
    return CoarsePoses(poses, np.full(len(frames), PoseSource.NONE, np.uint8), 0.0)


def _clock_offset(frame_times: np.ndarray, entries: np.ndarray, stated: float | None) -> float:
    """Offset to add to frame times to reach the trajectory's clock, seconds."""
    times = frame_times + (stated or 0.0)
    half = _half_interval(times, entries)
    frames_in = np.mean((times >= entries[0] - half) & (times <= entries[-1] + half))
    entries_in = np.mean((entries >= times[0] - half) & (entries <= times[-1] + half))
    shared = float(max(frames_in, entries_in)) if min(frames_in, entries_in) > 0 else 0.0
    if shared >= 0.5 or (stated is not None and shared > 0):
        return stated or 0.0
    ranges = f"frames span {span(times)} s, the trajectory {span(entries)} s"
    if stated is not None:
        raise GsbaError(f"no overlap in time with read.clock_offset_s = {stated}: {ranges}")
    # Offsets at which the times of the smaller set all occur in the larger one, two at most
    sign = 1.0
    few, many = entries, frame_times
    if len(few) > len(many):
        sign, few, many = -1.0, many, few
    # times coincide within a tenth of the shortest interval
    tolerance = 0.1 * min(np.diff(few).min(), np.diff(many).min())
    found: list[float] = []
    for shift in few[0] - many:
        shifted = few - shift
        if shifted[-1] > many[-1] + tolerance:
            continue
        residuals = shifted - many[nearest(many, shifted)]
        if np.abs(residuals).max() <= tolerance:
            found.append(float(sign * (shift + np.median(residuals))))
            if len(found) == 2:
                break
    overlap = "hardly overlap" if shared > 0 else "do not overlap"
    if len(found) == 1:
        _log.warning(
            "frames and trajectory %s in time (%s): the only offset at which all times meet, "
            "%.6f s, is added to frame times",
            overlap,
            ranges,
            found[0],
        )
        return found[0]
    refuse_other_unit(frame_times, entries, senseless=True)
    why = "no offset makes all times meet"
    if found:
        why = f"several offsets fit, such as {found[0]:.6f} and {found[1]:.6f}"
    raise GsbaError(
        f"frames and trajectory {overlap} in time: {ranges}; {why}; correct the times or set "
        "read.clock_offset_s (seconds to add to frame times)"
    )


def poses_at(trajectory: Trajectory, times: np.ndarray) -> np.ndarray:
    """Poses (F, 4, 4) of a trajectory at any times (F,)."""
    from scipy.spatial.transform import Rotation, Slerp

    entries, world_T_rigs = trajectory.timestamps, trajectory.world_T_rigs
    inside = np.clip(times, entries[0], entries[-1])
    rotations = Slerp(entries, Rotation.from_matrix(world_T_rigs[:, :3, :3]))(inside)
    positions = np.stack(
        [np.interp(inside, entries, world_T_rigs[:, axis, 3]) for axis in range(3)], axis=1
    )
    # Beyond an end the velocity over half a second goes on and fades, with time constants chosen by
    # predicting real SLAM output of walks 0.1 to 4 s ahead: people keep walking but do not keep
    # turning.
    for end, direction in ((0, -1), (-1, 1)):
        beyond = direction * (times - entries[end]) > 0
        if not beyond.any():
            continue
        reach = np.abs(entries - entries[end])
        other = int(np.argmin(np.abs(reach - 0.5) + (reach == 0) * np.ptp(entries)))
        ahead = np.abs(times[beyond] - entries[end])[:, None]
        last = Rotation.from_matrix(world_T_rigs[end, :3, :3])
        turn = (Rotation.from_matrix(world_T_rigs[other, :3, :3]).inv() * last).as_rotvec()
        step = world_T_rigs[end, :3, 3] - world_T_rigs[other, :3, 3]
        turned = _faded_duration(ahead, 1.0) * turn / reach[other]
        rotations[beyond] = last * Rotation.from_rotvec(turned)
        moved = _faded_duration(ahead, 10.0) * step / reach[other]
        positions[beyond] = world_T_rigs[end, :3, 3] + moved
    return pose(rotations.as_matrix(), positions)


def _faded_duration(duration: np.ndarray, time_constant: float) -> np.ndarray:
    """Seconds at full speed that equal `duration` seconds of exponentially fading speed."""
    return -time_constant * np.expm1(-duration / time_constant)


def nearest(sorted_values: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """Index of the nearest of sorted values (N,), N >= 1, for each query (Q,)."""
    last = len(sorted_values) - 1
    right = np.minimum(np.clip(np.searchsorted(sorted_values, queries), 1, max(last, 1)), last)
    left = np.maximum(right - 1, 0)
    closer_left = queries - sorted_values[left] <= sorted_values[right] - queries
    return np.where(closer_left, left, right)


def _half_interval(times: np.ndarray, entries: np.ndarray) -> float:
    return 0.5 * float(min(np.median(np.diff(times)), np.median(np.diff(entries))))


def matched_in_time(
    estimate: Trajectory, truth: Trajectory, tolerance_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (M,) of estimate and (M,) of truth that are mutually nearest in time, in time order."""
    finite = np.flatnonzero(np.isfinite(estimate.world_T_rigs).all(axis=(1, 2)))
    times_e, times_t = estimate.timestamps[finite], truth.timestamps
    if len(times_e) == 0 or len(times_t) == 0:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    nearest_e, nearest_t = nearest(times_e, times_t), nearest(times_t, times_e)
    rows_t = np.arange(len(times_t))
    mutual = nearest_t[nearest_e] == rows_t
    rows_t = rows_t[mutual & (np.abs(times_e[nearest_e] - times_t) <= tolerance_s)]
    return finite[nearest_e[rows_t]], rows_t


def refuse_untimed(frames: FrameSet, trajectory: Trajectory) -> None:
    """Refuse poses at times beside frames that have none: these count as 0, 1, 2, ... seconds.

    Poses at whole seconds may be numbered likewise, as KITTI's.

    Raises:
        GsbaError: no frame has a time, and a pose is between whole seconds.
    """
    if not frames.timed_frames.any() and (trajectory.timestamps % 1 != 0).any():
        raise GsbaError(
            "the frames have no times to match true poses with: refine with --timestamps FILE or "
            "--fps F"
        )


def follow_keyframes(frames: Trajectory, keyframes: Trajectory) -> Trajectory:
    """Frame poses corrected by the keyframes around them.

    After a loop closure a SLAM corrects its keyframes, but not the frames between them. Each frame
    is moved with the keyframe before it and with the one after it by their relative motion in the
    frame trajectory, and is interpolated between both results in time; beyond the ends there is
    only one.

    Args:
        keyframes: K poses of the same run, in the same world and on the same clock.

    Returns:
        Poses at all times of both trajectories.

    Raises:
        GsbaError: fewer than two keyframes are frames of the trajectory.
    """
    nearest = np.searchsorted(frames.timestamps, keyframes.timestamps)
    nearest = np.clip(nearest, 1, len(frames.timestamps) - 1)
    gaps = np.abs(frames.timestamps[[nearest - 1, nearest]] - keyframes.timestamps)
    nearest = nearest - (gaps[0] < gaps[1])
    shared = gaps.min(axis=0) < 1e-3
    if shared.sum() < 2:
        raise GsbaError(
            f"only {shared.sum()} of {len(shared)} keyframes have the time of a frame of the "
            "trajectory: give both files of one run"
        )
    at, leading = nearest[shared], keyframes.world_T_rigs[shared]
    moves = leading @ inverse(frames.world_T_rigs[at])  # correction of the world at each keyframe
    after = np.searchsorted(at, np.arange(len(frames.timestamps)), side="right")
    before, after = np.clip(after - 1, 0, None), np.clip(after, 0, len(at) - 1)
    times = frames.timestamps
    span = np.maximum(times[at[after]] - times[at[before]], 1e-12)
    share = np.clip((times - times[at[before]]) / span, 0, 1)
    first, second = moves[before] @ frames.world_T_rigs, moves[after] @ frames.world_T_rigs
    # Poses (N, 4, 4) interpolated from the first to the second by shares (N,)
    from scipy.spatial.transform import Rotation

    turn = np.swapaxes(first[:, :3, :3], 1, 2) @ second[:, :3, :3]
    part = Rotation.from_rotvec(share[:, None] * Rotation.from_matrix(turn).as_rotvec())
    positions = (1 - share[:, None]) * first[:, :3, 3] + share[:, None] * second[:, :3, 3]
    followed = pose(first[:, :3, :3] @ part.as_matrix(), positions)
    times = np.concatenate([times, keyframes.timestamps[~shared]])
    poses = np.concatenate([followed, keyframes.world_T_rigs[~shared]])
    order = np.argsort(times)
    return Trajectory(times[order], poses[order])
