"""Pose of one frame from points of a map, and its acceptance."""

import numpy as np

from gsba.matching.absolute_pose import FoundPose, are_apart, panorama_pose
from gsba.trajectory.limits import TwoViewLimits

_MIN_INLIERS = 25  # least number of inliers


def resect(
    bearings: np.ndarray, points_world: np.ndarray, settings: TwoViewLimits, seed: int
) -> FoundPose | None:
    """Absolute pose by unit bearings (m, 3), rig frame, of candidate points (m, 3), map units, many
    of which may be wrong; None if no pose has enough inliers, if most candidates disagree, if all
    inliers lie one way, or if another place explains them nearly as well."""
    max_error = np.deg2rad(settings.max_error_deg)
    found = panorama_pose(bearings, points_world, max_error, seed, _MIN_INLIERS)
    if found is None or found.inliers.mean() < 0.2:
        return None
    # the middle eigenvalue of bearings in one narrow cone is less than .02
    seen, num = bearings[found.inliers], found.inliers.sum()
    if np.linalg.eigvalsh(seen.T @ seen)[1] / num < 0.02:
        return None
    others = bearings[~found.inliers], points_world[~found.inliers]
    rival = panorama_pose(*others, max_error, seed, _MIN_INLIERS)
    # a pose must outweigh the best one at another place by half
    if rival is None or num >= 1.5 * rival.inliers.sum():
        return found
    apart = are_apart(found.world_T_rig, rival.world_T_rig, found.depth(points_world))
    return None if apart else found
