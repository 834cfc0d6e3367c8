"""Paths that come back to where they have been, as far as their trajectory knows."""

import numpy as np

_MAX_GAP_SHARE = 0.1  # largest distance of two positions at one place, part of the path between
# them: the trajectory drifts by less
_MIN_PATH_SHARE = 0.5  # of the whole path, that lies between them at least: shorter detours leave
# the rest open
_MAX_POSITIONS = 500  # compared with one another, evenly chosen


def comes_back(positions: np.ndarray) -> bool:
    """True if a path returns to a place after at least half of its length, or does not move.

    Args:
        positions: (F, 3) world, in order of time.
    """
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    if not along[-1] > 0:
        return True
    num = len(positions)
    chosen = np.unique(np.linspace(0, num - 1, min(num, _MAX_POSITIONS)).astype(int))
    places, along = positions[chosen], along[chosen]
    distances = np.linalg.norm(places[:, None] - places, axis=2)
    between = np.abs(along[:, None] - along)
    met = (distances < _MAX_GAP_SHARE * between) & (between > _MIN_PATH_SHARE * along[-1])
    return bool(met.any())
