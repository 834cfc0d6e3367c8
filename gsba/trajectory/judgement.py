"""What the images say about each step of the trajectory, and a start that follows both.

Two frames that follow one another share so much that their relative rotation and direction of
motion can be had from the images alone. The length of a step, which two views leave open, follows
from its neighbours': a point that two steps see must be equally far in both. Steps of the
trajectory that this contradicts lose their prior, and the start is chained past them.
"""

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsba.config import PriorSettings, VerifySettings
from gsba.geometry import inverse, pose, rotation_angle
from gsba.matching.verification import bearings, parallax
from gsba.trajectory.blame import chained, false_frames, limits
from gsba.types import CoarsePoses, FrameSet, Keypoints, PoseSource, VerifiedPairs

logger = logging.getLogger(__name__)

_MIN_COMMON = 8  # points that two steps must share to compare their lengths
_MIN_POINT_PARALLAX = np.deg2rad(1.0)  # of a point, or its depth is not worth comparing
_STILL = np.deg2rad(0.1)  # median: what a mere turn leaves over of bearings
_RATIO_SIGMA = 0.02  # least noise of the logarithm of a ratio of lengths
_SMOOTH_SIGMA = 0.5  # of the same where nothing is measured: walkers keep their pace
_LENGTH_ROUNDS = 20  # of reweighting
_LEAP = 4.0  # median speeds
_ROUGH = 3.0  # standard deviations of the prior: a step further off starts from the images


@dataclass(frozen=True, slots=True)
class Steps:
    """Relative poses of frames that follow one another, from the images alone."""

    f_T_nexts: np.ndarray  # (F - 1, 4, 4) float64, translation of unit length
    verified: np.ndarray  # (F - 1,) bool: the images gave one
    directed: np.ndarray  # (F - 1,) bool: with parallax enough to know the direction


@dataclass(frozen=True, slots=True)
class Trust:
    """Which steps of the trajectory the images contradict, and where to start instead."""

    world_T_rigs: np.ndarray  # (F, 4, 4) float64, the trajectory chained past false steps
    false_steps: np.ndarray  # (F - 1,) bool, contradicted: no prior
    false_frames: np.ndarray  # (F,) bool, both steps at a frame are false, but not around it
    unseen_steps: np.ndarray  # (F - 1,) bool, the images say nothing: the trajectory alone
    lengths: np.ndarray  # (F - 1,) float64, map units, of the steps
    turning_only: bool  # no two frames have parallax: only rotations can be had

    @property
    def sound(self) -> bool:
        """Whether every step of the trajectory was confirmed."""
        return not (self.false_steps.any() or self.unseen_steps.any())

    @property
    def held_steps(self) -> np.ndarray:
        """Steps (F - 1,) bool that no image shows, but the trajectory may know."""
        return self.unseen_steps & ~self.false_steps


def steps(pairs: VerifiedPairs, keypoints: Keypoints, settings: VerifySettings) -> Steps:
    """Relative poses of neighbours among verified pairs.

    Args:
        pairs: of frames at most a few apart.
        keypoints: of all frames.
        settings: least parallax at which a direction is known.
    """
    num = max(len(keypoints.starts) - 2, 0)
    f_T_nexts = np.tile(np.eye(4), (num, 1, 1))
    verified, directed = np.zeros(num, bool), np.zeros(num, bool)
    for p, (f0, f1) in enumerate(pairs.matches.pairs):
        if f1 - f0 != 1:
            continue
        f0_T_f1 = pairs.f0_T_f1s[p]
        rays0, bearings1 = bearings(pairs.matches, keypoints, p, pairs.matches.of(p))
        f_T_nexts[f0], verified[f0] = f0_T_f1, True
        turn = _turn(rays0, bearings1)
        if np.median(np.linalg.norm(rays0 - bearings1 @ turn.T, axis=1)) < _STILL:
            f_T_nexts[f0, :3, :3] = turn  # an essential matrix knows it less well
        directed[f0] = parallax(f0_T_f1, rays0, bearings1) > np.deg2rad(settings.min_parallax_deg)
    return Steps(f_T_nexts, verified, directed)


