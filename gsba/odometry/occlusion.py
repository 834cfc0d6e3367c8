"""Parts of the sphere in which known points vanish from one frame to the next: a hand, a passer-by.

What is seen there afterwards may move on its own. Its features are followed without a say in poses
until most of them agree with the poses that all other features give.
"""

import numpy as np

_DIRECTIONS = 60  # centres of caps, spread evenly over the sphere
_MIN_COSINE = np.cos(np.deg2rad(60.0))  # of a cap: a quarter of the sphere
_MIN_JUDGED = 10  # points, or new features, of a cap that is judged
_GONE_SHARE = 0.15  # of a cap's points in the frame before, at most found where it is covered
_MIN_CAPS = 6  # covered at once: where walls are bare, the points of three may vanish behind a post
_CLEAR_SHARE = 0.6  # of a cap's new features, that agree where it shows the scene


class Occlusion:
    """Which part of the sphere, rig frame, is covered.

    Args:
        memory: frames after which what covers the scene grows no further.
    """

    def __init__(self, memory: int) -> None:
        self._memory = memory
        self._covered = np.zeros(_DIRECTIONS, bool)
        self._since = -1  # index of the frame in which covering began
        self._latest = np.zeros(_DIRECTIONS, bool)  # caps whose points vanished in the last frame

    def update(self, frame: int, bearings_rig: np.ndarray, fits: np.ndarray) -> bool:
        """Update the covered caps from a frame; True if more of them are covered than before.

        Args:
            frame: its index.
            bearings_rig: (N, 3) unit, where points found in the frame before should be.
            fits: (N,) bool, which of them were found there.
        """
        within = _within_caps(bearings_rig)
        expected, found = within.sum(axis=0), within[fits].sum(axis=0)
        gone = (expected >= _MIN_JUDGED) & (found <= _GONE_SHARE * expected)
        grows = self._covered.any() and frame - self._since < self._memory
        before = np.count_nonzero(self._covered)
        if np.count_nonzero(gone) >= _MIN_CAPS:
            self._since = frame
            self._covered |= gone | self._latest
        elif grows:
            self._covered |= gone
        self._latest = gone
        return bool(np.count_nonzero(self._covered) > before)

    def covers(self, bearings_rig: np.ndarray) -> np.ndarray:
        """Which bearings (N, 3), rig frame, are covered, (N,) bool."""
        return np.asarray(_within_caps(bearings_rig)[:, self._covered].any(axis=1))

    def clear(self, bearings_rig: np.ndarray, agree: np.ndarray) -> None:
        """Uncover caps by their new features.

        Args:
            bearings_rig: (N, 3) of new features that tell whether they move on their own.
            agree: (N,) bool, those that do not.
        """
        within = _within_caps(bearings_rig)
        judged, agreeing = within.sum(axis=0), within[agree].sum(axis=0)
        clear = (judged >= _MIN_JUDGED) & (agreeing >= _CLEAR_SHARE * judged)
        self._covered &= ~clear


def _within_caps(bearings: np.ndarray) -> np.ndarray:
    """Which caps (N, D) bool bearings (N, 3) lie in; a Fibonacci lattice of centres."""
    number = np.arange(_DIRECTIONS) + 0.5
    height = 1 - 2 * number / _DIRECTIONS
    around, level = np.pi * (1 + np.sqrt(5)) * number, np.sqrt(1 - height**2)
    centres = np.stack([level * np.cos(around), height, level * np.sin(around)], axis=1)
    return bearings @ centres.T > _MIN_COSINE
