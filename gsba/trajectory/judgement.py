"""Checks of the trajectory's steps against images: those that images contradict lose their prior,
and initial poses are chained past them."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsba.config import PriorSettings
from gsba.geometry import (
    inverse,
    nearest_rotation,
    pose,
    relative_steps,
    rotation_angle,
    typical_length,
)
from gsba.trajectory.limits import TwoViewLimits
from gsba.trajectory.steps import Steps, chained, step_errors, step_lengths, tracked_steps
from gsba.trajectory.turning import Turn
from gsba.types import CoarsePoses, PoseSource

logger = logging.getLogger(__name__)

_MAX_PRIOR_SIGMAS = 3.0  # standard deviations of the prior beyond which a step starts from the
# images

_NOISE_QUANTILE = 0.25  # share of steps free of outliers: quantile from which noise is estimated
# Multiple of the quantile from which an error is an outlier: drift exceeds it once in 1000 steps.
_OUTLIER_RATIO = 4.0
_STEPS_AROUND = 6  # steps to either side whose lengths a step's is compared with
_LONG_STEP_DEPTHS = 0.3  # steps from which bays of a hall are taken for one another, median depths


@dataclass(frozen=True, slots=True)
class StepChecks:
    """Steps of the trajectory that images contradict, and initial poses past these."""

    world_T_rigs: np.ndarray  # (F, 4, 4) float64, the trajectory chained past false steps
    false_steps: np.ndarray  # (F - 1,) bool, contradicted by images: no prior
    false_frames: np.ndarray  # (F,) bool, both steps at a frame are false, but not around it
    unseen_steps: np.ndarray  # (F - 1,) bool, not estimated from images: the trajectory alone
    lengths: np.ndarray  # (F - 1,) float64, map units, of the steps
    turn: Turn | None  # rotations of a camera that turned on the spot; None = it moved

    @classmethod
    def of_all(cls, world_T_rigs: np.ndarray) -> "StepChecks":
        """Checks of a trajectory (F, 4, 4) that nothing contradicts."""
        none = np.zeros(max(len(world_T_rigs) - 1, 0), bool)
        lengths = np.linalg.norm(np.diff(world_T_rigs[:, :3, 3], axis=0), axis=1)
        return cls(world_T_rigs, none, np.zeros(len(world_T_rigs), bool), none, lengths, None)

    @property
    def turning_only(self) -> bool:
        """True if only rotations can be estimated."""
        return self.turn is not None

    @property
    def sound(self) -> bool:
        """True if every step of the trajectory was confirmed."""
        return not (self.false_steps.any() or self.unseen_steps.any())

    @property
    def held_steps(self) -> np.ndarray:
        """Steps (F - 1,) bool without images, whose pose the trajectory may give."""
        return self.unseen_steps & ~self.false_steps


def check_steps(
    coarse: CoarsePoses,
    found: Steps,
    logs: np.ndarray,
    sigmas: np.ndarray,
    verify: TwoViewLimits,
    priors: PriorSettings,
    turn: Turn | None = None,
) -> StepChecks:
    """Compare the trajectory's steps with those of the images, by logarithms (F - 2,) of ratios of
    lengths and their standard deviations; `turn` proves that the camera turned on the spot."""
    slam = relative_steps(coarse.world_T_rigs)
    slam_lengths = np.linalg.norm(slam[:, :3, 3], axis=1)
    own = coarse.sources == PoseSource.SLAM
    turned, off = step_errors(slam, found)
    if turn is not None:
        return _turned(coarse, slam, found, turn)
    if not own.any():
        return _from_images_alone(coarse, slam, found, logs, sigmas)
    wrong = found.verified & (turned > np.deg2rad(verify.max_rotation_deg))
    unsure = 3 * np.where(found.directed, found.direction_sigmas, 0.0)
    wrong |= found.directed & (off > np.deg2rad(verify.max_direction_deg) + unsure)
    known = tracked_steps(coarse)
    noise = np.where(known, np.where(wrong, 10 * priors.translation, priors.translation), np.inf)
    lengths = step_lengths(slam_lengths, noise, logs, sigmas)
    strain = np.abs(np.log(np.maximum(slam_lengths, 1e-12) / lengths))
    linked = np.zeros(len(strain), bool)
    linked[:-1] |= np.isfinite(sigmas)
    linked[1:] |= np.isfinite(sigmas)
    wrong |= found.directed & linked & (strain > np.log(verify.max_length_ratio))
    unseen = ~found.verified
    most_turned = _MAX_PRIOR_SIGMAS * np.deg2rad(priors.rotation_deg)
    rough = wrong | (found.verified & (turned > most_turned))
    rough |= found.directed & (off > np.arctan(_MAX_PRIOR_SIGMAS * priors.translation) + unsure)
    rough |= found.directed & linked & (strain > _MAX_PRIOR_SIGMAS * priors.translation)
    chosen = slam.copy()
    if wrong.any() or unseen.any():
        chosen = _replaced(slam, found, lengths, rough)
        start = _chain(coarse.world_T_rigs, chosen, own)
    else:
        start = coarse.world_T_rigs
    seen = _replaced(slam, found, lengths, found.verified)
    # The better ones of its steps tell the noise of the trajectory: one that drifts quickly
    # contradicts images in many steps, and none of its frames is an outlier.
    judged = known & found.directed
    turned = rotation_angle(np.swapaxes(slam[:, :3, :3], 1, 2) @ seen[:, :3, :3])
    off = np.linalg.norm(slam[:, :3, 3] - seen[:, :3, 3], axis=1)
    noise = [
        _OUTLIER_RATIO * float(np.quantile(x[judged], _NOISE_QUANTILE)) if judged.any() else 0.0
        for x in (turned, off)
    ]
    limits = np.deg2rad([verify.max_rotation_deg, verify.max_direction_deg])
    named = false_frames(wrong, slam, chosen, own, (limits[0], np.sin(limits[1])), noise)
    return StepChecks(start, wrong, named, unseen, lengths, None)


def _replaced(slam: np.ndarray, found: Steps, lengths: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Steps (F - 1, 4, 4) of the trajectory, at `rows` (F - 1,) bool those of the images."""
    steps, moved = slam.copy(), rows & found.directed
    steps[rows, :3, :3] = found.f_T_nexts[rows, :3, :3]
    steps[moved, :3, 3] = lengths[moved, None] * found.f_T_nexts[moved, :3, 3]
    return steps


