"""Which frames to match with which."""

import numpy as np

from gsba.config import PairSettings

_GAPS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)


def adjacent(num_frames: int, reach: int = 2) -> np.ndarray:
    """Pairs (P, 2) int32 of frames at most `reach` apart in time, the closest in time first."""
    rows = [(f, f + gap) for gap in range(1, reach + 1) for f in range(num_frames - gap)]
    return np.array(rows, np.int32).reshape(-1, 2)


def covisible(
    rigs_in_world: np.ndarray, median_depth: float, settings: PairSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs that should see the same things, in time and in space.

    Args:
        rigs_in_world: (F, 3) positions, map units.
        median_depth: median distance of scene points from the frames that see them.
        settings: reach in depths, and how many neighbours in space.

    Returns:
        Pairs within a time window (P, 2) int32 and pairs that close loops (L, 2) int32, each with
        f0 < f1, the closest in time or space first.
    """
    num = len(rigs_in_world)
    reach = settings.max_baseline_depths * median_depth
    window = np.array(
        [(f, f + gap) for gap in _GAPS if gap <= settings.window for f in range(num - gap)],
        np.int32,
    ).reshape(-1, 2)
    lengths = np.linalg.norm(rigs_in_world[window[:, 0]] - rigs_in_world[window[:, 1]], axis=1)
    window = window[(lengths < reach) | (window[:, 1] - window[:, 0] <= 2)]
    return window, _loops(rigs_in_world, reach, settings)


def _loops(rigs_in_world: np.ndarray, reach: float, settings: PairSettings) -> np.ndarray:
    """Nearest neighbours in space that are further apart in time than the window."""
    from scipy.spatial import KDTree

    tree = KDTree(rigs_in_world)
    found: dict[tuple[int, int], float] = {}
    for f, position in enumerate(rigs_in_world):
        near = [g for g in tree.query_ball_point(position, reach) if abs(g - f) > settings.window]
        distances = np.linalg.norm(rigs_in_world[near] - position, axis=1)
        for n in np.argsort(distances)[: settings.max_loop_neighbours]:
            found[min(f, near[n]), max(f, near[n])] = float(distances[n])
    ordered = sorted(found, key=lambda pair: (found[pair], pair))
    return np.array(ordered, np.int32).reshape(-1, 2)
