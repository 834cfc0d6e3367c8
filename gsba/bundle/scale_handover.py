"""Transfer of the scale from each frame to the next, by points seen from both sides of a step.

Both sides triangulate such a point by themselves. Covariances do not tell of few points that err
together: the scatter of distances does.
"""

from collections.abc import Iterator

import numpy as np

from gsba.geometry import moved_to
from gsba.types import Reconstruction

_REACH = 6.0  # usual steps that a side is long, and its fewest frames are two
_STANDING_RATIO = 0.1  # of the rms step: shorter ones are of a camera that stands
_MIN_POINTS = 8  # that both sides see
_SIGMAS = 2.0  # standard errors of the median that count as uncertainty


def scale_changes(result: Reconstruction, recordings: np.ndarray) -> np.ndarray:
    """Largest relative change (F - 1,) of scale that may hide at each step: the median difference
    of distances by both sides, and two standard errors of it by their scatter. inf = too few points
    are seen by both sides; NaN = a side has one frame, of recordings (F,)."""
    found = np.full(max(len(result.world_T_rigs) - 1, 0), np.nan)
    observed = result.observations_by_frame()
    for step, first, end in _sides(result.world_T_rigs[:, :3, 3], recordings):
        before = np.concatenate(observed[first : step + 1])
        behind = np.concatenate(observed[step + 1 : end])
        middle = result.world_T_rigs[step : step + 2, :3, 3].mean(axis=0)
        found[step] = _change(result, before, behind, middle)
    return found


def _sides(positions: np.ndarray, recordings: np.ndarray) -> Iterator[tuple[int, int, int]]:
    """Steps with two frames and more on both sides: step, first before, end behind."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    walked = steps[steps > _STANDING_RATIO * np.sqrt(np.mean(steps**2))] if len(steps) else steps
    if not len(walked):
        return
    along = np.concatenate([[0.0], np.cumsum(steps)])
    reach = _REACH * float(np.median(walked)) * (1 + 1e-9)
    for step in range(len(steps)):
        own = np.flatnonzero(recordings == recordings[step])
        first = max(int(np.searchsorted(along, along[step] - reach)), int(own[0]))
        end = min(
            int(np.searchsorted(along, along[step + 1] + reach, side="right")), int(own[-1]) + 1
        )
        if recordings[step] == recordings[step + 1] and step - first >= 1 and end - step >= 3:
            yield step, first, end


def _change(
    result: Reconstruction, before: np.ndarray, behind: np.ndarray, middle: np.ndarray
) -> float:
    """Change of scale that may hide between two sides' observations; distances from `middle`."""
    several = []
    for rows in (before, behind):
        names, counts = np.unique(result.observation_points[rows], return_counts=True)
        several.append(names[counts > 1])
    common = np.intersect1d(*several, assume_unique=True)
    if len(common) < _MIN_POINTS:
        return np.inf
    ends, spreads = zip(
        *(_triangulated(result, rows, common) for rows in (before, behind)), strict=True
    )
    mean = (ends[0] + ends[1]) / 2 - middle
    lengths = np.maximum(np.linalg.norm(mean, axis=1), 1e-12)
    towards = mean / lengths[:, None]
    distances = [np.einsum("ni,ni->n", end - middle, towards) for end in ends]
    known = np.ones(len(common), bool)
    for distance, spread in zip(distances, spreads, strict=True):
        variances = np.einsum("ni,nij,nj->n", towards, spread, towards)
        known &= (distance > 0) & (variances < (0.1 * lengths) ** 2)
    if np.count_nonzero(known) < _MIN_POINTS:
        return np.inf
    logs = np.log(distances[1][known] / distances[0][known])
    median = float(np.median(logs))
    # standard deviation of normal values
    scatter = 1.4826 * float(np.median(np.abs(logs - median)))
    # 1.2533: standard error of a median of normal values, over that of their mean
    return abs(median) + _SIGMAS * 1.2533 * scatter / np.sqrt(len(logs))


def _triangulated(
    result: Reconstruction, rows: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Places (N, 3) of points (N,) by some observations alone, and covariances; NaN if parallel."""
    index = np.searchsorted(points, result.observation_points[rows])
    index[index == len(points)] = 0
    own = points[index] == result.observation_points[rows]
    rows, index = rows[own], index[own]
    frames, origins = result.world_T_rigs[result.observation_frames[rows]], None
    if result.observation_origins is not None:
        origins = result.observation_origins[rows]
    placed = moved_to(frames, origins)[:, :3, 3]
    rays = np.einsum("oij,oj->oi", frames[:, :3, :3], result.observation_bearings[rows])
    depths = np.linalg.norm(result.points_world[points[index]] - placed, axis=1)
    weights = 1 / (np.maximum(depths, 1e-12) * result.observation_sigmas[rows]) ** 2
    across = (np.eye(3) - rays[:, :, None] * rays[:, None, :]) * weights[:, None, None]
    columns = np.hstack([across.reshape(-1, 9), np.einsum("oij,oj->oi", across, placed)])
    sums = np.stack([np.bincount(index, column, len(points)) for column in columns.T], axis=1)
    systems = sums[:, :9].reshape(-1, 3, 3)
    lowest, _, highest = np.linalg.eigvalsh(systems).T
    parallel = lowest <= 1e-9 * highest
    systems[parallel] = np.eye(3)
    covariances = np.linalg.inv(systems)
    places = np.einsum("nij,nj->ni", covariances, sums[:, 9:])
    covariances[parallel] = np.nan
    return places, covariances
