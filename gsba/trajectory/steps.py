"""Relative poses of consecutive frames, from images alone. The length of a step, which two views
leave open, follows from its neighbours': a point common to two steps must have the same depth in
both."""

from dataclasses import dataclass

import numpy as np

from gsba.geometry import inverse, nearest_rotation, rotation_angle
from gsba.types import CoarsePoses, Keypoints, PoseSource, VerifiedPairs

_MAX_LOG_DEVIATION = 0.15  # largest deviation of log ratios: points of rigid scenes are within it,
# half of them within .02


@dataclass(frozen=True, slots=True)
class Steps:
    """Relative poses of consecutive frames, from images alone."""

    f_T_nexts: np.ndarray  # (F - 1, 4, 4) float64, translation of unit length
    verified: np.ndarray  # (F - 1,) bool: estimated from images
    direction_sigmas: np.ndarray  # (F - 1,) float64, radians, of the directions; infinite = the
    # camera may have turned only
    paces: np.ndarray | float = 1.0  # (F - 1,) parts of a usual step, by their parallax, of steps
    # too short to have a direction of their own; 1 = others

    @property
    def directed(self) -> np.ndarray:
        """Steps (F - 1,) bool with a known direction of motion."""
        return np.isfinite(self.direction_sigmas)


def image_steps(pairs: VerifiedPairs, keypoints: Keypoints) -> Steps:
    """Relative poses of consecutive frames among verified pairs of frames at most a few apart; a
    step too short to have a direction takes that of the closest pairs over it."""
    num = max(len(keypoints.starts) - 2, 0)
    f_T_nexts = np.tile(np.eye(4), (num, 1, 1))
    verified, sigmas, parallaxes = np.zeros(num, bool), np.full(num, np.inf), np.zeros(num)
    for p, (f0, f1) in enumerate(pairs.matches.pairs):
        if f1 - f0 != 1:
            continue
        f0_T_f1 = pairs.f0_T_f1s[p]
        rays0, bearings1 = keypoints.matched(pairs.matches.pairs[p], pairs.matches.of(p))
        f_T_nexts[f0], verified[f0], sigmas[f0] = f0_T_f1, True, pairs.direction_sigmas[p]
        turn = nearest_rotation(rays0.T @ bearings1)
        parallaxes[f0] = np.median(np.linalg.norm(rays0 - bearings1 @ turn.T, axis=1))
        if parallaxes[f0] < np.deg2rad(0.1):
            # The camera stands: an essential matrix determines its turn less well.
            f_T_nexts[f0, :3, :3] = turn
    short, moving, paces = verified & ~np.isfinite(sigmas), np.isfinite(sigmas), np.ones(num)
    if not short.any():
        return Steps(f_T_nexts, verified, sigmas)
    if moving.any():
        paces[short] = np.minimum(parallaxes[short] / np.median(parallaxes[moving]), 1)
    gaps = np.diff(pairs.matches.pairs, axis=1)[:, 0]
    start_R_f = chained(np.ascontiguousarray(f_T_nexts[:, :3, :3]))
    for gap in np.unique(gaps[gaps > 1]):
        # Short steps get the mean direction, and its spread, of pairs over them.
        sums, (squares, counts) = np.zeros((num, 3)), np.zeros((2, num))
        for p in np.flatnonzero((gaps == gap) & np.isfinite(pairs.direction_sigmas)):
            first, last = pairs.matches.pairs[p]
            if verified[first:last].all():
                sums[first:last] += start_R_f[first] @ pairs.f0_T_f1s[p][:3, 3]
                squares[first:last] += pairs.direction_sigmas[p] ** 2
                counts[first:last] += 1
        known = short & (counts > 0)
        lengths = np.linalg.norm(sums[known], axis=1)
        f_T_nexts[known, :3, 3] = np.einsum("fji,fj->fi", start_R_f[:-1][known], sums[known])
        f_T_nexts[known, :3, 3] /= lengths[:, None]
        spread = 2 * (1 - lengths / counts[known])
        sigmas[known] = np.sqrt(squares[known] / counts[known] + spread)
        short = short & ~known
    return Steps(f_T_nexts, verified, sigmas, paces)


def tracked_steps(coarse: CoarsePoses) -> np.ndarray:
    """Steps (F - 1,) bool between two frames that the SLAM has tracked."""
    tracked = coarse.sources == PoseSource.SLAM
    return tracked[:-1] & tracked[1:]


