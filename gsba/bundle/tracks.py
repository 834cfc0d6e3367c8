"""Chain pairwise matches into tracks of one scene point each."""

from collections.abc import Iterator, Sequence

import numpy as np

from factors.compiled import kernel_and_part
from gsba.types import Matches, Tracks

_kernel, _ = kernel_and_part()


def build(matches: Sequence[Matches], num_keypoints: np.ndarray) -> Tracks:
    """Merge matches into tracks that see a frame at most once.

    Matches are taken in the order given, the most trusted first: one that would give a track two
    keypoints of the same frame is left out, so that a false match cannot glue two points.

    Args:
        matches: sets of verified matches, the most trusted set and pair first.
        num_keypoints: (F,) keypoints in each frame.

    Returns:
        Tracks of at least two observations.
    """
    first_node = np.concatenate([[0], np.cumsum(num_keypoints)]).astype(np.int64)
    number = np.int32 if first_node[-1] < np.iinfo(np.int32).max else np.int64
    first_node = first_node.astype(number)
    edges = np.empty((sum(len(part.keypoints) for part in matches), 2), number)
    first = 0
    for part in matches:
        rows = slice(first, first + len(part.keypoints))
        pairs = np.repeat(part.pairs, np.diff(part.offsets), axis=0)
        edges[rows], first = first_node[pairs] + part.keypoints, rows.stop
    frame_of_node = np.repeat(np.arange(len(num_keypoints), dtype=np.int32), num_keypoints)
    roots = np.arange(len(frame_of_node), dtype=number)
    _merge(edges, frame_of_node, roots)
    del edges
    several = np.bincount(roots, minlength=len(roots)) > 1
    nodes = np.flatnonzero(several[roots])
    points = (np.cumsum(several, dtype=number) - 1)[roots[nodes]]
    order = np.argsort(points, kind="stable")
    nodes, points = nodes[order], points[order]
    frames = frame_of_node[nodes]
    return Tracks(
        points.astype(np.int32),
        frames,
        (nodes - first_node[frames]).astype(np.int32),
        int(points[-1]) + 1 if len(points) else 0,
    )


def runs(tracks: Tracks, most: int) -> Iterator[tuple[slice, slice, Tracks]]:
    """Tracks in runs of at most `most` observations, or of a single longer one.

    Yields:
        The points of a run, its observations, and its tracks, whose points are numbered from 0.
    """
    starts = np.searchsorted(tracks.points, np.arange(tracks.num_points + 1))
    first = 0
    while first < tracks.num_points:
        last = int(np.searchsorted(starts, starts[first] + most, side="right")) - 1
        last = min(max(last, first + 1), tracks.num_points)
        rows = slice(int(starts[first]), int(starts[last]))
        points = tracks.points[rows] - np.int32(first)
        own = Tracks(points, tracks.frames[rows], tracks.keypoints[rows], last - first)
        yield slice(first, last), rows, own
        first = last


@_kernel
def _merge(edges, frame_of_node, roots):
    """Merge edges that keep frames unique in a component, and set the root node of every node.

    Each node is its own root at first.

    Components are circular linked lists, so that joining two of them swaps two links.
    """
    following, sizes = roots.copy(), np.ones_like(roots)
    for e in range(len(edges)):
        big, small = roots[edges[e, 0]], roots[edges[e, 1]]
        if big == small:
            continue
        if sizes[big] < sizes[small]:
            big, small = small, big
        clash = False
        node = small
        for _ in range(sizes[small]):
            other = big
            for _ in range(sizes[big]):
                if frame_of_node[other] == frame_of_node[node]:
                    clash = True
                    break
                other = following[other]
            if clash:
                break
            node = following[node]
        if clash:
            continue
        node = small
        for _ in range(sizes[small]):
            roots[node] = big
            node = following[node]
        sizes[big] += sizes[small]
        following[big], following[small] = following[small], following[big]
