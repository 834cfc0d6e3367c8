"""Which frames of a trajectory to blame for steps that the images contradict."""

import numpy as np

from gsba.config import VerifySettings
from gsba.geometry import inverse, rotation_angle

_MAX_RUN = 12  # false frames in a row that are told from a jump
_BREAK = 1.5  # price of a jump in frames named


def false_frames(
    wrong: np.ndarray,
    slam: np.ndarray,
    chosen: np.ndarray,
    own: np.ndarray,
    settings: VerifySettings,
) -> np.ndarray:
    """Frames (F,) whose own pose is false: the fewest whose absence explains the false steps.

    The longest chain of frames is kept whose relative poses in the trajectory agree with the
    images, from each to the next in the chain; a jump for good breaks it, at a price, and names the
    frame behind. Filled-in poses take no part: they were guesses.

    Args:
        wrong: (F - 1,) bool, steps that the images contradict.
        slam, chosen: (F - 1, 4, 4) steps of the trajectory and what is known of them.
        own: (F,) bool, frames with a pose of the trajectory.
        settings: disagreement that counts as contradiction.
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
            agree = not wrong[a] if b == a + 1 else _agree(theirs, images, a, b, settings)
            gain = score[m] + 1 - (0 if agree else _BREAK)
            if gain > score[n]:
                score[n], back[n], broken[n] = gain, m, not agree
    named[ours] = True
    n = int(np.argmax(score))
    while n >= 0:
        named[ours[n]] = broken[n]
        n = int(back[n])
    return named


def _agree(
    theirs: np.ndarray, images: np.ndarray, a: int, b: int, settings: VerifySettings
) -> bool:
    """Whether a trajectory's relative pose of two frames fits the steps of the images."""
    one, other = inverse(theirs[a]) @ theirs[b], inverse(images[a]) @ images[b]
    turned = rotation_angle(one[:3, :3].T @ other[:3, :3])
    off, length = np.linalg.norm(one[:3, 3] - other[:3, 3]), np.linalg.norm(other[:3, 3])
    allowed = np.sin(np.deg2rad(settings.max_direction_deg)) * length
    return bool(turned < np.deg2rad(settings.max_rotation_deg) and off < allowed)


def chained(steps: np.ndarray) -> np.ndarray:
    """Poses (F, 4, 4) that follow steps (F - 1, 4, 4), the first the identity."""
    poses = [np.eye(4)]
    for step in steps:
        poses.append(poses[-1] @ step)
    return np.array(poses)