def off_steps(
    pairs: VerifiedPairs, found: Steps, keypoints: Keypoints, settings: VerifySettings
) -> np.ndarray:
    """How far pairs over two steps are from what those steps, whatever their lengths, allow.

    Frame f + 2 lies, as f sees it, between the directions of both steps. A pair that repeated
    structure made up agrees with neither, though it may be within what the trajectory allows.

    Returns:
        (P,) radians; 0 for other pairs, and where a direction is not known.
    """
    out = np.zeros(len(pairs.matches.pairs))
    for p, (f0, f2) in enumerate(pairs.matches.pairs):
        if f2 - f0 != 2 or not found.directed[f0 : f0 + 2].all():
            continue
        f0_T_f2 = pairs.f0_T_f1s[p]
        both = bearings(pairs.matches, keypoints, p, pairs.matches.of(p))
        if parallax(f0_T_f2, *both) > np.deg2rad(settings.min_parallax_deg):
            first = found.f_T_nexts[f0]
            second = first[:3, :3] @ found.f_T_nexts[f0 + 1, :3, 3]
            out[p] = _angle_to_arc(f0_T_f2[:3, 3], first[:3, 3], second)
    return out


def _angle_to_arc(direction: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    """Angle in radians from a unit vector to the great arc between two others."""
    normal = np.cross(start, end)
    beside = np.cross(normal, start) @ direction >= 0 and np.cross(end, normal) @ direction >= 0
    length = np.linalg.norm(normal)
    if beside and length > 1e-9:
        return float(np.arcsin(min(abs(normal @ direction) / length, 1.0)))
    return float(np.arccos(np.clip(max(direction @ start, direction @ end), -1, 1)))


def _turn(rays0: np.ndarray, rays1: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) that carries rays (m, 3) onto others in least squares (Kabsch, 1976)."""
    u, _, vt = np.linalg.svd(rays0.T @ rays1)
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt


def length_ratios(
    pairs: VerifiedPairs, found: Steps, keypoints: Keypoints
) -> tuple[np.ndarray, np.ndarray]:
    """Length of each step over that of the step before, from points that both see.

    Returns:
        Logarithms (F - 2,) of the ratios and their standard deviations, infinite where unknown.
    """
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
        back = _depths(
            here[before[:, 1]],
            keypoints.bearings_of(f - 1)[before[:, 0]],
            inverse(found.f_T_nexts[f - 1]),
        )
        ahead = _depths(
            here[after[:, 0]], keypoints.bearings_of(f + 1)[after[:, 1]], found.f_T_nexts[f]
        )
        ratios = np.log(back / ahead)
        ratios = ratios[np.isfinite(ratios)]
        if len(ratios) < _MIN_COMMON:
            continue
        logs[f - 1] = np.median(ratios)
        spread = 1.4826 * np.median(np.abs(ratios - logs[f - 1]))
        sigmas[f - 1] = max(1.25 * spread / np.sqrt(len(ratios)), _RATIO_SIGMA)
    return logs, sigmas


def _depths(rays0: np.ndarray, rays1: np.ndarray, f0_T_f1: np.ndarray) -> np.ndarray:
    """Distances (m,) from frame 0 along its rays to where both rays meet; NaN where unclear."""
    across = rays1 @ f0_T_f1[:3, :3].T
    cosine = np.einsum("mi,mi->m", rays0, across)
    sine2 = 1 - cosine**2
    along0, along1 = rays0 @ f0_T_f1[:3, 3], across @ f0_T_f1[:3, 3]
    clear = sine2 > np.sin(_MIN_POINT_PARALLAX) ** 2
    safe = np.where(clear, sine2, 1)
    depth0, depth1 = (along0 - cosine * along1) / safe, (cosine * along0 - along1) / safe
    return np.where(clear & (depth0 > 0) & (depth1 > 0), depth0, np.nan)


def step_lengths(
    slam_lengths: np.ndarray,
    slam_sigmas: np.ndarray,
    logs: np.ndarray,
    sigmas: np.ndarray,
) -> np.ndarray:
    """Lengths of steps that agree with their measured ratios and, where right, the trajectory's.

    The most probable logarithms of the lengths under Gaussian ratios and Cauchy-distributed
    errors of the trajectory, by reweighting from wide to narrow (graduated non-convexity).

    Args:
        slam_lengths: (N,) lengths in the trajectory, map units.
        slam_sigmas: (N,) noise of their logarithms; infinite = not to be used.
        logs, sigmas: (N - 1,) see `length_ratios`.

    Returns:
        (N,) map units.
    """
    from scipy.linalg import solveh_banded

    positive = slam_lengths[slam_lengths > 0]
    typical = float(np.median(positive)) if len(positive) else 1.0
    target = np.log(np.maximum(slam_lengths, 1e-3 * typical))
    links = np.where(np.isfinite(sigmas), 1 / np.minimum(sigmas, 1e3) ** 2, _SMOOTH_SIGMA**-2)
    logs = np.where(np.isfinite(sigmas), logs, 0)
    information = np.where(np.isfinite(slam_sigmas), slam_sigmas**-2.0, 0)
    width = 30.0  # of the loss, standard deviations
    lengths = np.full(len(target), np.median(target))
    for _ in range(_LENGTH_ROUNDS):
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


def judge(
    coarse: CoarsePoses,
    found: Steps,
    logs: np.ndarray,
    sigmas: np.ndarray,
    verify: VerifySettings,
    priors: PriorSettings,
) -> Trust:
    """Compare the trajectory's steps with those of the images.

    Args:
        coarse: the trajectory.
        found: steps from the images.
        logs, sigmas: ratios of their lengths.
        verify: disagreement that counts as contradiction.
        priors: noise of the trajectory's steps.
    """
    slam = inverse(coarse.world_T_rigs[:-1]) @ coarse.world_T_rigs[1:]
    slam_lengths = np.linalg.norm(slam[:, :3, 3], axis=1)
    own = coarse.sources == PoseSource.SLAM
    turned, off = _disagreement(slam, found)
    if not own.any() or (found.verified.any() and not found.directed.any()):
        return _from_images_alone(coarse, slam, found, logs, sigmas)
    wrong = found.verified & (turned > np.deg2rad(verify.max_rotation_deg))
    wrong |= found.directed & (off > np.deg2rad(verify.max_direction_deg))
    known = own[:-1] & own[1:]
    noise = np.where(known, np.where(wrong, 10 * priors.translation, priors.translation), np.inf)
    lengths = step_lengths(slam_lengths, noise, logs, sigmas)
    strain = np.abs(np.log(np.maximum(slam_lengths, 1e-12) / lengths))
    linked = np.zeros(len(strain), bool)
    linked[:-1] |= np.isfinite(sigmas)
    linked[1:] |= np.isfinite(sigmas)
    wrong |= found.directed & linked & (strain > np.log(verify.max_length_ratio))
    unseen = ~found.verified
    rough = wrong | (found.verified & (turned > _ROUGH * np.deg2rad(priors.rotation_deg)))
    rough |= found.directed & (off > np.arctan(_ROUGH * priors.translation))
    rough |= found.directed & linked & (strain > _ROUGH * priors.translation)
    chosen = slam.copy()
    if wrong.any() or unseen.any():
        chosen[rough, :3, :3] = found.f_T_nexts[rough, :3, :3]
        moved = rough & found.directed
        chosen[moved, :3, 3] = lengths[moved, None] * found.f_T_nexts[moved, :3, 3]
        start = _chain(coarse.world_T_rigs, chosen, own)
    else:
        start = coarse.world_T_rigs
    seen = slam.copy()
    seen[found.verified, :3, :3] = found.f_T_nexts[found.verified, :3, :3]
    seen[found.directed, :3, 3] = (
        lengths[found.directed, None] * found.f_T_nexts[found.directed, :3, 3]
    )
    named = false_frames(
        wrong, slam, chosen, own, limits(slam, seen, known & found.directed, verify)
    )
    return Trust(start, wrong, named, unseen, lengths, False)


def _from_images_alone(
    coarse: CoarsePoses, slam: np.ndarray, found: Steps, logs: np.ndarray, sigmas: np.ndarray
) -> Trust:
    """A start from the steps of the images wherever there are any; no step keeps its prior."""
    slam_lengths = np.linalg.norm(slam[:, :3, 3], axis=1)
    lengths = slam_lengths
    if found.directed.any():
        unknown = np.full(len(slam), np.inf)
        lengths = step_lengths(slam_lengths, unknown, logs, sigmas)
    chosen = slam.copy()
    chosen[found.verified, :3, :3] = found.f_T_nexts[found.verified, :3, :3]
    moved = found.directed
    chosen[moved, :3, 3] = lengths[moved, None] * found.f_T_nexts[moved, :3, 3]
    own = coarse.sources == PoseSource.SLAM
    turning_only = bool(found.verified.any() and not moved.any())
    if turning_only and not own.any():
        chosen[:, :3, 3] = 0
    start = _chain(coarse.world_T_rigs, chosen, own)
    every, nobody = np.ones(len(slam), bool), np.zeros(len(slam) + 1, bool)
    return Trust(start, every, nobody, ~found.verified, lengths, turning_only)


def leaps(world_T_rigs: np.ndarray, timestamps: np.ndarray) -> np.ndarray:
    """Steps (F - 1,) bool much faster than the rest: without images, they are another world's."""
    lengths = np.linalg.norm(np.diff(world_T_rigs[:, :3, 3], axis=0), axis=1)
    speeds = lengths / np.diff(timestamps)
    moving = speeds[speeds > 0]
    return speeds > _LEAP * np.median(moving) if len(moving) else np.zeros(len(speeds), bool)


def describe(trust: Trust, frames: FrameSet) -> tuple[dict[str, list[Any]], list[str]]:
    """The judgement by the names of frames, for the report, and what to note of it."""
    names = np.array(frames.names)

    def between(chosen: np.ndarray) -> list[Any]:
        return [[names[f], names[f + 1]] for f in np.flatnonzero(chosen).tolist()]

    false = names[trust.false_frames].tolist()
    judgement = {
        "false_frames": false,
        "false_steps": between(trust.false_steps),
        "unseen_steps": between(trust.unseen_steps),
    }
    notes = []
    if false:
        notes.append(f"the images contradict the trajectory at {', '.join(false)}: not believed")
    if trust.turning_only:
        notes.append("no frame has parallax to the next: no depth can be had, rotations only")
    if trust.held_steps.any():
        steps = ", ".join(f"{a} to {b}" for a, b in between(trust.held_steps))
        notes.append(f"no images in common, held by the trajectory alone: {steps}")
    for note in notes:
        logger.warning(note)
    return judgement, notes


def _disagreement(slam: np.ndarray, found: Steps) -> tuple[np.ndarray, np.ndarray]:
    """Angles (F - 1,) in radians between both rotations and both directions of each step."""
    turned = rotation_angle(np.swapaxes(slam[:, :3, :3], 1, 2) @ found.f_T_nexts[:, :3, :3])
    moved, seen = slam[:, :3, 3], found.f_T_nexts[:, :3, 3]
    across = np.linalg.norm(np.cross(moved, seen), axis=1)
    return turned, np.arctan2(across, np.einsum("fi,fi->f", moved, seen))


def _chain(world_T_rigs: np.ndarray, chosen: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Poses (F, 4, 4) that follow the chosen steps, laid over the trajectory's own frames."""
    poses = chained(chosen)
    own = own if own.any() else np.ones(len(own), bool)
    u, _, vt = np.linalg.svd(
        np.einsum("fij,fkj->ik", world_T_rigs[own, :3, :3], poses[own, :3, :3])
    )
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    positions = poses[:, :3, 3] @ rotation.T
    shift = np.median(world_T_rigs[own, :3, 3] - positions[own], axis=0)
    return pose(rotation @ poses[:, :3, :3], positions + shift)
