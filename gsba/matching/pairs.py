"""Which frames to match with which."""

from collections.abc import Iterator, Mapping

import numpy as np

from gsba.config import PairSettings

_GAPS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
_SURROUNDINGS = (1.0, 0.5, 0.25)  # parts of the reach in which a place counts as met again


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


def last_visits(
    rigs_in_world: np.ndarray, median_depth: float, settings: PairSettings
) -> np.ndarray:
    """Pairs that close loops with as little drift between their frames as there can be.

    A frame is paired with the visit to its surroundings that was last: however often a place is met
    again, each visit has its own pairs with the one before. Surroundings are taken widely and more
    closely, as what was last near may lie behind a wall.

    Args:
        rigs_in_world, median_depth, settings: as for `covisible`.

    Returns:
        Pairs (L, 2) int32, f0 < f1, the closest in space first.
    """
    found: dict[tuple[int, int], float] = {}
    if settings.max_loop_neighbours == 0:
        return _closest_first(found)
    reach = settings.max_baseline_depths * median_depth
    for f, (near, distances) in enumerate(_surroundings(rigs_in_world, reach)):
        earlier = near < f - settings.window
        for share in _SURROUNDINGS:
            rows = np.flatnonzero(earlier & (distances <= share * reach))
            visits = np.split(rows, np.flatnonzero(np.diff(near[rows]) > 1) + 1)
            if len(rows):
                row = visits[-1][np.argmin(distances[visits[-1]])]
                found[int(near[row]), f] = float(distances[row])
    return _closest_first(found)


def unlinked(chosen: np.ndarray, linked: np.ndarray, settings: PairSettings) -> np.ndarray:
    """Rows of pairs (P, 2) whose later frame has no loop (L, 2) to an earlier one, nor those
    around it."""
    around = settings.window // 4
    has = np.sort(linked[:, 1])
    first = np.searchsorted(has, chosen[:, 1] - around)
    return np.flatnonzero(np.searchsorted(has, chosen[:, 1] + around, "right") == first)


def by_place(pairs: np.ndarray, num_frames: int) -> tuple[np.ndarray, np.ndarray]:
    """An order of pairs in which each frame is wanted for a short while only.

    Pairs of frames close in time come first, one frame after the other. For the others, frames are
    numbered so that those with a pair get numbers close to one another (Cuthill and McKee, 1969):
    all visits to a place follow one another.

    Args:
        pairs: (P, 2) frame indices.
        num_frames: F.

    Returns:
        The order (P,), and for each pair in that order the number of the frame that it goes with,
        ascending: below F where it is that of a frame in time.
    """
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    close = np.abs(pairs[:, 1] - pairs[:, 0]) <= _GAPS[-1]
    far = pairs[~close]
    ends = np.concatenate([far, far[:, ::-1]])
    graph = csr_matrix((np.ones(len(ends)), ends.T), shape=(num_frames, num_frames))
    numbers = np.empty(num_frames, np.int64)
    numbers[reverse_cuthill_mckee(graph, symmetric_mode=True)] = np.arange(num_frames)
    placed = num_frames + np.sort(numbers[pairs], axis=1)
    first, second = np.where(close[:, None], pairs, placed).T
    order = np.lexsort((second, first))
    return order, first[order]


def _loops(rigs_in_world: np.ndarray, reach: float, settings: PairSettings) -> np.ndarray:
    """Nearest neighbours in space that are further apart in time than the window."""
    found: dict[tuple[int, int], float] = {}
    for f, (near, distances) in enumerate(_surroundings(rigs_in_world, reach)):
        apart = np.abs(near - f) > settings.window
        near, distances = near[apart], distances[apart]
        for n in np.argsort(distances, kind="stable")[: settings.max_loop_neighbours]:
            g = int(near[n])
            found[min(f, g), max(f, g)] = float(distances[n])
    return _closest_first(found)


def _surroundings(
    rigs_in_world: np.ndarray, reach: float
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """For each frame those within reach (N,), ascending, and their distances (N,)."""
    from scipy.spatial import KDTree

    tree = KDTree(rigs_in_world)
    for position in rigs_in_world:
        near = np.array(tree.query_ball_point(position, reach, return_sorted=True), np.int64)
        yield near, np.linalg.norm(rigs_in_world[near] - position, axis=1)


def _closest_first(found: Mapping[tuple[int, int], float]) -> np.ndarray:
    """Pairs (P, 2) int32 by their distances."""
    ordered = sorted(found, key=lambda pair: (found[pair], pair))
    return np.array(ordered, np.int32).reshape(-1, 2)
