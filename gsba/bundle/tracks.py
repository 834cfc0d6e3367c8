"""Chain pairwise matches into tracks of one scene point each."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from factors.compiled import kernel_and_part
from factors.threads import map_in_threads
from gsba.disk import concatenated
from gsba.memory import release_mapped_files
from gsba.types import Matches, Tracks
from gsba.types.records import slices

T = TypeVar("T")
_kernel, _ = kernel_and_part()
_AT_ONCE = 1 << 18  # matches that are numbered together
_OF_THREAD = 1 << 14  # observations that one thread works on: 2 MB of rays
_RELEASED_EVERY = 16  # of these runs, pages of files that they have read
MAX_IN_MEMORY = 1 << 18  # observations of which the tracks are in memory in any case


def build(
    matches: Sequence[Matches], num_keypoints: np.ndarray, scratch: Path | None = None
) -> Tracks:
    """Merge matches into tracks of at least two observations that see a frame at most once;
    num_keypoints: (F,) of each frame; a folder on the disk takes very many tracks, None = they are
    in memory.

    Matches are taken in the order given, the most trusted set and pair first: one that would give a
    track two keypoints of the same frame is left out, so that a false match cannot glue two points.
    """
    first_node = np.concatenate([[0], np.cumsum(num_keypoints)]).astype(np.int64)
    number = np.int32 if first_node[-1] < np.iinfo(np.int32).max else np.int64
    first_node = first_node.astype(number)
    matched = np.zeros(first_node[-1], bool)
    for edges in _edges(matches, first_node):
        matched[edges] = True
    nodes = np.flatnonzero(matched).astype(number)  # all others are tracks of their own
    place = np.cumsum(matched, dtype=number) - 1
    of_frames = np.diff(np.searchsorted(nodes, first_node))
    frame_of_node = np.repeat(np.arange(len(of_frames), dtype=np.int32), of_frames)
    roots = np.arange(len(nodes), dtype=number)
    following, sizes = roots.copy(), np.ones_like(roots)
    for edges in _edges(matches, first_node):
        _merge(place[edges], frame_of_node, roots, following, sizes)
    del matched, place, following
    several = (sizes > 1) & (roots == np.arange(len(roots), dtype=number))
    lengths = sizes[several].astype(np.int64)
    del sizes
    numbers = np.cumsum(several, dtype=np.int32) - np.int32(1)
    numbers[~several] = -1
    rows = np.cumsum(lengths) - lengths
    points, frames, keypoints = np.empty((3, int(lengths.sum())), np.int32)
    _collect(nodes, frame_of_node, roots, numbers, first_node, rows, points, frames, keypoints)
    del nodes, frame_of_node, roots, numbers, several, rows
    if scratch is not None and len(points) > MAX_IN_MEMORY:
        points, frames, keypoints = concatenated([(points, frames, keypoints)], scratch)
    return Tracks(points, frames, keypoints, len(lengths))


def _edges(matches: Sequence[Matches], first_node: np.ndarray) -> Iterator[np.ndarray]:
    """Nodes (M, 2), keypoints of all frames, of all matches in their order, some at a time."""
    for part in matches:
        for some in slices(len(part.keypoints), _AT_ONCE):
            first = int(np.searchsorted(part.offsets, some.start, side="right")) - 1
            last = int(np.searchsorted(part.offsets, some.stop))
            lengths = np.diff(np.clip(part.offsets[first : last + 1], some.start, some.stop))
            frames = np.repeat(part.pairs[first:last], lengths, axis=0)
            yield first_node[frames] + part.keypoints[some]
            release_mapped_files()


def tied_steps(tracks: Tracks, num_frames: int) -> np.ndarray:
    """True (num_frames - 1,) for steps whose two frames observe a point in common; none of those
    from one map to another, laid beside it, does."""
    tied = np.zeros(num_frames - 1, bool)
    for some in slices(len(tracks) - 1, _AT_ONCE):
        frames, after = tracks.frames[some], slice(some.start + 1, some.stop + 1)
        same = tracks.points[some] == tracks.points[after]
        tied[frames[same & (frames + 1 == tracks.frames[after])]] = True
        if tied.all():
            break
    return tied


def runs(tracks: Tracks, most: int) -> Iterator[tuple[slice, slice, Tracks]]:
    """Tracks in runs of at most `most` observations, or of a single longer one: the points of a
    run, its observations, and its tracks, whose points are numbered from 0."""
    for points, rows in _bounds_of_runs(tracks, most):
        yield points, rows, _run_of(tracks, points, rows)


def map_runs(
    work: Callable[[slice, slice, Tracks], T], tracks: Tracks, num_threads: int
) -> Iterator[T]:
    """Results of work on each of the `runs`, in order, computed in threads, between which pages of
    files are released; work must not use threads itself."""
    bounds = _bounds_of_runs(tracks, _OF_THREAD)
    found = map_in_threads(
        lambda n: work(*bounds[n], _run_of(tracks, *bounds[n])), len(bounds), num_threads
    )
    for n, one in enumerate(found):
        yield one
        if n % _RELEASED_EVERY == 0:
            release_mapped_files()


def _bounds_of_runs(tracks: Tracks, most: int) -> list[tuple[slice, slice]]:
    """Points and observations of each of the `runs`."""
    numbers = np.arange(tracks.num_points + 1, dtype=tracks.points.dtype)  # else points are copied
    starts = np.searchsorted(tracks.points, numbers)
    first, found = 0, []
    while first < tracks.num_points:
        last = int(np.searchsorted(starts, starts[first] + most, side="right")) - 1
        last = min(max(last, first + 1), tracks.num_points)
        found.append((slice(first, last), slice(int(starts[first]), int(starts[last]))))
        first = last
    return found


def _run_of(tracks: Tracks, points: slice, rows: slice) -> Tracks:
    """Tracks of the points of a run, numbered from 0."""
    numbers = tracks.points[rows] - np.int32(points.start)
    return Tracks(numbers, tracks.frames[rows], tracks.keypoints[rows], points.stop - points.start)


@_kernel
def _merge(edges, frame_of_node, roots, following, sizes):
    """Merge edges that keep frames unique in a component, and set the root node of every node.

    Components are circular linked lists, so that joining two of them swaps two links. At first,
    each node is a component: its own root, followed by itself, of size one.
    """
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


@_kernel
def _collect(nodes, frame_of_node, roots, numbers, first_node, rows, points, frames, keypoints):
    """Write the observations of all tracks, by track, then by frame.

    `numbers` are those of tracks, by their root, -1 for single nodes; `rows` (J,) begins as the
    first row of each track.
    """
    for n in range(len(roots)):
        track, frame = numbers[roots[n]], frame_of_node[n]
        if track >= 0:
            row = rows[track]
            points[row], frames[row] = track, frame
            keypoints[row] = nodes[n] - first_node[frame]
            rows[track] += 1