def confirmed(coarse: CoarsePoses, found: Steps, priors: PriorSettings) -> np.ndarray:
    """Steps (F - 1,) bool on which images and trajectory agree within the latter's noise."""
    slam = relative_steps(coarse.world_T_rigs)
    turned, off = step_errors(slam, found)
    close = turned < _MAX_PRIOR_SIGMAS * np.deg2rad(priors.rotation_deg)
    close &= off < np.arctan(_MAX_PRIOR_SIGMAS * priors.translation) + 3 * found.direction_sigmas
    return found.directed & close & tracked_steps(coarse)


def implausible_steps(
    coarse: CoarsePoses,
    trust: StepChecks,
    world_T_rigs: np.ndarray,
    timestamps: np.ndarray,
    max_ratio: float,
    noise: float,
) -> np.ndarray:
    """Steps (F - 1,) bool whose length in a map of the images contradicts the trajectory, though it
    has the more usual speed.

    Where the view changes much from one frame to the next, repeated structure matches one bay
    further on, in three frames, too. A trajectory that jumps has an unusual speed itself. A step
    whose two frames do not match while frames around it do is less sure: there the trajectory's
    noise is the limit.

    Args:
        world_T_rigs: (F, 4, 4) poses in the map.
        timestamps: (F,) seconds.
        max_ratio: of the lengths of a step in both, relative to steps around it.
        noise: standard deviation of the trajectory's steps, part of the step.
    """
    slam, found = (
        np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        for poses in (coarse.world_T_rigs, world_T_rigs)
    )
    judged = tracked_steps(coarse) & ~(trust.unseen_steps & trust.false_steps)  # those are guesses
    # standing still measures nothing
    judged &= (found > 0) & (slam > typical_length(slam) / max_ratio)
    rows, wrong = np.flatnonzero(judged), np.zeros(len(slam), bool)
    if len(rows) < 6:
        return wrong
    ratios = np.log(found[rows] / slam[rows])
    speeds = np.log(found[rows] / np.diff(timestamps)[rows])
    # A step that only frames around it show may be off by two standard deviations.
    limits = np.where(trust.unseen_steps, 2.0 * noise, np.log(max_ratio))
    for n, step in enumerate(rows.tolist()):
        around = slice(max(n - _STEPS_AROUND, 0), n + _STEPS_AROUND + 1)
        off = ratios[n] - np.median(ratios[around])
        unusual = speeds[n] - np.median(speeds[around])
        wrong[step] = abs(off) > limits[step] and abs(unusual - off) < abs(unusual)
    return wrong


def over_missing_frames(timestamps: np.ndarray, recordings: np.ndarray) -> np.ndarray:
    """Steps (F - 1,) bool within recordings (F,) int that take longer (seconds) than usual
    there."""
    found = np.zeros(len(timestamps) - 1, bool)
    for number in np.unique(recordings):
        rows = np.flatnonzero(recordings == number)
        intervals = np.diff(timestamps[rows])
        if len(intervals):
            found[rows[:-1]] = intervals > 1.5 * np.median(intervals)
    return found


