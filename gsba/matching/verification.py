"""Two-view verification on bearings: a pose is accepted if chance does not explain its inliers, no
other pose explains as many of the other matches, and the trajectory does not contradict it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsba.camera.rig import witnesses
from gsba.geometry import inverse, pose, rotation_angle
from gsba.significance import least_agreeing, outweighs
from gsba.store.shards import ITEMS, Workers, even_blocks
from gsba.trajectory.limits import TwoViewLimits
from gsba.trajectory.turning import CELLS_PER_SIDE, rotation_of_most
from gsba.types import Counts, Keypoints, Matches, VerifiedPairs

_SAMPLE_SIZE = 5  # size of a minimal sample
_MODEL_SIGMA_RAD = np.deg2rad(0.15)  # noise of bearings assumed to have one centre: lenses are
# centimetres apart
_CHI_SQUARE_MEDIANS = 1.3863, 0.4549  # medians of chi-square distributions with two and with one
# degree of freedom


@dataclass(frozen=True, slots=True)
class RelativePose:
    """Relative pose of two frames, estimated from their matches."""

    f0_T_f1: np.ndarray  # (4, 4) float64, translation of unit length
    inliers: np.ndarray  # (m,) bool
    direction_sigma: float  # radians, of the translation's direction; infinite = the camera may
    # have turned only
    rivalled: bool  # True if another pose explains about as many of the other matches


def agree_with_prior(
    matches: Matches,
    estimates: Sequence[RelativePose | None],
    prior_f0_T_f1s: np.ndarray | None,
    position_sigmas: np.ndarray | None,
    settings: TwoViewLimits,
) -> VerifiedPairs:
    """Keep pairs that have one relative pose, which agrees with the prior: poses (P, 4, 4) of the
    trajectory, whose position sigmas (P,), map units, set the tolerance of the direction; None = no
    prior."""
    kept, kept_poses = [], []
    dropped: dict[str, int] = {
        "too few matches": 0,
        "two poses fit": 0,
        "rotation contradicts": 0,
        "direction contradicts": 0,
    }
    for p, found in enumerate(estimates):
        if found is None:
            reason = "too few matches"
        elif found.rivalled:
            reason = "two poses fit"
        elif prior_f0_T_f1s is None or position_sigmas is None:
            reason = ""
        else:
            reason = _why_prior_contradicts(found, prior_f0_T_f1s[p], position_sigmas[p], settings)
        if found is None or reason:
            dropped[reason] += 1
        else:
            kept.append(p)
            kept_poses.append(found)
    rows = [matches.of(p)[found.inliers] for p, found in zip(kept, kept_poses, strict=True)]
    return VerifiedPairs(
        Matches.of_rows(matches.pairs[kept], rows),
        np.array([found.f0_T_f1 for found in kept_poses]).reshape(-1, 4, 4),
        np.array([found.direction_sigma for found in kept_poses], np.float64),
        Counts(len(matches.pairs), len(kept), "pairs", dropped),
    )


def _why_prior_contradicts(
    found: RelativePose, prior: np.ndarray, position_sigma: float, settings: TwoViewLimits
) -> str:
    """Reason why a pose does not fit a prior (4, 4) of `position_sigma`; "" = it fits."""
    turn = rotation_angle(prior[:3, :3].T @ found.f0_T_f1[:3, :3])
    if turn > np.deg2rad(settings.max_rotation_deg):
        return "rotation contradicts"
    direction, length = found.f0_T_f1[:3, 3], float(np.linalg.norm(prior[:3, 3]))
    if length <= 3 * position_sigma or np.isinf(found.direction_sigma):
        return ""  # the prior or the images leave the direction open
    allowed = np.deg2rad(settings.max_direction_deg) + 3 * found.direction_sigma
    allowed += np.arcsin(3 * position_sigma / length)
    angle = np.arctan2(np.linalg.norm(np.cross(prior[:3, 3], direction)), prior[:3, 3] @ direction)
    return "" if angle < allowed else "direction contradicts"


def estimate_relative_poses(
    matches: Matches,
    keypoints: Keypoints,
    settings: TwoViewLimits,
    seed: int,
    workers: Workers,
    chances: np.ndarray,
    rivals: bool = False,
) -> list[RelativePose | None]:
    """`relative_pose` of every pair by LO-RANSAC, without any prior; rival poses are searched too
    if `rivals`. chances: (P,) probability that a false match that passed the gate agrees with a
    pose near the predicted one; 0 = nothing was predicted."""

    def rays(p: int) -> tuple[np.ndarray, np.ndarray]:
        return keypoints.matched(matches.pairs[p], matches.of(p))

    job = _PoseJob(len(matches.pairs), rays, settings, seed, chances, rivals)
    return list(workers.map_shards(job))


@dataclass(frozen=True, slots=True)
class _PoseJob:
    """The job of estimating relative poses."""

    num: int
    rays: Callable[[int], tuple[np.ndarray, np.ndarray]]  # of a pair, (m, 3) in either frame's axes
    settings: TwoViewLimits
    seed: int
    chances: np.ndarray
    rivals: bool
    title: str = "verifying"
    returns: Any = RelativePose | None

    def __len__(self) -> int:
        return self.num

    def __call__(self, p: int) -> RelativePose | None:
        chance = float(self.chances[p])
        return relative_pose(*self.rays(p), self.settings, self.seed, chance, self.rivals)

    def blocks(self) -> Sequence[tuple[int, int]]:
        return even_blocks(self.num, ITEMS)

    def part(self, start: int, stop: int) -> "_PoseJob":
        rays = [self.rays(p) for p in range(start, stop)]
        return replace(self, num=len(rays), rays=rays.__getitem__, chances=self.chances[start:stop])


def relative_pose(
    bearings0: np.ndarray,
    bearings1: np.ndarray,
    settings: TwoViewLimits,
    seed: int,
    chance: float = 0.0,
    rivals: bool = False,
) -> RelativePose | None:
    """The relative pose with the most inliers, or None if chance explains as many, of unit rays (m,
    3) of the matches in each frame; chance, rivals: see `estimate_relative_poses`."""
    found = _significant_pose(bearings0, bearings1, settings, seed, chance)
    if found is None:
        return None
    f0_T_f1, inliers = found
    sigma = _direction_sigma(f0_T_f1, bearings0[inliers], bearings1[inliers])
    rivalled = rivals and _is_rivalled(f0_T_f1, bearings0, bearings1, inliers, settings, seed)
    return RelativePose(f0_T_f1, inliers, sigma, rivalled)


def _significant_pose(
    bearings0: np.ndarray,
    bearings1: np.ndarray,
    settings: TwoViewLimits,
    seed: int,
    chance: float = 0.0,
) -> tuple[np.ndarray, np.ndarray] | None:
    """f0_T_f1 (4, 4), unit translation, inliers (m,) bool of the best pose; None = by chance."""
    largest, num = np.sin(np.deg2rad(settings.max_error_deg)), witnesses(bearings0, CELLS_PER_SIDE)

    def needed(of_match: float) -> int:
        of_witness = 1 - (1 - of_match) ** (len(bearings0) / num)
        return least_agreeing(num, of_witness, _SAMPLE_SIZE, settings.max_false_alarms)

    if len(bearings0) <= _SAMPLE_SIZE:
        return None
    least = needed(max(chance, largest))
    if least > num:
        return None
    share, trials = least / len(bearings0), (50, 3000)
    found = sampled_pose(bearings0, bearings1, settings.max_error_deg, share, trials, seed)
    if found is None:
        return None
    f0_T_f1, inliers = inverse(found[0]), found[1]
    f0_T_f1[:3, 3] /= max(np.linalg.norm(f0_T_f1[:3, 3]), 1e-12)
    # Where bearings crowd around one plane, many agree with poses along it by chance.
    sines = _normals(f0_T_f1, bearings0) @ (f0_T_f1[:3, :3] @ bearings1.T)
    np.fill_diagonal(sines, np.inf)
    agreeing = np.count_nonzero(np.abs(sines) < largest) / (sines.size - len(sines))
    least = needed(max(chance, agreeing, largest))
    enough = witnesses(bearings0[inliers], CELLS_PER_SIDE) >= least
    return (f0_T_f1, inliers) if enough else None


def sampled_pose(
    bearings0: np.ndarray,
    bearings1: np.ndarray,
    max_error_deg: float,
    min_inlier_share: float,
    trials: tuple[int, int],
    seed: int,
) -> tuple[np.ndarray, np.ndarray] | None:
    """f1_T_f0 (4, 4) of any scale and inliers (m,) bool of the pose with the most inliers, by
    COLMAP's RANSAC with a least and a largest number of trials; None = no pose."""
    import pycolmap

    options = pycolmap.RANSACOptions()
    options.max_error = np.deg2rad(max_error_deg)
    options.min_num_trials, options.max_num_trials = trials
    options.min_inlier_ratio = min_inlier_share
    options.random_seed = seed
    found = pycolmap.estimate_relative_pose(bearings0, bearings1, options)
    if found is None:
        return None
    matrix = found["cam2_from_cam1"].matrix()
    return pose(matrix[:, :3], matrix[:, 3]), np.asarray(found["inlier_mask"], bool)


