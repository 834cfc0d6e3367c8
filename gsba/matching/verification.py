"""Two-view verification on bearings, and agreement with the trajectory."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsba.config import VerifySettings
from gsba.geometry import inverse, parallax, pose, rotation_angle
from gsba.store.shards import ITEMS, Workers, even_blocks
from gsba.types import Counts, Keypoints, Matches, VerifiedPairs

Estimate = tuple[np.ndarray, np.ndarray]  # f0_T_f1 (4, 4), inlier mask (m,); see `relative_pose`


def verify(
    matches: Matches,
    keypoints: Keypoints,
    prior_f0_T_f1s: np.ndarray | None,
    position_sigmas: np.ndarray | None,
    settings: VerifySettings,
    seed: int,
    workers: Workers,
) -> VerifiedPairs:
    """Estimate a relative pose per pair by LO-RANSAC and keep pairs that agree with the prior.

    Args:
        matches: putative matches.
        keypoints: of all frames.
        prior_f0_T_f1s: (P, 4, 4) relative poses of the trajectory; None = none is believed, and
            a pair needs `min_share` of its matches instead.
        position_sigmas: (P,) how far the prior's relative position may be off, map units; decides
            how much its direction is worth.
        settings: thresholds.
        seed: of the sampling.
        workers: who do it.
    """
    estimates = estimate(matches, keypoints, settings, seed, workers)
    return agree_with_prior(
        matches, estimates, keypoints, prior_f0_T_f1s, position_sigmas, settings
    )


def agree_with_prior(
    matches: Matches,
    estimates: Sequence[Estimate | None],
    keypoints: Keypoints,
    prior_f0_T_f1s: np.ndarray | None,
    position_sigmas: np.ndarray | None,
    settings: VerifySettings,
) -> VerifiedPairs:
    """Keep pairs that agree with the prior.

    Args:
        estimates: of `estimate`, for each pair.
        matches, keypoints, prior_f0_T_f1s, position_sigmas, settings: as for `verify`.
    """
    kept = []
    dropped = {"too few matches": 0, "rotation contradicts": 0, "direction contradicts": 0}
    for p, found in enumerate(estimates):
        if found is None:
            dropped["too few matches"] += 1
            continue
        f0_T_f1, inliers = found
        rows = matches.of(p)[inliers]
        if prior_f0_T_f1s is None or position_sigmas is None:
            if inliers.mean() < settings.min_share:
                dropped["too few matches"] += 1
            else:
                kept.append((p, f0_T_f1, rows))
            continue
        prior = prior_f0_T_f1s[p]
        turn = rotation_angle(prior[:3, :3].T @ f0_T_f1[:3, :3])
        if turn > np.deg2rad(settings.max_rotation_deg):
            dropped["rotation contradicts"] += 1
        elif parallax(f0_T_f1, *keypoints.matched(matches.pairs[p], rows)) > np.deg2rad(
            settings.min_parallax_deg
        ) and not _direction_agrees(prior[:3, 3], f0_T_f1[:3, 3], position_sigmas[p], settings):
            dropped["direction contradicts"] += 1
        else:
            kept.append((p, f0_T_f1, rows))
    index = [p for p, _, _ in kept]
    verified = Matches.of_rows(matches.pairs[index], [rows for _, _, rows in kept])
    poses = np.array([f0_T_f1 for _, f0_T_f1, _ in kept]).reshape(-1, 4, 4)
    return VerifiedPairs(verified, poses, Counts(len(matches.pairs), len(kept), "pairs", dropped))


def estimate(
    matches: Matches, keypoints: Keypoints, settings: VerifySettings, seed: int, workers: Workers
) -> list[Estimate | None]:
    """`relative_pose` of every pair, whatever the prior says."""

    def rays(p: int) -> tuple[np.ndarray, np.ndarray]:
        return keypoints.matched(matches.pairs[p], matches.of(p))

    return list(workers.map_shards(_PoseJob(len(matches.pairs), rays, settings, seed)))


@dataclass(frozen=True, slots=True)
class _PoseJob:
    """The job of estimating relative poses."""

    num: int
    rays: Callable[[int], tuple[np.ndarray, np.ndarray]]  # of a pair, (m, 3) in either frame
    settings: VerifySettings
    seed: int
    title: str = "verifying"
    returns: Any = Estimate | None

    def __len__(self) -> int:
        return self.num

    def __call__(self, p: int) -> Estimate | None:
        return relative_pose(*self.rays(p), self.settings, self.seed)

    def blocks(self) -> Sequence[tuple[int, int]]:
        return even_blocks(self.num, ITEMS)

    def part(self, start: int, stop: int) -> "_PoseJob":
        rays = [self.rays(p) for p in range(start, stop)]
        return replace(self, num=len(rays), rays=rays.__getitem__)


def relative_pose(
    bearings0: np.ndarray, bearings1: np.ndarray, settings: VerifySettings, seed: int
) -> Estimate | None:
    """f0_T_f1 (4, 4) with unit translation and inlier mask (m,), or None if too few agree."""
    import pycolmap

    if len(bearings0) < settings.min_inliers:
        return None
    options = pycolmap.RANSACOptions()
    options.max_error = np.deg2rad(settings.max_error_deg)
    options.min_num_trials, options.max_num_trials = 100, 3000
    options.min_inlier_ratio = settings.min_inliers / len(bearings0)  # with fewer it is refused
    options.random_seed = seed
    found = pycolmap.estimate_relative_pose(bearings0, bearings1, options)
    if found is None or found["num_inliers"] < settings.min_inliers:
        return None
    f1_T_f0 = found["cam2_from_cam1"].matrix()
    f0_T_f1 = inverse(pose(f1_T_f0[:, :3], f1_T_f0[:, 3]))
    f0_T_f1[:3, 3] /= max(np.linalg.norm(f0_T_f1[:3, 3]), 1e-12)
    return f0_T_f1, np.asarray(found["inlier_mask"], bool)


def _direction_agrees(
    prior: np.ndarray, direction: np.ndarray, sigma: float, settings: VerifySettings
) -> bool:
    """Whether a unit direction fits a relative position known to `sigma`."""
    length = np.linalg.norm(prior)
    if length <= 3 * sigma:  # the prior does not know the direction
        return True
    allowed = np.deg2rad(settings.max_direction_deg) + np.arcsin(3 * sigma / length)
    angle = np.arctan2(np.linalg.norm(np.cross(prior, direction)), prior @ direction)
    return bool(angle < allowed)
