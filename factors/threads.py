"""Threads, and runs of landmarks or patches shared out among them."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import pairwise

import numpy as np


def balanced_ranges(offsets: np.ndarray, num_threads: int) -> list[tuple[int, int]]:
    """Runs of owners with about the same number of observations, one per thread.

    Args:
        offsets: (N + 1,) owner n holds observations offsets[n] to offsets[n + 1] - 1.
        num_threads: most runs; at least one is returned, (0, 0) where there are no owners.
    """
    targets = np.linspace(0, offsets[-1], num_threads + 1)[1:-1]
    bounds = np.unique([0, *np.searchsorted(offsets, targets), len(offsets) - 1])
    if len(bounds) < 2:
        return [(0, 0)]
    return [(int(a), int(b)) for a, b in pairwise(bounds)]


def run_in_threads(work: Callable[[int], None], num: int) -> None:
    """Call work(0) to work(num - 1), each in a thread of its own; work must not do the same."""
    if num == 1:
        work(0)
        return
    list(pool(num).map(work, range(num)))


@lru_cache(maxsize=4)
def pool(num: int) -> ThreadPoolExecutor:
    """Threads that stay: solvers and renderers ask for them hundreds of times."""
    return ThreadPoolExecutor(num, "factors")


os.register_at_fork(after_in_child=pool.cache_clear)  # a child has none of its parent's threads
