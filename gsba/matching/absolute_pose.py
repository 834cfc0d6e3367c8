"""Absolute poses from points of a map, by LO-RANSAC on three-point poses. pycolmap solves on rays:
bearings pass through the pixels of a virtual panorama."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gsba.camera.rig import witnesses
from gsba.camera.sphere import erp_from_bearings
from gsba.geometry import inverse, pose, rotation_angle
from gsba.significance import MAX_FALSE_POSES, least_agreeing
from gsba.trajectory.turning import CELLS_PER_SIDE

if TYPE_CHECKING:
    import pycolmap

_PANORAMA_WIDTH_PX = 4096  # of the virtual panorama
_MIN_TRIALS, _MAX_TRIALS = 100, 10_000
MIN_WITNESSES = 10  # fewer may be of one moving object
_APART = 0.3  # distance of another place, in median depths or radians


@dataclass(frozen=True, slots=True)
class FoundPose:
    """A pose that many candidates agree on."""

    world_T_rig: np.ndarray  # (4, 4) float64
    inliers: np.ndarray  # (m,) bool
    focal: float = 0.0  # pixels, if it was estimated

    def depth(self, points_world: np.ndarray) -> float:
        """Median distance of the inliers of its candidate points (m, 3)."""
        offsets = points_world[self.inliers] - self.world_T_rig[:3, 3]
        return float(np.median(np.linalg.norm(offsets, axis=1)))


def are_apart(one: np.ndarray, other: np.ndarray, depth: float) -> bool:
    """True if two poses (4, 4) are of different places, for points at a median depth."""
    moved = inverse(one) @ other
    turned = float(rotation_angle(moved[:3, :3]))
    return max(float(np.linalg.norm(moved[:3, 3])) / depth, turned) > _APART


def is_significant(
    bearings: np.ndarray,
    inliers: np.ndarray,
    chance: float,
    sample: int = 3,
    per_side: int = CELLS_PER_SIDE,
    least: int = MIN_WITNESSES,
) -> bool:
    """True if chance does not explain a pose's inliers, counted in independent witnesses.

    Args:
        bearings: (m, 3) of all candidates.
        inliers: (m,) bool.
        chance: probability that a false candidate agrees with an unrelated pose.
        sample: candidates whose pose it is; 0 = it was known without them.
        per_side: cells along a face's side, of 90 degrees: candidates within one are one witness.
        least: witnesses that are needed in any case.
    """
    if not inliers.any():
        return False
    num = witnesses(bearings, per_side)
    agreeing = witnesses(bearings[inliers], per_side)
    per_witness = 1 - (1 - min(chance, 0.5)) ** (len(bearings) / num)
    needed = least_agreeing(num, per_witness, sample, MAX_FALSE_POSES)
    return agreeing >= max(needed, least)


def panorama_pose(
    bearings: np.ndarray,
    points_world: np.ndarray,
    max_error_rad: float,
    seed: int,
    least: int,
    min_ratio: float = 0.0,
) -> FoundPose | None:
    """Pose of a panorama with the most inliers; None if no pose has enough.

    Args:
        bearings, points_world: (m, 3) unit, rig frame, and candidate point of each; many may be
            wrong.
        max_error_rad: of an inlier.
        least, min_ratio: number of inliers that is enough, and least ratio that the trials
            allow for.
    """
    import pycolmap

    size = _PANORAMA_WIDTH_PX, _PANORAMA_WIDTH_PX // 2
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=size[0], height=size[1], params=size)
    pixels = erp_from_bearings(bearings, *size)
    max_error_px = max_error_rad * _PANORAMA_WIDTH_PX / (2 * np.pi)
    return camera_pose(pixels, points_world, camera, max_error_px, seed, least, min_ratio)


def camera_pose(
    pixels: np.ndarray,
    points_world: np.ndarray,
    camera: "pycolmap.Camera",
    max_error_px: float,
    seed: int,
    least: int,
    min_ratio: float = 0.0,
    *,
    estimate_focal: bool = False,
) -> FoundPose | None:
    """As `panorama_pose`, of pixels (m, 2), corner origin, of a camera, whose first parameter is
    the focal length, estimated with the pose if `estimate_focal`."""
    import pycolmap

    if len(pixels) < least:
        return None
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = max_error_px
    options.ransac.min_num_trials, options.ransac.max_num_trials = _MIN_TRIALS, _MAX_TRIALS
    options.ransac.min_inlier_ratio = max(least / len(pixels), min_ratio)
    options.ransac.random_seed = seed
    options.estimate_focal_length = estimate_focal
    found = pycolmap.estimate_absolute_pose(pixels, points_world, camera, options)
    if found is None or found["num_inliers"] < least:
        return None
    matrix = found["cam_from_world"].matrix()
    world_T_rig = inverse(pose(matrix[:, :3], matrix[:, 3]))
    focal = float(found["camera"].params[0]) if "camera" in found else float(camera.params[0])
    return FoundPose(world_T_rig, np.asarray(found["inlier_mask"], bool), focal)