def _normals(f0_T_f1: np.ndarray, bearings0: np.ndarray) -> np.ndarray:
    """Unit normals (m, 3) of the epipolar planes of bearings (m, 3), frame 0."""
    normals = np.cross(f0_T_f1[:3, 3], bearings0)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def _is_rivalled(
    f0_T_f1: np.ndarray,
    bearings0: np.ndarray,
    bearings1: np.ndarray,
    inliers: np.ndarray,
    settings: TwoViewLimits,
    seed: int,
) -> bool:
    """True if outliers of a pose agree on another pose that explains about as many matches.

    A false pose from repeated structure has the true one as its rival, and vice versa.
    """
    sines = np.sum(_normals(f0_T_f1, bearings0) * (bearings1 @ f0_T_f1[:3, :3].T), axis=1)
    # matches within 3 thresholds of the pose's epipolar planes support no rival
    rest = np.abs(sines) > np.sin(3.0 * np.deg2rad(settings.max_error_deg))
    rival = _significant_pose(bearings0[rest], bearings1[rest], settings, seed)
    if rival is None:
        return False
    support, against = bearings0[inliers], bearings0[rest][rival[1]]
    numbers = witnesses(support, CELLS_PER_SIDE), witnesses(against, CELLS_PER_SIDE)
    return not outweighs(*numbers, settings.max_error_rate)


