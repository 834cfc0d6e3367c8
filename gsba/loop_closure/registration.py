"""Pose of one frame from points of a map: three-point poses in LO-RANSAC, and what is believed.

pycolmap solves on rays: bearings pass through the pixels of a virtual panorama, so that a whole
sphere takes part and no face is special.
"""

from dataclasses import dataclass

import numpy as np

from gsba.camera.sphere import erp_from_bearings
from gsba.config import VerifySettings
from gsba.geometry import inverse, pose

_WIDTH = 4096  # of the virtual panorama
_MIN_SPREAD = 0.02  # middle eigenvalue of the inliers' bearings: not in one narrow cone
_LEAST = 25  # inliers
_MIN_SHARE = 0.2  # of the candidates
_RIVAL = 1.5  # by how much a pose must outweigh the next one that is elsewhere
_ELSEWHERE = 0.3  # part of the median distance, or radians


@dataclass(frozen=True, slots=True)
class Resection:
    """Pose of one frame in a map."""

    world_T_rig: np.ndarray  # (4, 4) float64
    inliers: np.ndarray  # (m,) bool
    reason: str  # why it is not believed; "" = it is


def resect(
    bearings: np.ndarray, points_world: np.ndarray, settings: VerifySettings, seed: int
) -> Resection | None:
    """Absolute pose from bearings of points, and whether to believe it.

    Args:
        bearings: (m, 3) unit, rig frame.
        points_world: (m, 3) the point each may show, map units; many may be wrong.
        settings: inlier threshold and count.
        seed: of the sampling.

    Returns:
        None where no pose has inliers enough.
    """
    found = _estimate(bearings, points_world, settings, seed)
    if found is None:
        return None
    world_T_rig, inliers = found
    offsets = points_world[inliers] - world_T_rig[:3, 3]
    depth = float(np.median(np.linalg.norm(offsets, axis=1)))
    reason = ""
    if inliers.mean() < _MIN_SHARE:
        reason = "most candidates disagree"
    elif np.linalg.eigvalsh(bearings[inliers].T @ bearings[inliers])[1] / inliers.sum() < (
        _MIN_SPREAD
    ):
        reason = "all points lie one way"
    else:
        rest = np.flatnonzero(~inliers)
        rival = _estimate(bearings[rest], points_world[rest], settings, seed)
        if rival is not None and inliers.sum() < _RIVAL * rival[1].sum():
            moved = inverse(world_T_rig) @ rival[0]
            turned = np.linalg.norm(moved[:3, :3] - np.eye(3)) / np.sqrt(2)
            if max(np.linalg.norm(moved[:3, 3]) / depth, turned) > _ELSEWHERE:
                reason = "another place explains it nearly as well"
    return Resection(world_T_rig, inliers, reason)


def _estimate(
    bearings: np.ndarray, points_world: np.ndarray, settings: VerifySettings, seed: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """World_T_rig (4, 4) and inliers (m,) by LO-RANSAC."""
    import pycolmap

    if len(bearings) < _LEAST:
        return None
    size = _WIDTH, _WIDTH // 2
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=size[0], height=size[1], params=size)
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = settings.max_error_deg * _WIDTH / 360
    options.ransac.min_num_trials, options.ransac.max_num_trials = 100, 10_000
    options.ransac.min_inlier_ratio = _LEAST / len(bearings)
    options.ransac.random_seed = seed
    pixels = erp_from_bearings(bearings, *size)
    found = pycolmap.estimate_absolute_pose(pixels, points_world, camera, options)
    if found is None or found["num_inliers"] < _LEAST:
        return None
    rig_T_world = found["cam_from_world"].matrix()
    rig_T_world = pose(rig_T_world[:, :3], rig_T_world[:, 3])
    return inverse(rig_T_world), np.asarray(found["inlier_mask"], bool)