def step_errors(steps: np.ndarray, found: Steps) -> tuple[np.ndarray, np.ndarray]:
    """Angles (F - 1,) in radians between rotations and directions of steps (F - 1, 4, 4) and those
    found in images."""
    turned = rotation_angle(np.swapaxes(steps[:, :3, :3], 1, 2) @ found.f_T_nexts[:, :3, :3])
    moved, seen = steps[:, :3, 3], found.f_T_nexts[:, :3, 3]
    across = np.linalg.norm(np.cross(moved, seen), axis=1)
    return turned, np.arctan2(across, np.einsum("fi,fi->f", moved, seen))


def off_steps(pairs: VerifiedPairs, found: Steps) -> np.ndarray:
    """Angles (P,), radians, by which pairs over two steps violate the directions of these, less
    three sigmas; 0 for other pairs and unknown directions. A false pair from repeated structure
    agrees with neither step, though it may be within the trajectory's tolerance."""
    out = np.zeros(len(pairs.matches.pairs))
    for p, (f0, f2) in enumerate(pairs.matches.pairs):
        sigmas = np.array([pairs.direction_sigmas[p], *found.direction_sigmas[f0 : f0 + 2]])
        if f2 - f0 != 2 or not np.isfinite(sigmas).all():
            continue
        first = found.f_T_nexts[f0]
        second = first[:3, :3] @ found.f_T_nexts[f0 + 1, :3, 3]
        off = _angle_to_arc(pairs.f0_T_f1s[p][:3, 3], first[:3, 3], second)
        out[p] = max(off - 3 * float(np.linalg.norm(sigmas)), 0.0)
    return out


