"""Noise of observations, in units of their own sigmas, by what their points leave of residuals."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsba.bundle._noise_kernels import standardized_residuals
from gsba.bundle.tracks import map_runs
from gsba.disk import concatenated
from gsba.memory import release_mapped_files
from gsba.types import Keypoints, Landmarks, Tracks
from gsba.types.records import slices

_AT_ONCE = 1 << 18  # keypoints whose noise is scaled together: 17 MB
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
        world_T_rigs: (F, 4, 4) poses.
        num_threads: that share the points; the result does not depend on them.
        chosen: (O,) bool, observations whose spread is asked for.
    """
    tracks, num = landmarks.tracks, len(landmarks.tracks)
    spread, poses = np.empty(num), np.ascontiguousarray(world_T_rigs)

    def work(points: slice, rows: slice, some: Tracks) -> None:
        spread[rows] = _residuals(landmarks.points_world[points], some, keypoints, poses)

    for _ in map_runs(work, tracks, num_threads):
        pass
    unknowns = 6 * len(world_T_rigs)
    redundancy = max(1 - unknowns / max(2 * num - 3 * tracks.num_points, 1), _MIN_REDUNDANCY)
    kept = spread[chosen]
    np.abs(kept, out=kept)
    return float(1.4826 * np.median(kept, overwrite_input=True) / np.sqrt(redundancy))


def _residuals(
    points_world: np.ndarray,
    tracks: Tracks,
    keypoints: Keypoints,
    world_T_rigs: np.ndarray,
) -> np.ndarray:
    """Residuals (O,) of the observations of points (J, 3), all of the same spread."""
    starts = np.searchsorted(tracks.points, np.arange(tracks.num_points + 1))
    rows, spread = keypoints.rows(tracks), np.empty(len(tracks))
    origins = keypoints.origins_of(rows)
    origins = np.zeros((0, 3)) if origins is None else origins
    bearings = keypoints.bearings_rig.take(rows, axis=0)
    seen = bearings, np.ascontiguousarray(keypoints.roots(rows)), origins
    standardized_residuals(
        0, tracks.num_points, starts, points_world, tracks.frames, world_T_rigs, *seen, spread
    )
    return spread


def with_scaled_noise(
    keypoints: Keypoints, factors: np.ndarray, folder: Path | None = None
) -> Keypoints:
    """As `Keypoints.scaled_noise` by factors (N,), of keypoints that may be very many.

    Args:
        folder: on the disk that takes the noise; None = it is in memory.
    """
    if folder is None:
        return keypoints.scaled_noise(factors)
    infos = keypoints.sqrt_infos

    def scaled() -> Iterator[tuple[np.ndarray, ...]]:
        for some in slices(len(factors), _AT_ONCE):
            sigmas = keypoints.sigmas_rad[some] * factors[some]
            yield sigmas, *([] if infos is None else [infos[some] / factors[some, None, None]])
            release_mapped_files()

    sigmas, *roots = concatenated(scaled(), folder)
    return replace(keypoints, sigmas_rad=sigmas, sqrt_infos=roots[0] if roots else None)
