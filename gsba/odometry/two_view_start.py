"""Initialisation of a map from two frames between which the camera certainly moved."""

from dataclasses import dataclass

import numpy as np

from gsba.camera.rig import witnesses
from gsba.config import TwoViewLimits
from gsba.geometry import angles_between, nearest_rotation
from gsba.matching.verification import relative_pose
from gsba.odometry.window import AdjustedWindow, WindowObservations, adjust_window

_REFITS = 6  # refits of a rotation without the features that are furthest off
_MOVED, _MOVED_LITTLE = np.deg2rad([4.0, 1.2])  # parallax of the upper quarter of the features from
# which initialisation is tried; the latter while features are being lost
_MAX_DIRECTION_SIGMA = np.deg2rad(6.0)  # largest standard deviation of the translation's direction
_MIN_POINTS = 40  # least number of independent points, in cells of 6 degrees
_CELLS = 16
_VERIFY = TwoViewLimits(max_error_deg=0.3)
_GATE = 4.0  # standard deviations


@dataclass(frozen=True, slots=True)
class StartTurn:
    """The rotation that explains most features of two frames, and residuals."""

    one_R_other: np.ndarray  # (3, 3) float64
    parallaxes: np.ndarray  # (N,) float64, radians, residual of each feature under the rotation


def median_turn(one: np.ndarray, other: np.ndarray) -> StartTurn:
    """The rotation that maps most bearings (N, 3) of the other frame onto those of the first."""
    near, rotation = np.ones(len(one), bool), np.eye(3)
    off = np.zeros(len(one))
    for _ in range(_REFITS if len(one) >= 3 else 0):
        rotation = nearest_rotation(one[near].T @ other[near])
        off = angles_between(one, other @ rotation.T)
        near = off <= np.median(off)
    return StartTurn(rotation, off)


def start_map(
    ids: np.ndarray,
    one: np.ndarray,
    other: np.ndarray,
    turn: StartTurn,
    sigma: float,
    seed: int,
    fading: bool,
) -> AdjustedWindow | None:
    """Poses of two frames and their points; None if the camera may have rotated only.

    The first pose is the identity; the median distance of points from it is 1.

    Args:
        ids: (N,) features.
        one, other: (N, 3) their bearings in the two frames.
        turn: rotation of the bearings.
        sigma: radians, noise of bearings per axis.
        fading: True if features are being lost; then little parallax suffices.
    """
    moved = _MOVED_LITTLE if fading else _MOVED
    if len(ids) < _MIN_POINTS or np.quantile(turn.parallaxes, 0.75) < moved:
        return None
    found = relative_pose(one, other, _VERIFY, seed)
    if found is None or found.direction_sigma > _MAX_DIRECTION_SIGMA:
        return None
    poses = np.stack([np.eye(4), found.f0_T_f1])
    good = found.inliers
    seen = WindowObservations.of([(ids[good], one[good]), (ids[good], other[good])])
    solved = adjust_window(poses, 1, seen, sigma, _GATE)
    distances = np.linalg.norm(solved.points_world, axis=1)
    if len(distances) < _MIN_POINTS:
        return None
    if witnesses(solved.points_world / distances[:, None], _CELLS) < _MIN_POINTS:
        return None
    scale = 1 / float(np.median(distances))
    poses = solved.world_T_rigs.copy()
    poses[:, :3, 3] *= scale
    return AdjustedWindow(poses, solved.ids, solved.points_world * scale, solved.outliers)