def _angle_to_arc(direction: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    """Angle in radians from a unit vector to the great arc between two others."""
    normal = np.cross(start, end)
    beside = np.cross(normal, start) @ direction >= 0 and np.cross(end, normal) @ direction >= 0
    length = np.linalg.norm(normal)
    if beside and length > 1e-9:
        return float(np.arcsin(min(abs(normal @ direction) / length, 1.0)))
    return float(np.arccos(np.clip(max(direction @ start, direction @ end), -1, 1)))


def length_ratios(
    pairs: VerifiedPairs, found: Steps, keypoints: Keypoints, least_alike: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms (F - 2,) of each step's length by that of the step before, and their standard
    deviations, infinite where unknown, from common points: eight, or `least_alike` that agree to 15
    %."""
    num = len(found.verified)
    logs, sigmas = np.zeros(max(num - 1, 0)), np.full(max(num - 1, 0), np.inf)
    rows = {int(f0): p for p, (f0, f1) in enumerate(pairs.matches.pairs) if f1 - f0 == 1}
    for f in range(1, num):
        if not (found.directed[f - 1] and found.directed[f]):
            continue
        before, after = pairs.matches.of(rows[f - 1]), pairs.matches.of(rows[f])
        _, in_before, in_after = np.intersect1d(before[:, 1], after[:, 0], return_indices=True)
        before, after = before[in_before], after[in_after]
        here = keypoints.bearings_of(f)
        back = ray_depths(
            here[before[:, 1]],
            keypoints.bearings_of(f - 1)[before[:, 0]],
            inverse(found.f_T_nexts[f - 1]),
        )
        ahead = ray_depths(
            here[after[:, 0]], keypoints.bearings_of(f + 1)[after[:, 1]], found.f_T_nexts[f]
        )
        ratios = np.log(back / ahead)
        ratios = ratios[np.isfinite(ratios)]
        if least_alike is not None and len(ratios):
            ratios = ratios[np.abs(ratios - np.median(ratios)) < _MAX_LOG_DEVIATION]
        if len(ratios) < (8 if least_alike is None else least_alike):
            continue
        logs[f - 1] = np.median(ratios)
        spread = 1.4826 * np.median(np.abs(ratios - logs[f - 1]))
        sigmas[f - 1] = max(1.25 * spread / np.sqrt(len(ratios)), 0.02)
    return logs, sigmas


def given_up(open_at: set[int], matches: np.ndarray) -> set[int]:
    """First frames of steps to drop so that no two consecutive ones remain without a known ratio of
    lengths, as at frames `open_at`; of two, the one with fewer matches (F - 1,)."""
    out, left = set[int](), set(open_at)
    while left:
        beside = {step for f in left for step in (f - 1, f)}
        order = {f: (-len({f, f + 1} & left), int(matches[f]), f) for f in beside}
        worst = min(beside, key=order.__getitem__)
        out.add(worst)
        left -= {worst, worst + 1}
    return out


def without_steps(pairs: VerifiedPairs, steps: set[int]) -> VerifiedPairs:
    """Pairs without some steps, by their first frames, and without pairs over them."""
    frames = enumerate(pairs.matches.pairs.tolist())
    return pairs.taken([p for p, (f0, f1) in frames if not steps & set(range(f0, f1))])


def matches_of_steps(pairs: VerifiedPairs, num_frames: int) -> np.ndarray:
    """Number of matches (F - 1,) of each step; 0 where there is none."""
    out = np.zeros(max(num_frames - 1, 0), np.int64)
    steps = pairs.matches.pairs[:, 1] - pairs.matches.pairs[:, 0] == 1
    out[pairs.matches.pairs[steps, 0]] = np.diff(pairs.matches.offsets)[steps]
    return out


def ray_depths(rays0: np.ndarray, rays1: np.ndarray, f0_T_f1: np.ndarray) -> np.ndarray:
    """Depths (m,) along rays of frame 0 at which both rays meet; NaN if uncertain: behind a frame,
    or at an angle of less than a degree."""
    across = rays1 @ f0_T_f1[:3, :3].T
    cosine = np.einsum("mi,mi->m", rays0, across)
    sine2 = 1 - cosine**2
    along0, along1 = rays0 @ f0_T_f1[:3, 3], across @ f0_T_f1[:3, 3]
    clear = sine2 > np.sin(np.deg2rad(1.0)) ** 2
    safe = np.where(clear, sine2, 1)
    depth0, depth1 = (along0 - cosine * along1) / safe, (cosine * along0 - along1) / safe
    return np.where(clear & (depth0 > 0) & (depth1 > 0), depth0, np.nan)


def step_lengths(
    slam_lengths: np.ndarray, slam_sigmas: np.ndarray, logs: np.ndarray, sigmas: np.ndarray
) -> np.ndarray:
    """Lengths of steps that fit their measured ratios and, if consistent, the trajectory's lengths.

    The most probable logarithms of the lengths under Gaussian ratios and Cauchy-distributed
    errors of the trajectory, by reweighting from wide to narrow (graduated non-convexity).

    Args:
        slam_lengths: (N,) lengths in the trajectory, map units.
        slam_sigmas: (N,) standard deviations of their logarithms; infinite = unused.
        logs, sigmas: (N - 1,) see `length_ratios`.

    Returns:
        (N,) map units.
    """
    from scipy.linalg import solveh_banded

    positive = slam_lengths[slam_lengths > 0]
    typical = float(np.median(positive)) if len(positive) else 1.0
    target = np.log(np.maximum(slam_lengths, 1e-3 * typical))
    if not len(logs):
        return np.exp(target)
    # walkers keep their pace
    links = np.where(np.isfinite(sigmas), 1 / np.minimum(sigmas, 1e3) ** 2, 0.5**-2)
    logs = np.where(np.isfinite(sigmas), logs, 0)
    information = np.where(np.isfinite(slam_sigmas), slam_sigmas**-2.0, 0)
    width = 30.0  # width of the loss, standard deviations
    lengths = np.full(len(target), np.median(target))
    for _ in range(20):
        misfit = (target - lengths) ** 2 * information
        weights = information / (1 + misfit / width**2) + 1e-9
        bands = np.zeros((2, len(target)))
        bands[1] = weights
        bands[1, :-1] += links
        bands[1, 1:] += links
        bands[0, 1:] = -links
        right = weights * target
        right[:-1] -= links * logs
        right[1:] += links * logs
        lengths = solveh_banded(bands, right)
        width = max(0.7 * width, 1.0)
    return np.exp(lengths)


def chained(steps: np.ndarray) -> np.ndarray:
    """Poses (F, 4, 4) or rotations (F, 3, 3) chained from steps, the first the identity."""
    poses = [np.eye(steps.shape[1])]
    for step in steps:
        poses.append(poses[-1] @ step)
    return np.array(poses)
