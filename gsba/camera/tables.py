"""Tables of where pixels lie: large, the same for all frames, and wanted by all threads at once."""

import functools
import threading
from collections.abc import Callable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


def table(maxsize: int) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """As `functools.lru_cache`, but threads that ask for the same at once have it computed once."""

    def kept(compute: Callable[P, T]) -> Callable[P, T]:
        cached, lock = functools.lru_cache(maxsize=maxsize)(compute), threading.Lock()

        @functools.wraps(compute)
        def look_up(*args: P.args, **kwargs: P.kwargs) -> T:
            with lock:
                return cached(*args, **kwargs)  # type: ignore[arg-type]

        return look_up

    return kept
