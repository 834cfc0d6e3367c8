"""Cached tables of pixel places: large, shared by all frames, and needed by all threads at once."""

import functools
import threading
from collections.abc import Callable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


def table(maxsize: int) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """A `functools.lru_cache` that computes an entry once if several threads need it at once."""

    def kept(compute: Callable[P, T]) -> Callable[P, T]:
        cached, lock = functools.lru_cache(maxsize=maxsize)(compute), threading.Lock()

        @functools.wraps(compute)
        def look_up(*args: P.args, **kwargs: P.kwargs) -> T:
            with lock:
                return cached(*args, **kwargs)  # type: ignore[arg-type]

        return look_up

    return kept
