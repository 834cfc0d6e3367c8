"""Noise of observations, in units of their own sigmas, by what their points leave of residuals."""

import numpy as np

from factors.threads import balanced_ranges, run_in_threads
from gsba.bundle._noise_kernels import standardized_residuals
from gsba.types import Keypoints, Landmarks

_MIN_REDUNDANCY = 0.1  # least share of residual dimensions beyond the unknowns


def observation_noise(
    landmarks: Landmarks,
    keypoints: Keypoints,
    world_T_rigs: np.ndarray,
    num_threads: int,
    chosen: np.ndarray | slice = slice(None),
) -> float:
    """Noise in units of the features' sigmas: robust spread of residuals over its expectation.

    The points are placed by least squares: under the robust loss of the adjustment they would lie
    closer to most of their observations than the noise allows. A residual e of noise sigma has the
    covariance sigma^2 (I - J (sum J^T J)^-1 J^T), J that of the observation by its point: nothing
    of it is left along the epipolar line where a point has two observations, nearly all where it
    has many. So each residual is taken along the direction in which the point leaves the most of
    it, over the square root of that eigenvalue: all observations then spread alike.

    Args:
        landmarks: points and their observations, O of them.
        keypoints: of all frames.
        world_T_rigs: (F, 4, 4) poses.
        num_threads: that share the points; the result does not depend on them.
        chosen: (O,) bool, observations whose spread is asked for.
    """
    tracks, num = landmarks.tracks, len(landmarks.tracks)
    starts = np.searchsorted(tracks.points, np.arange(tracks.num_points + 1))
    rows, spread = keypoints.rows(tracks), np.empty(num)
    origins = np.zeros((0, 3)) if keypoints.origins_rig is None else keypoints.origins_rig[rows]
    seen = keypoints.bearings_rig[rows], np.ascontiguousarray(keypoints.roots(rows)), origins
    ranges, poses = balanced_ranges(starts), np.ascontiguousarray(world_T_rigs)

    def work(part: int) -> None:
        standardized_residuals(
            *ranges[part], starts, landmarks.points_world, tracks.frames, poses, *seen, spread
        )

    run_in_threads(work, len(ranges), num_threads)
    unknowns = 6 * len(world_T_rigs)
    redundancy = max(1 - unknowns / max(2 * num - 3 * tracks.num_points, 1), _MIN_REDUNDANCY)
    return float(1.4826 * np.median(np.abs(spread[chosen])) / np.sqrt(redundancy))
