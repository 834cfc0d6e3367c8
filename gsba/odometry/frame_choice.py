"""Selection of frames of a video for refinement: sharp, and close enough to one another."""

from dataclasses import dataclass

import numpy as np

from gsba.config import OdometrySettings
from gsba.geometry import rotation_angle
from gsba.odometry.walk import Odometry


def choose_frames(found: Odometry, settings: OdometrySettings) -> np.ndarray:
    """Rows (N,) of the frames to refine.

    From one frame to the next the camera moves by at most `step` times the median distance of the
    scene, and rotates by at most `max_turn_deg`, wherever the video has frames that close; the
    sharpest of the last part of each such stretch is selected. Frames without a pose are left out.
    """
    count = settings.max_frames
    steps = _Steps.of(found, settings.step, np.deg2rad(settings.max_turn_deg))
    rows = _chosen(found, steps, 1.0)
    if count is None or len(rows) <= count:
        return rows
    low, high = 1.0, 2.0
    while len(_chosen(found, steps, high)) > count:
        low, high = high, 2 * high
        if high > 1e6:  # more maps than frames are wanted
            return rows[np.linspace(0, len(rows) - 1, count).round().astype(int)]
    for _ in range(20):  # bisections of the interval of that factor
        middle = 0.5 * (low + high)
        if len(_chosen(found, steps, middle)) > count:
            low = middle
        else:
            high = middle
    return _chosen(found, steps, high)


@dataclass(frozen=True, slots=True)
class _Steps:
    """Distances between frames, in steps of the allowed length."""

    positions: np.ndarray  # (F, 3) float64, map units
    rotations: np.ndarray  # (F, 3, 3) float64
    allowed: np.ndarray  # (F,) float64, length of a step near each frame, map units
    max_turn: float  # radians

    @classmethod
    def of(cls, found: Odometry, step: float, max_turn: float) -> "_Steps":
        """Steps between frames; unknown distances of the scene are interpolated."""
        known = np.flatnonzero(np.isfinite(found.distances) & found.posed())
        distances = np.full(len(found), np.inf)
        if len(known):
            distances = np.interp(np.arange(len(found)), known, found.distances[known])
        poses = found.world_T_rigs
        return cls(poses[:, :3, 3], poses[:, :3, :3], step * distances, max_turn)

    def between(self, one: int, others: np.ndarray) -> np.ndarray:
        """Steps from one frame to others (N,)."""
        moved = np.linalg.norm(self.positions[others] - self.positions[one], axis=1)
        turned = rotation_angle(self.rotations[one].T @ self.rotations[others])
        shorter = np.minimum(self.allowed[others], self.allowed[one])
        return np.maximum(moved / shorter, turned / self.max_turn)


def _chosen(found: Odometry, steps: _Steps, longer: float) -> np.ndarray:
    """Rows of frames at most `longer` steps apart, including the first of each map."""
    out: list[int] = []
    posed = found.posed()
    for number in np.unique(found.maps[posed]):
        rows = np.flatnonzero(posed & (found.maps == number))
        here = 0
        while here is not None:
            out.append(int(rows[here]))
            here = _next(rows, here, steps, longer, found.sharpness)
    return np.array(out, np.int64)


def _next(
    rows: np.ndarray, here: int, steps: _Steps, longer: float, sharpness: np.ndarray
) -> int | None:
    """Index into `rows` of the frame to select after `rows[here]`; None = no new frame follows."""
    reach, end = 32, len(rows)
    while True:
        ahead = np.arange(here + 1, min(here + 1 + reach, end))
        away = steps.between(int(rows[here]), rows[ahead]) / longer
        beyond = np.flatnonzero(away > 1)
        if len(beyond) or ahead[-1:].tolist() in ([], [end - 1]):
            break
        reach *= 2
    if not len(ahead):
        return None
    stop = int(beyond[0]) if len(beyond) else len(ahead)
    fit = np.flatnonzero(away[:stop] >= 0.6)  # the sharpest of the last part of the step
    if len(fit):
        return int(ahead[fit[np.argmax(sharpness[rows[ahead[fit]]])]])
    if not len(beyond):
        return None
    return int(ahead[max(stop - 1, 0)])
