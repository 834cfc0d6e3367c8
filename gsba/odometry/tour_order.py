"""The order of a tour's stills by their likeness, where their names give none.

Frames that show the same things have mutual nearest descriptors that are more alike than any other
keypoint of their own frame is. The way is the path through all frames along which neighbours are
most alike. It only proposes steps; places confirm them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from factors.threads import map_in_threads
from gsba.matching.guided_search import mutual_nearest
from gsba.odometry.tour_steps import TourFrame

_MIN_COSINE, _MIN_COSINE_LEAD = 0.75, 0.05  # of matches; over look-alikes within a frame
MIN_FRAMES = 12  # fewer are taken in the order given, which is doubted at most
_MAX_FRAMES = 60  # most frames whose order is searched: each is compared with all
_REACH = 3.0  # frames along a way over which likeness fades
_NUM_RANDOM, _MAX_BETTER_SHARE = 1000, 0.001  # random orders; of them above one that is believed
_MAX_BETTER_SHARE_OF_FEW = 0.05  # in flats, 8 stills and more in order have up to .064
_MAX_MOVED = 3  # frames in a row that are moved at once to make a path better
_MIN_GAIN = 1e-9


@dataclass(frozen=True, slots=True)
class Likeness:
    """Likeness of all pairs of a tour's frames."""

    alike: np.ndarray  # (F, F) see `likeness`


def may_lack_order(num_frames: int) -> bool:
    """True for as many frames as an order is told from none and found of."""
    return MIN_FRAMES <= num_frames <= _MAX_FRAMES


def likeness(frames: Sequence[TourFrame], num_threads: int = 1) -> np.ndarray:
    """Likeness (F, F) of frames: matches, by the square root of both frames' means. Its diagonal is
    0."""
    pairs, counts = list(combinations(range(len(frames)), 2)), np.zeros((len(frames),) * 2)

    def count(p: int) -> int:
        return _num_matches(*(frames[f] for f in pairs[p]))

    found = map_in_threads(count, len(pairs), num_threads)
    for (f, g), num in zip(pairs, found, strict=True):
        counts[f, g] = counts[g, f] = num + 0.5
    means = counts.sum(axis=1) / max(len(frames) - 1, 1)
    return counts / np.sqrt(np.outer(means, means))


def _num_matches(one: TourFrame, other: TourFrame) -> int:
    if not (len(one.rays) and len(other.rays)):
        return 0
    rows, others = mutual_nearest(one.descriptors, other.descriptors)
    cosines = np.sum(one.descriptors[rows] * other.descriptors[others], axis=1)
    within = np.maximum(one.alikeness[rows], other.alikeness[others])
    alike = (cosines > _MIN_COSINE) & (cosines > within + _MIN_COSINE_LEAD)
    return int(np.count_nonzero(alike))


def in_given_order(alike: np.ndarray) -> bool:
    """True if neighbours are more alike (F, F) as given than in 99.9 % of random orders, of few
    frames 95 %, or near frames are, as neighbours of a hall of bays are less alike than frames a
    bay apart."""
    rng, num = np.random.default_rng(0), len(alike)
    gaps = np.abs(np.subtract.outer(np.arange(num), np.arange(num)))
    nearness, ranks = np.exp(-gaps / _REACH), _ranks(alike)

    def totals(order: np.ndarray) -> tuple[float, float]:
        return _total(alike, order), float(np.sum(nearness * ranks[np.ix_(order, order)]))

    given = np.add(totals(np.arange(num)), _MIN_GAIN)
    better = sum(np.greater(totals(rng.permutation(num)), given) for _ in range(_NUM_RANDOM))
    most = _MAX_BETTER_SHARE if num >= MIN_FRAMES else _MAX_BETTER_SHARE_OF_FEW
    return bool(np.min(better) <= most * _NUM_RANDOM)


def _ranks(alike: np.ndarray) -> np.ndarray:
    """Ranks (F, F) of the likeness of pairs among all, as few pairs would outweigh the others."""
    first, second = np.triu_indices(len(alike), 1)
    ranks = np.zeros(alike.shape)
    ranks[first, second] = np.unique(alike[first, second], return_inverse=True)[1]
    return ranks + ranks.T


def most_alike_path(alike: np.ndarray) -> np.ndarray:
    """Order (F,) int64 of frames in which neighbours are most alike (F, F), of paths made better
    from one start at each frame; of its two directions the one that begins with the smaller
    frame."""
    num = len(alike)
    # A frame that is alike to none is between the ends, so that every change reverses a part.
    closed = np.zeros((num + 1, num + 1))
    closed[:num, :num] = alike
    paths = [_improved(closed, [num, *_greedy(alike, f), num]) for f in range(num)]
    best = np.array(max(paths, key=lambda path: _total(closed, np.array(path)))[1:-1], np.int64)
    return best if best[0] < best[-1] else best[::-1].copy()


def _total(alike: np.ndarray, order: np.ndarray) -> float:
    return float(alike[order[:-1], order[1:]].sum())


def _greedy(alike: np.ndarray, first: int) -> list[int]:
    """A path from a frame to the most similar one that is left, again and again."""
    path, left = [first], np.ones(len(alike), bool)
    left[first] = False
    while left.any():
        path.append(int(np.where(left, alike[path[-1]], -1.0).argmax()))
        left[path[-1]] = False
    return path


def _improved(alike: np.ndarray, path: list[int]) -> list[int]:
    """A path between fixed ends, parts of which are reversed or moved while it gains by that."""
    while True:
        best = max(_changes(alike, np.array(path)), key=lambda change: change[0])
        if best[0] <= _MIN_GAIN:
            return path
        path = best[1]


def _changes(alike: np.ndarray, path: np.ndarray) -> list[tuple[float, list[int]]]:
    """Gains of the best reversal and of the best move of up to three frames, and the paths."""
    num, found = len(path), list[tuple[float, list[int]]]()
    steps = alike[path[:-1], path[1:]]
    # Frames i .. j reversed: i - 1 meets j, i meets j + 1.
    gains = alike[path[:-2, None], path[None, 1:-1]] + alike[path[1:-1, None], path[None, 2:]]
    gains -= steps[:-1, None] + steps[None, 1:]
    gains[np.tril_indices(num - 2)] = -np.inf
    i, j = np.unravel_index(gains.argmax(), gains.shape)
    i, j = int(i) + 1, int(j) + 1
    found.append((float(gains[i - 1, j - 1]), [*path[:i], *path[i : j + 1][::-1], *path[j + 1 :]]))
    for length in range(1, min(_MAX_MOVED, num - 3) + 1):
        for i in range(1, num - length):
            part, rest = path[i : i + length], np.delete(path, slice(i, i + length))
            lost = steps[i - 1] + steps[i + length - 1] - alike[path[i - 1], path[i + length]]
            between = alike[rest[:-1], rest[1:]]
            for some in (part, part[::-1]):
                more = alike[rest[:-1], some[0]] + alike[some[-1], rest[1:]] - between - lost
                k = int(more.argmax())
                found.append((float(more[k]), [*rest[: k + 1], *some, *rest[k + 1 :]]))
    return [(gain, [int(f) for f in some]) for gain, some in found]
