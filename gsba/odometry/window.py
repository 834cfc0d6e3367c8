"""Bundle adjustment of the last keyframes, with those before them fixed."""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from factors import BearingTerm, LandmarkBlock, RobustLoss
from gsba.bundle import optimize, pose_variables, triangulate
from gsba.bundle.adjustment import poses_of, values_of
from gsba.bundle.optimizer import SolverOptions
from gsba.camera.rig import witnesses
from gsba.geometry import angles_between, extent_of, nearest_rotation
from gsba.matching.verification import relative_pose
from gsba.trajectory.limits import TwoViewLimits
from gsba.types import Landmarks, Tracks

_SOLVER = SolverOptions(
    max_iterations=8, relative_tolerance=1e-3, absolute_tolerance=1.0, lambda_initial=1e-6
)
_MIN_PARALLAX_DEG = 1.0  # least triangulation angle of a point: keyframes are far apart
GATE = 4.0  # largest residual of a feature that fits, standard deviations
_HELD = 1e-6  # standard deviation of fixed poses: radians, and parts of their extent


@dataclass(frozen=True, slots=True)
class WindowObservations:
    """Observations of features in the keyframes of a window."""

    frames: np.ndarray  # (O,) int32, row of the keyframe in the window
    ids: np.ndarray  # (O,) int64, feature
    bearings_rig: np.ndarray  # (O, 3) float64, unit, rig frame

    @classmethod
    def of(cls, keyframes: Sequence[tuple[np.ndarray, np.ndarray]]) -> "WindowObservations":
        """Observations from ids (n,) and bearings (n, 3) of each keyframe."""
        frames = np.repeat(np.arange(len(keyframes)), [len(ids) for ids, _ in keyframes])
        ids = np.concatenate([ids for ids, _ in keyframes])
        bearings = np.concatenate([bearings for _, bearings in keyframes])
        order = np.lexsort((frames, ids))
        return cls(frames[order].astype(np.int32), ids[order], bearings[order])

    def tracks(self) -> Tracks:
        """One track a feature; its keypoints are rows of these observations."""
        found, points = np.unique(self.ids, return_inverse=True)
        rows = np.arange(len(self.ids), dtype=np.int32)
        return Tracks(points.astype(np.int32), self.frames, rows, len(found))

    def features_of(self, landmarks: Landmarks) -> np.ndarray:
        """Features (J,) of points triangulated from `tracks`."""
        first = np.unique(landmarks.tracks.points, return_index=True)[1]
        return self.ids[landmarks.tracks.keypoints[first]]


@dataclass(frozen=True, slots=True)
class AdjustedWindow:
    """Poses and points after adjustment."""

    world_T_rigs: np.ndarray  # (K, 4, 4) float64
    ids: np.ndarray  # (J,) int64, feature of each point
    points_world: np.ndarray  # (J, 3) float64
    outliers: np.ndarray  # (N, 2) int64, keyframe and feature of outlier observations


def adjust_window(
    world_T_rigs: np.ndarray, num_held: int, seen: WindowObservations, sigma: float
) -> AdjustedWindow:
    """Triangulate all features of a window again, and adjust its poses (K, 4, 4) and points.

    Args:
        num_held: number of first keyframes that are fixed. With one, its distance to the
            furthest keyframe is fixed besides, as the scale is free otherwise.
        sigma: radians, noise of bearings per axis.
    """
    tracks, sigmas = seen.tracks(), np.full(len(seen.ids), sigma)

    def place(poses: np.ndarray, limit: float):
        rays = seen.bearings_rig
        return triangulate(tracks, rays, sigmas, poses, limit, min_parallax_deg=_MIN_PARALLAX_DEG)

    marks = place(world_T_rigs, 2 * GATE)
    used = marks.tracks.keypoints
    term = BearingTerm(
        marks.tracks.frames, marks.tracks.points, seen.bearings_rig[used], sigmas[used], None
    )
    keys = [pose_variables.X(k) for k in range(len(world_T_rigs))]
    block = LandmarkBlock(keys, marks.points_world, [term], RobustLoss("cauchy", 2.0), 1)
    extent = max(extent_of(world_T_rigs[:, :3, 3]), 1e-9)
    noise = pose_variables.pose_noise(_HELD, _HELD * extent)
    graph = gtsam.NonlinearFactorGraph()
    for k in range(num_held):
        pose = gtsam.Pose3(world_T_rigs[k])
        graph.add(gtsam.PriorFactorPose3(pose_variables.X(k), pose, noise))
    if num_held == 1:
        graph.push_back(pose_variables.fixed_scale(world_T_rigs))
    poses = poses_of(optimize(graph, values_of(world_T_rigs), [block], _SOLVER).values, len(keys))
    marks = place(poses, GATE)
    kept = np.zeros(len(seen.ids), bool)
    kept[marks.tracks.keypoints] = True
    ids = seen.features_of(marks)
    false = ~kept & np.isin(seen.ids, ids)
    outliers = np.stack([seen.frames[false], seen.ids[false]], axis=1)
    return AdjustedWindow(poses, ids, marks.points_world, outliers)


_MOVED, _MOVED_LITTLE = np.deg2rad([4.0, 1.2])  # parallax of the upper quarter of the features from
# which initialisation is tried; the latter while features are being lost
_MIN_POINTS = 40  # least number of independent points, in cells of 6 degrees
_VERIFY = TwoViewLimits(max_error_deg=0.3)


def median_turn(one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) that maps most bearings (N, 3) of the other frame onto those of the first,
    and parallaxes (N,) rad, the residual of each feature under it."""
    near, rotation = np.ones(len(one), bool), np.eye(3)
    off = np.zeros(len(one))
    for _ in range(6 if len(one) >= 3 else 0):  # without the features that are furthest off
        rotation = nearest_rotation(one[near].T @ other[near])
        off = angles_between(one, other @ rotation.T)
        near = off <= np.median(off)
    return rotation, off


def start_map(
    ids: np.ndarray,
    one: np.ndarray,
    other: np.ndarray,
    parallaxes: np.ndarray,
    sigma: float,
    seed: int,
    fading: bool,
) -> AdjustedWindow | None:
    """Poses of two frames and points of features (N,), whose bearings are (N, 3) in either frame;
    None if the camera may have rotated only. The first pose is the identity; the median distance of
    points from it is 1. fading: features are being lost; then little parallax suffices."""
    moved = _MOVED_LITTLE if fading else _MOVED
    if len(ids) < _MIN_POINTS or np.quantile(parallaxes, 0.75) < moved:
        return None
    found = relative_pose(one, other, _VERIFY, seed)
    if found is None or found.direction_sigma > np.deg2rad(6.0):
        return None
    poses = np.stack([np.eye(4), found.f0_T_f1])
    good = found.inliers
    seen = WindowObservations.of([(ids[good], one[good]), (ids[good], other[good])])
    solved = adjust_window(poses, 1, seen, sigma)
    distances = np.linalg.norm(solved.points_world, axis=1)
    if len(distances) < _MIN_POINTS:
        return None
    if witnesses(solved.points_world / distances[:, None], 16) < _MIN_POINTS:
        return None
    scale = 1 / float(np.median(distances))
    poses = solved.world_T_rigs.copy()
    poses[:, :3, 3] *= scale
    return AdjustedWindow(poses, solved.ids, solved.points_world * scale, solved.outliers)
