"""Compilation of kernels: each one as a whole, with all its parts inlined.

A kernel that calls another compiled function uses the copy that was loaded first: the function's
own while kernels are being compiled, but the kernel's own, or another kernel's, once they come from
the cache. Copies are optimised in their context, so they may round differently. Parts are therefore
inlined, and kernels leave no sums or products of arrays to numpy. `tests/factors/test_compiled.py`
tests both.

Compiling takes half a minute in all, which the log announces.
"""

import logging
from collections.abc import Callable
from functools import cache
from typing import Any

from numba import njit
from numba.core import event

logger = logging.getLogger(__name__)


def kernel_and_part(**options: Any) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Decorators of one file's kernels, called from Python, and of the parts they are made of.

    Both are cached and release the GIL. All parts of a kernel must be in its file: numba renews
    a cached kernel when its own file changes, not when a part in another file does.

    Args:
        options: of `numba.njit`, such as fastmath.
    """
    _announce()
    options |= {"cache": True, "nogil": True}
    return njit(**options), njit(**options, forceinline=True)


class _Announcer(event.Listener):
    """Logs the first compilation of a process; loading a kernel from disk is none."""

    announced = False

    def on_start(self, event: Any) -> None:
        if not self.announced:
            logger.info("compiling kernels, once per machine: this takes a while")
        self.announced = True

    def on_end(self, event: Any) -> None:
        pass  # which the listener has to have


@cache
def _announce() -> None:
    event.register("numba:compile", _Announcer())