def _direction_sigma(f0_T_f1: np.ndarray, bearings0: np.ndarray, bearings1: np.ndarray) -> float:
    """Standard deviation (rad) of the translation's direction; infinite if a rotation suffices.

    Residuals of a pure rotation are noise in two directions; under a translation, only those across
    the epipolar planes are. Medians of both are compared.
    """
    planes, rays1 = _normals(f0_T_f1, bearings0), bearings1 @ f0_T_f1[:3, :3].T
    across = np.sum(planes * rays1, axis=1)
    off = rotation_of_most(bearings0, bearings1)[1]
    left = np.median(off**2) / _CHI_SQUARE_MEDIANS[0]
    noise = np.median(across**2) / _CHI_SQUARE_MEDIANS[1]
    noise, left = noise + _MODEL_SIGMA_RAD**2, left + _MODEL_SIGMA_RAD**2
    num = witnesses(bearings0, CELLS_PER_SIDE)
    # one rotation in a million passes for a translation
    # 2.75: standard deviation of the log ratio of two such medians, times the root of the sample's
    # size
    if np.log(left / noise) < 4.75 * 2.75 / np.sqrt(num):
        return np.inf
    error = _direction_error(f0_T_f1[:3, 3], bearings0, rays1, planes)
    return error * np.sqrt(noise * len(bearings0) / num)


def _direction_error(
    direction: np.ndarray, bearings0: np.ndarray, rays1: np.ndarray, planes: np.ndarray
) -> float:
    """Largest standard deviation of the direction per radian of noise of the bearings (m, 3), both
    in frame 0's axes, of epipolar planes (m, 3)."""
    lengths = np.linalg.norm(np.cross(direction, bearings0), axis=1, keepdims=True)
    by_direction = np.cross(bearings0, rays1) / np.maximum(lengths, 1e-6)
    basis = np.linalg.svd(direction[None])[2][1:]  # of the plane orthogonal to the direction
    jacobian = np.hstack([np.cross(rays1, planes), by_direction @ basis.T])
    information = jacobian.T @ jacobian
    information += 1e-9 * np.trace(information) * np.eye(_SAMPLE_SIZE)
    return float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(information)[3:, 3:])[-1]))
