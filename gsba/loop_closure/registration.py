"""Pose of one frame from points of a map: three-point poses in LO-RANSAC, and their acceptance.

pycolmap solves on rays: bearings pass through the pixels of a virtual panorama, so that the whole
sphere contributes and no face is special.
"""

from dataclasses import dataclass

import numpy as np

from gsba.camera.sphere import erp_from_bearings
from gsba.config import VerifySettings
from gsba.geometry import inverse, pose

_PANORAMA_WIDTH_PX = 4096  # of the virtual panorama, pixels
_MIN_SPREAD = 0.02  # least middle eigenvalue of the inliers' bearings: they must not form one
# narrow cone
_MIN_INLIERS = 25  # least number of inliers
_MIN_INLIER_RATIO = 0.2  # least inlier ratio of the candidates
_MIN_RIVAL_RATIO = 1.5  # ratio by which a pose must outweigh the best one at another place
_RIVAL_DISTANCE = 0.3  # distance of another place, in median depths or radians


@dataclass(frozen=True, slots=True)
class Resection:
    """Pose of one frame in a map."""

    world_T_rig: np.ndarray  # (4, 4) float64
    inliers: np.ndarray  # (m,) bool
    reason: str  # why it is rejected; "" = accepted


def resect(
    bearings: np.ndarray, points_world: np.ndarray, settings: VerifySettings, seed: int
) -> Resection | None:
    """Absolute pose from bearings of points, and its acceptance.

    Args:
        bearings: (m, 3) unit, rig frame.
        points_world: (m, 3) candidate point of each bearing, map units; many may be wrong.
        settings: inlier threshold and count.
        seed: of the sampling.

    Returns:
        None if no pose has enough inliers.
    """
    found = _ransac_pose(bearings, points_world, settings, seed)
    if found is None:
        return None
    world_T_rig, inliers = found
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
        rival = _ransac_pose(bearings[rest], points_world[rest], settings, seed)
        if rival is not None and inliers.sum() < _MIN_RIVAL_RATIO * rival[1].sum():
            moved = inverse(world_T_rig) @ rival[0]
            turned = np.linalg.norm(moved[:3, :3] - np.eye(3)) / np.sqrt(2)
            if max(np.linalg.norm(moved[:3, 3]) / depth, turned) > _RIVAL_DISTANCE:
                reason = "another place explains it nearly as well"
    return Resection(world_T_rig, inliers, reason)


def _ransac_pose(
    bearings: np.ndarray, points_world: np.ndarray, settings: VerifySettings, seed: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """World_T_rig (4, 4) and inliers (m,) by LO-RANSAC."""
    import pycolmap

    if len(bearings) < _MIN_INLIERS:
        return None
    size = _PANORAMA_WIDTH_PX, _PANORAMA_WIDTH_PX // 2
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=size[0], height=size[1], params=size)
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = settings.max_error_deg * _PANORAMA_WIDTH_PX / 360
    options.ransac.min_num_trials, options.ransac.max_num_trials = 100, 10_000
    options.ransac.min_inlier_ratio = _MIN_INLIERS / len(bearings)
    options.ransac.random_seed = seed
    pixels = erp_from_bearings(bearings, *size)
    found = pycolmap.estimate_absolute_pose(pixels, points_world, camera, options)
    if found is None or found["num_inliers"] < _MIN_INLIERS:
        return None
    rig_T_world = found["cam_from_world"].matrix()
    rig_T_world = pose(rig_T_world[:, :3], rig_T_world[:, 3])
    return inverse(rig_T_world), np.asarray(found["inlier_mask"], bool)