def long_steps(world_T_rigs: np.ndarray, depth: float) -> np.ndarray:
    """Steps (F - 1,) bool between poses (F, 4, 4) among steps so long that the view changes much;
    `depth`, the median distance of points, in map units."""
    lengths = np.linalg.norm(np.diff(world_T_rigs[:, :3, 3], axis=0), axis=1)
    around = [
        lengths[max(step - _STEPS_AROUND, 0) : step + _STEPS_AROUND + 1]
        for step in range(len(lengths))
    ]
    usual = np.array([np.median(some) for some in around])
    return usual > _LONG_STEP_DEPTHS * depth


def unusual_paces(
    world_T_rigs: np.ndarray, timestamps: np.ndarray, recordings: np.ndarray
) -> np.ndarray:
    """Steps (F - 1,) bool over missing frames that are walked in a map, poses (F, 4, 4), much
    slower or faster than those around, or back: there, hundreds of matches agree on a step that is
    a bay too short."""
    missing = over_missing_frames(timestamps, recordings)
    usual = ~missing & (recordings[1:] == recordings[:-1])
    velocities = np.diff(world_T_rigs[:, :3, 3], axis=0) / np.diff(timestamps)[:, None]
    speeds = np.linalg.norm(velocities, axis=1)
    # in the speed of the steps around
    unusual, (slowest, fastest) = np.zeros(len(missing), bool), (0.6, 1.6)
    for step in np.flatnonzero(missing).tolist():
        around = np.arange(max(step - _STEPS_AROUND, 0), min(step + _STEPS_AROUND + 1, len(speeds)))
        around = around[usual[around] & (recordings[around] == recordings[step])]
        if len(around):
            speed = typical_length(speeds[around])
            near = around[np.argsort(np.abs(around - step), kind="stable")][:4]
            back = velocities[step] @ velocities[near].sum(axis=0) < 0
            unusual[step] = back or not slowest * speed < speeds[step] < fastest * speed
    return unusual


