"""Search for a picture's pose among candidate points: LO-RANSAC, significance, and rivals."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gsba.camera.rig import witnesses
from gsba.camera.sphere import erp_from_bearings
from gsba.geometry import inverse, pose, rotation_angle
from gsba.significance import least_agreeing

if TYPE_CHECKING:
    import pycolmap

PANORAMA_WIDTH_PX = 4096  # of the virtual panorama in whose pixels bearings are given to the solver
_MAX_TRIALS = 10_000
_MIN_RATIO = 0.02  # least inlier ratio that the number of trials allows for
_CELLS_PER_SIDE = 16  # along a face's side: keypoints within one, 6 degrees, are one witness
_MAX_FALSE_ALARMS = 1e-6  # expected number of poses that chance explains as well as an accepted one
_MIN_WITNESSES = 10  # fewer may be of one moving object
_MIN_RIVAL_RATIO = 1.5  # ratio by which a pose must outweigh the best one at another place
_RIVAL_DISTANCE = 0.3  # distance of another place, in median depths or radians


@dataclass(frozen=True, slots=True)
class Candidates:
    """Keypoints of a picture, and the points of the map that each may show."""

    keypoints: np.ndarray  # (m,) int64, numbers of keypoints; one may have several points
    bearings: np.ndarray  # (m, 3) unit, rig frame
    points: np.ndarray  # (m,) int64, numbers of points
    points_world: np.ndarray  # (m, 3) map units

    def __len__(self) -> int:
        return len(self.points)

    def taken(self, rows: np.ndarray) -> "Candidates":
        """Candidates `rows`, int or bool."""
        return Candidates(
            self.keypoints[rows], self.bearings[rows], self.points[rows], self.points_world[rows]
        )


@dataclass(frozen=True, slots=True)
class FoundPose:
    """A pose that many candidates agree on."""

    world_T_rig: np.ndarray  # (4, 4) float64
    inliers: np.ndarray  # (m,) bool
    focal: float = 0.0  # pixels, if it was estimated


def search_pose(
    candidates: Candidates, max_error_rad: float, seed: int, least: int = _MIN_WITNESSES
) -> FoundPose | None:
    """Pose of a panorama with the most inliers; None if no pose has enough.

    Args:
        candidates: many may be false.
        max_error_rad: of an inlier.
        seed: of the sampling.
        least: number of inliers that is enough.
    """
    import pycolmap

    width, height = PANORAMA_WIDTH_PX, PANORAMA_WIDTH_PX // 2
    camera = pycolmap.Camera(
        model="EQUIRECTANGULAR", width=width, height=height, params=(width, height)
    )
    pixels = erp_from_bearings(candidates.bearings, width, height)
    max_error_px = max_error_rad * width / (2 * np.pi)
    return _ransac(pixels, candidates.points_world, camera, max_error_px, seed, least)


def search_focal(
    pixels: np.ndarray,
    points_world: np.ndarray,
    camera: "pycolmap.Camera",
    known: bool,
    max_error_px: float,
    seed: int,
    least: int = _MIN_WITNESSES,
) -> FoundPose | None:
    """Pose of a photo without distortion, and its focal length if that is not known.

    Args:
        pixels: (m, 2) keypoints, corner origin.
        points_world: (m, 3) candidate point of each.
        camera: SIMPLE_PINHOLE.
        known: whether its focal length is known.
        max_error_px: of an inlier.
        seed: of the sampling.
        least: number of inliers that is enough.
    """
    return _ransac(pixels, points_world, camera, max_error_px, seed, least, not known)


def _ransac(
    pixels: np.ndarray,
    points_world: np.ndarray,
    camera: "pycolmap.Camera",
    max_error_px: float,
    seed: int,
    least: int,
    estimate_focal: bool = False,
) -> FoundPose | None:
    import pycolmap

    if len(pixels) < least:
        return None
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = max_error_px
    options.ransac.min_num_trials, options.ransac.max_num_trials = 100, _MAX_TRIALS
    options.ransac.min_inlier_ratio = max(least / len(pixels), _MIN_RATIO)
    options.ransac.random_seed = seed
    options.estimate_focal_length = estimate_focal
    found = pycolmap.estimate_absolute_pose(pixels, points_world, camera, options)
    if found is None or found["num_inliers"] < least:
        return None
    matrix = found["cam_from_world"].matrix()
    world_T_rig = inverse(pose(matrix[:, :3], matrix[:, 3]))
    focal = float(found["camera"].params[0]) if "camera" in found else float(camera.params[0])
    return FoundPose(world_T_rig, np.asarray(found["inlier_mask"], bool), focal)


def is_significant(
    bearings: np.ndarray,
    inliers: np.ndarray,
    chance: float,
    sample: int = 3,
    per_side: int = _CELLS_PER_SIDE,
) -> bool:
    """True if chance does not explain a pose's inliers, counted in independent witnesses.

    Args:
        bearings: (m, 3) of all candidates.
        inliers: (m,) bool.
        chance: probability that a false candidate agrees with an unrelated pose.
        sample: candidates that determine a pose.
        per_side: cells along a face's side, of 90 degrees: candidates within one are one witness.
    """
    if not inliers.any():
        return False
    num = witnesses(bearings, per_side)
    agreeing = witnesses(bearings[inliers], per_side)
    per_witness = 1 - (1 - min(chance, 0.5)) ** (len(bearings) / num)
    needed = least_agreeing(num, per_witness, sample, _MAX_FALSE_ALARMS)
    return agreeing >= max(needed, _MIN_WITNESSES)


def least_of_rival(found: FoundPose) -> int:
    """Number of inliers from which another pose counts as a rival of one that was found."""
    return max(_MIN_WITNESSES, int(found.inliers.sum() / _MIN_RIVAL_RATIO))


def is_rivalled(found: FoundPose, rival: FoundPose | None, candidates: Candidates) -> bool:
    """True if the candidates that a pose leaves over agree about as well on another place.

    Args:
        found: of all candidates.
        rival: of those that it leaves over, with `least_of_rival` inliers.
        candidates: all of them.
    """
    if rival is None:
        return False
    offsets = candidates.points_world[found.inliers] - found.world_T_rig[:3, 3]
    depth = float(np.median(np.linalg.norm(offsets, axis=1)))
    moved = inverse(found.world_T_rig) @ rival.world_T_rig
    turned = float(rotation_angle(moved[:3, :3]))
    return max(float(np.linalg.norm(moved[:3, 3])) / depth, turned) > _RIVAL_DISTANCE
