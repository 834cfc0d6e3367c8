"""Medians of few pictures, pixel by pixel: all pixels pass one sorting network together."""

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

_MAX_SORTED = 32  # pictures: of more, numpy's selection takes fewer comparisons


def median_picture(pictures: np.ndarray) -> np.ndarray:
    """Median (...) of pictures (K, ...), as `np.median(pictures, axis=0)` gives it, in a tenth of
    the time for up to 32 pictures. All values are finite."""
    num = len(pictures)
    if not 1 < num <= _MAX_SORTED:
        return np.median(pictures, axis=0)
    flat = pictures.reshape(num, -1)
    exact = flat.dtype if flat.dtype.kind == "f" else np.float64
    median = np.empty(flat.shape[1], exact)
    step = max((1 << 17) // num, 1)  # values that stay in a processor's cache
    for first in range(0, flat.shape[1], step):
        rows = list(flat[:, first : first + step])
        for low, high in _comparisons(num):
            one, other = rows[low], rows[high]
            rows[low], rows[high] = np.minimum(one, other), np.maximum(one, other)
        below, above = rows[(num - 1) // 2], rows[num // 2]
        median[first : first + step] = np.mean([below, above], axis=0, dtype=exact)
    return median.reshape(pictures.shape[1:])


@lru_cache(maxsize=_MAX_SORTED)
def _comparisons(num: int) -> tuple[tuple[int, int], ...]:
    """Pairs of a network that sorts `num` values: Batcher's merge exchange, Knuth 3, 5.2.2, M."""
    return tuple(_exchanges(num))


def _exchanges(num: int) -> Iterator[tuple[int, int]]:
    top = 1 << ((num - 1).bit_length() - 1)
    p = top
    while p > 0:
        q, r, d = top, 0, p
        while True:
            yield from ((i, i + d) for i in range(num - d) if i & p == r)
            if q == p:
                break
            d, q, r = q - p, q // 2, p
        p //= 2
