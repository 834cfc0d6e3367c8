"""Selection of the frame pairs to match."""

from collections.abc import Callable

import numpy as np

from gsba.config import PairSettings

MAX_BASELINE_DEPTHS = 2.0  # longest baseline in median scene depths: views still overlap
_FRAME_GAPS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
MAX_INTERVALS = 2.5  # largest interval between neighbours, in median intervals


def adjacent(num_frames: int, reach: int = 2) -> np.ndarray:
    """Pairs (P, 2) int32 of frames at most `reach` apart in time, the closest in time first."""
    rows = [(f, f + gap) for gap in range(1, reach + 1) for f in range(num_frames - gap)]
    return np.array(rows, np.int32).reshape(-1, 2)


def without_pause(timestamps: np.ndarray, max_intervals: float = MAX_INTERVALS) -> np.ndarray:
    """Pairs (P, 2) int64 of neighbours in time, timestamps (F,) in seconds, without a pause between
    them: an interval of more than so many median ones."""
    intervals = np.diff(timestamps)
    close = np.flatnonzero(intervals <= max_intervals * np.median(intervals))
    return np.column_stack([close, close + 1])


def covisible(
    rigs_in_world: np.ndarray, median_depth: float, settings: PairSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs that should see the same things: within a time window (P, 2) int32, and those that
    close loops (L, 2) int32, each with f0 < f1, the closest in time or space first.

    Args:
        rigs_in_world: (F, 3) positions, map units.
        median_depth: median distance of scene points from the frames that see them.
    """
    num = len(rigs_in_world)
    reach = MAX_BASELINE_DEPTHS * median_depth
    window = np.array(
        [(f, f + gap) for gap in _FRAME_GAPS if gap <= settings.window for f in range(num - gap)],
        np.int32,
    ).reshape(-1, 2)
    lengths = np.linalg.norm(rigs_in_world[window[:, 0]] - rigs_in_world[window[:, 1]], axis=1)
    window = window[(lengths < reach) | (window[:, 1] - window[:, 0] <= 2)]
    return window, _nearest(
        rigs_in_world, reach, settings, lambda f, near, _: np.abs(near - f) > settings.window
    )


def across(
    rigs_in_world: np.ndarray, median_depth: float, settings: PairSettings, parts: np.ndarray
) -> np.ndarray:
    """Pairs (P, 2) int32, f0 < f1, the closest in space first, of frames of different parts (F,)
    that should see the same things; see `covisible`."""
    reach = MAX_BASELINE_DEPTHS * median_depth
    return _nearest(rigs_in_world, reach, settings, lambda f, near, _: parts[near] != parts[f])


def closing(rigs_in_world: np.ndarray, median_depth: float, settings: PairSettings) -> np.ndarray:
    """Pairs (L, 2) int32, f0 < f1, the closest in space first, that close loops while drift between
    far frames is unknown; see `covisible`.

    However often a place is revisited, each visit is paired with the previous and the next one
    only: drift is least between these, and they imply the others.
    """

    def next_visits(f: int, near: np.ndarray, distances: np.ndarray) -> np.ndarray:
        apart = np.abs(near - f) > settings.window
        met = near[apart & (distances <= 0.125 * reach)]  # positions that count as the same place
        last = met[met < f].max(initial=0) - settings.window
        following = met[met > f].min(initial=len(rigs_in_world)) + settings.window
        return apart & (near >= last) & (near <= following)

    reach = MAX_BASELINE_DEPTHS * median_depth
    return _nearest(rigs_in_world, reach, settings, next_visits)


def thinned(pairs: np.ndarray, unpredicted: np.ndarray, most: int) -> np.ndarray:
    """True (P,) for pairs (P, 2) to match, the most promising first, of which many would show the
    same without any prediction: of those that are unpredicted (P,), `most` are kept for each frame,
    and more where its partner has fewer."""
    kept, times = ~unpredicted, np.zeros(pairs.max(initial=-1) + 1, int)
    for p in np.flatnonzero(unpredicted):
        kept[p] = times[pairs[p]].min() < most
        times[pairs[p]] += kept[p]
    return kept


def by_place(pairs: np.ndarray, num_frames: int) -> tuple[np.ndarray, np.ndarray]:
    """An order (P,) of pairs (P, 2) in which each frame is needed for a short while only, and for
    each pair in that order the number of the frame it is grouped with, ascending: below F where it
    is that of a frame in time.

    Pairs of frames close in time come first, one frame after the other. For the others, frames are
    numbered so that those with a pair get numbers close to one another (Cuthill and McKee, 1969):
    all visits to a place are consecutive.
    """
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    close = np.abs(pairs[:, 1] - pairs[:, 0]) <= _FRAME_GAPS[-1]
    far = pairs[~close]
    ends = np.concatenate([far, far[:, ::-1]])
    graph = csr_matrix((np.ones(len(ends)), ends.T), shape=(num_frames, num_frames))
    numbers = np.empty(num_frames, np.int64)
    numbers[reverse_cuthill_mckee(graph, symmetric_mode=True)] = np.arange(num_frames)
    placed = num_frames + np.sort(numbers[pairs], axis=1)
    first, second = np.where(close[:, None], pairs, placed).T
    order = np.lexsort((second, first))
    return order, first[order]


def _nearest(
    rigs_in_world: np.ndarray,
    reach: float,
    settings: PairSettings,
    chosen: Callable[[int, np.ndarray, np.ndarray], np.ndarray],
) -> np.ndarray:
    """Pairs (L, 2) int32 of each frame and its nearest by `chosen(frame, within, distances)`."""
    from scipy.spatial import KDTree

    tree = KDTree(rigs_in_world)
    found: dict[tuple[int, int], float] = {}
    for f, position in enumerate(rigs_in_world):
        near = np.array(tree.query_ball_point(position, reach, return_sorted=True), np.int64)
        distances = np.linalg.norm(rigs_in_world[near] - position, axis=1)
        rows = np.flatnonzero(chosen(f, near, distances))
        for row in rows[np.argsort(distances[rows])[: settings.max_loop_neighbours]]:
            g = int(near[row])
            found[min(f, g), max(f, g)] = float(distances[row])
    ordered = sorted(found, key=lambda pair: (found[pair], pair))
    return np.array(ordered, np.int32).reshape(-1, 2)