def back_and_forth(world_T_rigs: np.ndarray, shown: np.ndarray, depth: float) -> np.ndarray:
    """Steps (F - 1,) bool before and behind a frame at which the camera goes back the way that it
    came without turning, far from others, over no missing frame (`shown`): the next bay of a hall
    may match better, and which of two steps is false does not show. `depth` in map units."""
    steps = np.diff(world_T_rigs[:, :3, 3], axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    found = np.zeros(len(steps), bool)
    at_rig = np.einsum("fji,fj->fi", world_T_rigs[:-1, :3, :3], steps)
    far = -0.5 * lengths[:-1] * lengths[1:]
    back = np.sum(steps[:-1] * steps[1:], axis=1) < far
    back &= np.sum(at_rig[:-1] * at_rig[1:], axis=1) < far
    longer = np.maximum(lengths[:-1], lengths[1:])
    # A camera that stands has steps of noise, in any direction.
    back &= np.minimum(lengths[:-1], lengths[1:]) > 0.1 * longer
    back &= longer > _LONG_STEP_DEPTHS * depth
    back &= shown[:-1] & shown[1:]
    found[:-1] |= back
    found[1:] |= back
    return found


def without_steps(coarse: CoarsePoses, trust: StepChecks, steps: np.ndarray) -> StepChecks:
    """Checks after some steps (F - 1,) bool of the images were given up for the trajectory's."""
    slam, chosen = relative_steps(coarse.world_T_rigs), relative_steps(trust.world_T_rigs)
    chosen[steps] = slam[steps]
    named = trust.false_frames.copy()
    named[:-1] &= ~steps
    named[1:] &= ~steps
    return replace(
        trust,
        world_T_rigs=_chain(coarse.world_T_rigs, chosen, coarse.sources == PoseSource.SLAM),
        false_steps=trust.false_steps & ~steps,
        false_frames=named,
        unseen_steps=trust.unseen_steps | steps,
    )


def _from_images_alone(
    coarse: CoarsePoses, slam: np.ndarray, found: Steps, logs: np.ndarray, sigmas: np.ndarray
) -> StepChecks:
    """Initial poses from the steps of the images where known; no step keeps its prior."""
    slam_lengths = np.linalg.norm(slam[:, :3, 3], axis=1)
    lengths = slam_lengths
    if found.directed.any():
        unknown = np.full(len(slam), np.inf)
        lengths = step_lengths(slam_lengths, unknown, logs, sigmas)
    paces, slam = np.broadcast_to(found.paces, len(slam)), slam.copy()
    slam[:, :3, 3] *= paces[:, None]
    lengths = lengths * paces
    chosen = _replaced(slam, found, lengths, found.verified)
    start = _chain(coarse.world_T_rigs, chosen, coarse.sources == PoseSource.SLAM)
    return _without_priors(start, found, lengths)


def _turned(coarse: CoarsePoses, slam: np.ndarray, found: Steps, turn: Turn) -> StepChecks:
    """Initial poses with the rotations of a turn, positions those of the trajectory if any."""
    own, chosen = coarse.sources == PoseSource.SLAM, slam.copy()
    chosen[:, :3, :3] = np.swapaxes(turn.world_R_rigs[:-1], 1, 2) @ turn.world_R_rigs[1:]
    if not own.any():
        chosen[:, :3, 3] = 0
    start = _chain(coarse.world_T_rigs, chosen, own)
    lengths = np.linalg.norm(slam[:, :3, 3], axis=1)
    return replace(_without_priors(start, found, lengths), turn=turn)


def _without_priors(start: np.ndarray, found: Steps, lengths: np.ndarray) -> StepChecks:
    """Checks after which no step of the trajectory keeps its prior."""
    every, nobody = np.ones(len(lengths), bool), np.zeros(len(start), bool)
    return StepChecks(start, every, nobody, ~found.verified, lengths, None)


def leaps(world_T_rigs: np.ndarray, timestamps: np.ndarray) -> np.ndarray:
    """Steps (F - 1,) bool much faster than the rest: without images, they lead into another
    world."""
    lengths = np.linalg.norm(np.diff(world_T_rigs[:, :3, 3], axis=0), axis=1)
    speeds = lengths / np.diff(timestamps)
    return speeds > 4.0 * typical_length(speeds) if speeds.any() else np.zeros(len(speeds), bool)


def _chain(world_T_rigs: np.ndarray, chosen: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Poses (F, 4, 4) that follow the chosen steps, aligned with tracked frames."""
    poses = chained(chosen)
    own = own if own.any() else np.ones(len(own), bool)
    rotation = nearest_rotation(
        np.einsum("fij,fkj->ik", world_T_rigs[own, :3, :3], poses[own, :3, :3])
    )
    positions = poses[:, :3, 3] @ rotation.T
    shift = np.median(world_T_rigs[own, :3, 3] - positions[own], axis=0)
    return pose(rotation @ poses[:, :3, :3], positions + shift)


def false_frames(
    wrong: np.ndarray,
    slam: np.ndarray,
    chosen: np.ndarray,
    own: np.ndarray,
    limits: tuple[float, float],
    noise: Sequence[float],
) -> np.ndarray:
    """Frames (F,) with a false pose: the fewest whose removal explains the steps that are `wrong`
    (F - 1,) bool. Of `own` frames (F,) bool the longest chain is kept whose relative poses agree
    with the images; a permanent jump breaks it, at a cost, and marks the frame behind.

    Args:
        limits: radians of rotation, and position relative to the distance between two frames.
        noise: of one step, rotation (radians) and position (map units): smaller errors are noise.
    """
    named = np.zeros(len(own), bool)
    if not wrong.any():
        return named
    ours = np.flatnonzero(own)
    theirs, images = chained(slam), chained(chosen)
    score, back = np.ones(len(ours)), np.full(len(ours), -1)
    broken = np.zeros(len(ours), bool)
    for n in range(1, len(ours)):
        # more consecutive false frames are a jump
        for m in range(n - 1, max(n - 1 - 12, -1), -1):
            a, b = int(ours[m]), int(ours[n])
            agree = b == a + 1 and not wrong[a]
            agree = agree or _agree(theirs, images, a, b, limits, noise)
            gain = score[m] + 1 - (0 if agree else 1.5)
            if gain > score[n]:
                score[n], back[n], broken[n] = gain, m, not agree
    named[ours] = True
    n = int(np.argmax(score))
    while n >= 0:
        named[ours[n]] = broken[n]
        n = int(back[n])
    return named


def _agree(
    theirs: np.ndarray,
    images: np.ndarray,
    a: int,
    b: int,
    limits: tuple[float, float],
    noise: Sequence[float],
) -> bool:
    """True if a trajectory's relative pose of two frames fits the steps of the images."""
    one, other = inverse(theirs[a]) @ theirs[b], inverse(images[a]) @ images[b]
    turned = rotation_angle(one[:3, :3].T @ other[:3, :3])
    off, length = np.linalg.norm(one[:3, 3] - other[:3, 3]), np.linalg.norm(other[:3, 3])
    walked = np.sqrt(b - a)  # noise of steps accumulates like a random walk
    rotation = max(limits[0], walked * noise[0])
    offset = max(limits[1] * length, walked * noise[1])
    return bool(turned < rotation and off < offset)
