"""Threads, and ranges of landmarks or patches distributed among them by size alone; partial sums
are added in order, so that results are identical to the last bit for any number of threads."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from itertools import pairwise
from threading import Lock
from typing import Generic, TypeVar

import numpy as np

T = TypeVar("T")


def balanced_ranges(offsets: np.ndarray, least: int = 8192) -> list[tuple[int, int]]:
    """Runs of owners with about the same number of observations, at least `least`; at least one.
    Owner n holds observations offsets[n] to offsets[n + 1] - 1."""
    total = int(offsets[-1])
    num = min(max(total // least, 1), 24)  # largest number of runs, as each has sums of its own
    targets = np.linspace(0, total, num + 1)[1:-1]
    bounds = np.unique([0, *np.searchsorted(offsets, targets), len(offsets) - 1])
    if len(bounds) < 2:
        return [(0, 0)]
    return [(int(a), int(b)) for a, b in pairwise(bounds)]


def map_in_threads(work: Callable[[int], T], num: int, num_threads: int) -> Iterator[T]:
    """Results of work(0) to work(num - 1) in this order, of which few wait to be taken; work must
    not use threads itself."""
    if num == 1 or num_threads == 1:
        yield from map(work, range(num))
        return
    running: deque[Future[T]] = deque()
    try:
        for n in range(num):
            running.append(pool(num_threads).submit(work, n))
            if len(running) == 2 * num_threads:
                yield running.popleft().result()
        while running:
            yield running.popleft().result()
    finally:
        for one in running:
            one.cancel()


def run_in_threads(work: Callable[[int], None], num: int, num_threads: int) -> None:
    """Call work(0) to work(num - 1) in threads; work must not use threads itself."""
    for _ in map_in_threads(work, num, num_threads):
        pass


def rows_in_threads(
    work: Callable[[slice], Sequence[np.ndarray]], ranges: Iterable[slice], num_threads: int
) -> list[np.ndarray]:
    """Arrays that work makes of each of at least one range of rows, concatenated; work must not use
    threads itself."""
    every = list(ranges)
    parts = map_in_threads(lambda n: work(every[n]), len(every), num_threads)
    return [np.concatenate(column) for column in zip(*parts, strict=True)]


@lru_cache(maxsize=4)
def pool(num: int) -> ThreadPoolExecutor:
    """A pool of threads that persists: solvers and renderers use it hundreds of times."""
    return ThreadPoolExecutor(num, "factors")


os.register_at_fork(after_in_child=pool.cache_clear)  # a child process has no threads of its parent


class Once(Generic[T]):
    """A value computed by the first caller, while only callers that need it wait."""

    def __init__(self, make: Callable[[], T]) -> None:
        self._make, self._lock, self._made = make, Lock(), []

    def __call__(self) -> T:
        with self._lock:
            if not self._made:
                self._made.append(self._make())
            return self._made[0]
