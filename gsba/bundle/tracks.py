"""Chain pairwise matches into tracks of one scene point each."""

from collections.abc import Iterator, Sequence

import numpy as np

from factors.compiled import kernel_and_part
from gsba.memory import release_mapped_files
from gsba.types import Matches, Tracks
from gsba.types.records import slices

_kernel, _ = kernel_and_part()
_AT_ONCE = 1 << 20  # matches that are numbered together


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
    edges = _edges(matches, first_node)
    matched = np.zeros(first_node[-1], bool)
    matched[edges[:, 0]], matched[edges[:, 1]] = True, True
    nodes = np.flatnonzero(matched).astype(number)  # all others are tracks of their own
    place = np.cumsum(matched, dtype=number) - 1
    for some in slices(len(edges), _AT_ONCE):
        edges[some] = place[edges[some]]
    del matched, place
    of_frames = np.diff(np.searchsorted(nodes, first_node))
    frame_of_node = np.repeat(np.arange(len(of_frames), dtype=np.int32), of_frames)
    roots = np.arange(len(nodes), dtype=number)
    _merge(edges, frame_of_node, roots)
    del edges
    several = np.zeros(len(roots), bool)
    several[roots[roots != np.arange(len(roots), dtype=number)]] = True
    chosen = np.flatnonzero(several[roots]).astype(number)
    points = (np.cumsum(several, dtype=number) - 1)[roots[chosen]]
    order = np.argsort(points, kind="stable")
    chosen, points = chosen[order], points[order]
    frames = frame_of_node[chosen]
    return Tracks(
        points.astype(np.int32),
        frames,
        (nodes[chosen] - first_node[frames]).astype(np.int32),
        int(points[-1]) + 1 if len(points) else 0,
    )


def _edges(matches: Sequence[Matches], first_node: np.ndarray) -> np.ndarray:
    """Nodes (M, 2) of all matches, one set after the other; a node is a keypoint of all frames'."""
    edges = np.empty((sum(len(part.keypoints) for part in matches), 2), first_node.dtype)
    first = 0
    for part in matches:
        pair_of_row = np.repeat(np.arange(len(part.pairs), dtype=np.int32), np.diff(part.offsets))
        for some in slices(len(part.keypoints), _AT_ONCE):
            rows = slice(first + some.start, first + some.stop)
            edges[rows] = first_node[part.pairs[pair_of_row[some]]] + part.keypoints[some]
            release_mapped_files()
        first += len(part.keypoints)
    return edges


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
