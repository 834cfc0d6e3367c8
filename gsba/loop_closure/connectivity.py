"""Connected components of frames, tied by images or steps; matches within components."""

import numpy as np

from gsba.types import Matches, Tracks

MIN_MAP_FRAMES = 3  # least frames of a part that count as a map


def parted(
    pairs: np.ndarray, held: np.ndarray, scarce: np.ndarray | None = None
) -> np.ndarray | None:
    """Component (F,) int64 of each frame, 0 = the largest; None = there is one.
    pairs: (P, 2) frames tied by images.
    held: (F - 1,) bool, steps that tie their frames without images.
    scarce: (F,) bool, frames that are components of their own despite pairs.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    num, steps = len(held) + 1, np.flatnonzero(held)
    rows, columns = np.concatenate([pairs.reshape(-1, 2), np.column_stack([steps, steps + 1])]).T
    if scarce is not None:
        fed = ~(scarce[rows] | scarce[columns])
        rows, columns = rows[fed], columns[fed]
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(num, num))
    return several(by_size(connected_components(graph, directed=False)[1]))


def maps_of_images(pairs: np.ndarray, num_frames: int) -> np.ndarray:
    """Map (F,) int64 of each frame that pairs (P, 2) of images tie together; -1 = of too few
    frames."""
    parts = parted(pairs, np.zeros(num_frames - 1, bool))
    if parts is None:
        return np.zeros(num_frames, np.int64)
    return np.where(np.bincount(parts)[parts] < MIN_MAP_FRAMES, -1, parts)


def several(found: np.ndarray) -> np.ndarray | None:
    """Labels, or None if all are equal."""
    return found if (found != found[0]).any() else None


def by_size(found: np.ndarray) -> np.ndarray:
    """Labels (F,) renumbered by descending frequency."""
    _, first, inverse_, counts = np.unique(
        found, return_index=True, return_inverse=True, return_counts=True
    )
    ranks = np.empty(len(counts), np.int64)
    ranks[np.lexsort((first, -counts))] = np.arange(len(counts))
    return ranks[inverse_]


def within(matches: Matches, parts: np.ndarray | None) -> Matches:
    """Matches of pairs whose frames are in one part (F,); None = there is one."""
    if parts is None:
        return matches
    keep = np.flatnonzero(parts[matches.pairs[:, 0]] == parts[matches.pairs[:, 1]])
    if len(keep) == len(matches.pairs):
        return matches
    return matches.taken(keep)


def bridging(tracks: Tracks, num_frames: int) -> np.ndarray:
    """Number (F,) of points that carry the scale across each frame: seen from three or more frames,
    some before and some after it."""
    first = np.flatnonzero(np.diff(tracks.points, prepend=-1))
    if not len(first):
        return np.zeros(num_frames, np.int64)
    last = np.append(first[1:], len(tracks.points)) - 1
    several_views = last - first >= 2
    starts, ends = tracks.frames[first[several_views]], tracks.frames[last[several_views]]
    changes = np.bincount(starts + 1, minlength=num_frames + 1)
    changes -= np.bincount(ends, minlength=num_frames + 1)
    return np.cumsum(changes)[:num_frames]
