"""Check of the truth: a mirrored world, another clock, or other axes look like errors of a run."""

import numpy as np

from gsba.evaluate.trajectory import pose_errors
from gsba.geometry import extent_of, nearest_rotation, rotation_angle
from gsba.similarity import NoSimilarityError, extents, is_mirrored, residuals_of, similarity
from gsba.types import Trajectory, rows_across

_MIN_OVERLAP = 0.9  # of the estimate with the truth, by another clock
_MIN_GAIN = 3.0  # by which another clock reduces errors
_MAX_SHARE = 0.005  # of the truth's extent: largest error with another clock
_MIN_TURN_DEG = 30.0  # from orientations to positions, between worlds
_MAX_ERROR_SHARE = 0.1  # of the path's second extent: positions then determine that turn


def fault_of_truth(estimate: Trajectory, truth: Trajectory) -> str:
    """Sentence on why the truth does not fit an estimate that may be right; "" = it may.

    Raises:
        GsbaError: see `pose_errors`.
    """
    errors = pose_errors(estimate, truth)
    poses, true_poses = estimate.world_T_rigs[errors.rows], truth.world_T_rigs[errors.true_rows]
    positions, targets = poses[:, :3, 3], true_poses[:, :3, 3]
    if is_mirrored(positions, targets):
        return (
            "the truth is mirrored: a mirror image of its positions fits at least twice as well; "
            "reverse or swap one of its axes"
        )
    error = float(np.sqrt(np.mean(errors.positions**2)))
    large = error > _MAX_SHARE * extent_of(targets)
    if large and (shift := _clock_shift(estimate, truth)):
        return (
            f"the truth's clock is {abs(shift):.3g} s {'ahead' if shift > 0 else 'behind'}: with "
            f"{-shift:+.3g} s added to its times, positions fit three times as well"
        )
    across = extents(targets)[1] * extent_of(targets)
    if error < _MAX_ERROR_SHARE * across:
        between = np.einsum("nij,nkj->ik", true_poses[:, :3, :3], poses[:, :3, :3])
        turn = nearest_rotation(between).T @ errors.fit.rotation
        if (degrees := float(np.degrees(rotation_angle(turn)))) > _MIN_TURN_DEG:
            return (
                f"the truth's orientations contradict its positions by {degrees:.0f} degrees: its "
                "cameras have other axes than x right, y down, z forward, or its world is "
                "mirrored: errors of rotations say nothing"
            )
    return ""


def _clock_shift(estimate: Trajectory, truth: Trajectory) -> float:
    """Seconds by which the truth's clock is ahead; 0.0 = none fits clearly better than its own."""
    known = np.flatnonzero(np.isfinite(estimate.world_T_rigs).all(axis=(1, 2)))
    step = float(np.median(np.diff(estimate.timestamps[known])))
    known = known[rows_across(len(known), 200)]  # enough to try clocks on
    times, positions = estimate.timestamps[known], estimate.world_T_rigs[known, :3, 3]
    limit, found = _MAX_SHARE * extent_of(truth.world_T_rigs[:, :3, 3]), 0.0
    first, last = truth.timestamps[[0, -1]]
    margin = (1 - _MIN_OVERLAP) * (times[-1] - times[0])
    ends = np.array([first - times[0] - margin, last - times[-1] + margin]) / (step / 2)
    for shift in np.arange(np.floor(ends[0]), np.ceil(ends[1]) + 1) * step / 2:
        both = np.array([times, times + shift])
        inside = ((both >= first) & (both <= last)).all(axis=0)
        if inside.sum() < max(4, _MIN_OVERLAP * len(times)):
            continue
        own, shifted = (_misfit(positions[inside], truth, some[inside]) for some in both)
        if shifted < min(limit, own / _MIN_GAIN):
            limit, found = shifted, float(shift)
    return found


def _misfit(positions: np.ndarray, truth: Trajectory, times: np.ndarray) -> float:
    """RMS error of positions (N, 3) against the truth's at these times (N,); inf if none fit."""
    columns = truth.world_T_rigs[:, :3, 3].T
    targets = np.column_stack([np.interp(times, truth.timestamps, column) for column in columns])
    try:
        off = residuals_of(similarity(positions, targets), positions, targets)
    except NoSimilarityError:
        return float("inf")
    return float(np.sqrt(np.mean(off**2)))
