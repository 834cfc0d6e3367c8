"""Pose of one frame from points of a map, and its acceptance."""

from dataclasses import dataclass

import numpy as np

from gsba.geometry import inverse
from gsba.matching.absolute_pose import panorama_pose
from gsba.trajectory.limits import TwoViewLimits

_MIN_SPREAD = 0.02  # least middle eigenvalue of the inliers' bearings: they must not form one
# narrow cone
_MIN_INLIERS = 25  # least number of inliers
_MIN_INLIER_RATIO = 0.2  # least inlier ratio of the candidates
_MIN_RIVAL_RATIO = 1.5  # ratio by which a pose must outweigh the best one at another place
RIVAL_DISTANCE = 0.3  # distance of another place, in median depths or radians


@dataclass(frozen=True, slots=True)
class RegisteredFrame:
    """Pose of one frame in a map."""

    world_T_rig: np.ndarray  # (4, 4) float64
    inliers: np.ndarray  # (m,) bool
    reason: str  # why it is rejected; "" = accepted


def resect(
    bearings: np.ndarray, points_world: np.ndarray, settings: TwoViewLimits, seed: int
) -> RegisteredFrame | None:
    """Absolute pose by unit bearings (m, 3), rig frame, of candidate points (m, 3), map units, many
    of which may be wrong, and its acceptance; None if no pose has enough inliers."""
    max_error = np.deg2rad(settings.max_error_deg)
    found = panorama_pose(bearings, points_world, max_error, seed, _MIN_INLIERS)
    if found is None:
        return None
    world_T_rig, inliers = found.world_T_rig, found.inliers
    offsets = points_world[inliers] - world_T_rig[:3, 3]
    depth = float(np.median(np.linalg.norm(offsets, axis=1)))
    reason = ""
    if inliers.mean() < _MIN_INLIER_RATIO:
        reason = "most candidates disagree"
    elif np.linalg.eigvalsh(bearings[inliers].T @ bearings[inliers])[1] / inliers.sum() < (
        _MIN_SPREAD
    ):
        reason = "all points lie one way"
    else:
        rest = np.flatnonzero(~inliers)
        others = bearings[rest], points_world[rest]
        rival = panorama_pose(*others, max_error, seed, _MIN_INLIERS)
        if rival is not None and inliers.sum() < _MIN_RIVAL_RATIO * rival.inliers.sum():
            moved = inverse(world_T_rig) @ rival.world_T_rig
            turned = np.linalg.norm(moved[:3, :3] - np.eye(3)) / np.sqrt(2)
            if max(np.linalg.norm(moved[:3, 3]) / depth, turned) > RIVAL_DISTANCE:
                reason = "another place explains it nearly as well"
    return RegisteredFrame(world_T_rig, inliers, reason)
