"""Which frames of a trajectory to blame for steps that the images contradict."""

from dataclasses import dataclass

import numpy as np

from gsba.config import VerifySettings
from gsba.geometry import inverse, rotation_angle

_MAX_RUN = 12  # false frames in a row that are told from a jump
_BREAK = 1.5  # price of a jump in frames named
_QUIET = 0.25  # part of the steps that no outlier spoils: the quantile that noise is read from
_NOISE = (
    4.0  # times that quantile: of a drifting trajectory's steps, one in a thousand is further off
)


@dataclass(frozen=True, slots=True)
class Limits:
    """Disagreement of two frames' relative pose with the images that sets it apart."""

    rotation: float  # radians
    offset: float  # part of the distance between the frames
    noise_rotation: float  # radians, of one step: below, it is as noisy as the rest
    noise_offset: float  # the same of its position, map units


def limits(
    slam: np.ndarray, images: np.ndarray, judged: np.ndarray, settings: VerifySettings
) -> Limits:
    """What sets a frame apart: more than the settings allow, and than the rest is off.

    A trajectory that drifts quickly contradicts the images in many steps, each by about as much;
    none of its frames is an outlier. How much that is can be read from its better steps, as
    outliers leave those alone.

    Args:
        slam: (F - 1, 4, 4) steps of the trajectory.
        images: (F - 1, 4, 4) steps that the images show, with lengths.
        judged: (F - 1,) bool, steps of which both are known.
        settings: disagreement that counts as contradiction.
    """
    turned = rotation_angle(np.swapaxes(slam[:, :3, :3], 1, 2) @ images[:, :3, :3])
    off = np.linalg.norm(slam[:, :3, 3] - images[:, :3, 3], axis=1)
    usual = [float(np.quantile(x[judged], _QUIET)) if judged.any() else 0.0 for x in (turned, off)]
    return Limits(
        np.deg2rad(settings.max_rotation_deg),
        float(np.sin(np.deg2rad(settings.max_direction_deg))),
        _NOISE * usual[0],
        _NOISE * usual[1],
    )


def false_frames(
    wrong: np.ndarray,
    slam: np.ndarray,
    chosen: np.ndarray,
    own: np.ndarray,
    limits: Limits,
) -> np.ndarray:
    """Frames (F,) whose own pose is false: the fewest whose absence explains the false steps.

    The longest chain of frames is kept whose relative poses in the trajectory agree with the
    images, from each to the next in the chain; a jump for good breaks it, at a price, and names the
    frame behind. Filled-in poses take no part: they were guesses.

    Args:
        wrong: (F - 1,) bool, steps that the images contradict.
        slam, chosen: (F - 1, 4, 4) steps of the trajectory and what is known of them.
        own: (F,) bool, frames with a pose of the trajectory.
        limits: disagreement that sets a frame apart from the others.
    """
    named = np.zeros(len(own), bool)
    if not wrong.any():
        return named
    ours = np.flatnonzero(own)
    theirs, images = chained(slam), chained(chosen)
    score, back = np.ones(len(ours)), np.full(len(ours), -1)
    broken = np.zeros(len(ours), bool)
    for n in range(1, len(ours)):
        for m in range(n - 1, max(n - 1 - _MAX_RUN, -1), -1):
            a, b = int(ours[m]), int(ours[n])
            agree = (b == a + 1 and not wrong[a]) or _agree(theirs, images, a, b, limits)
            gain = score[m] + 1 - (0 if agree else _BREAK)
            if gain > score[n]:
                score[n], back[n], broken[n] = gain, m, not agree
    named[ours] = True
    n = int(np.argmax(score))
    while n >= 0:
        named[ours[n]] = broken[n]
        n = int(back[n])
    return named


def _agree(theirs: np.ndarray, images: np.ndarray, a: int, b: int, limits: Limits) -> bool:
    """Whether a trajectory's relative pose of two frames fits the steps of the images."""
    one, other = inverse(theirs[a]) @ theirs[b], inverse(images[a]) @ images[b]
    turned = rotation_angle(one[:3, :3].T @ other[:3, :3])
    off, length = np.linalg.norm(one[:3, 3] - other[:3, 3]), np.linalg.norm(other[:3, 3])
    walked = np.sqrt(b - a)  # noise of steps adds up like a random walk's
    rotation = max(limits.rotation, walked * limits.noise_rotation)
    offset = max(limits.offset * length, walked * limits.noise_offset)
    return bool(turned < rotation and off < offset)


def chained(steps: np.ndarray) -> np.ndarray:
    """Poses (F, 4, 4) that follow steps (F - 1, 4, 4), the first the identity."""
    poses = [np.eye(4)]
    for step in steps:
        poses.append(poses[-1] @ step)
    return np.array(poses)
