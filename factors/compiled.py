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

from numba import njit, types
from numba.core import event

logger = logging.getLogger(__name__)


def kernel_and_part(
    *, allocating: bool = False, **options: Any
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Decorators of one file's kernels, called from Python, and of the parts they are made of.

    Both are cached and release the GIL. All parts of a kernel must be in its file: numba renews
    a cached kernel when its own file changes, not when a part in another file does.

    Kernels count references to arrays, atomically: each row of an array that is taken in a loop
    costs more than the arithmetic on it, and more still where threads count the same array. Parts
    do not count, so that loops belong in parts; they neither allocate arrays nor return any.

    Args:
        allocating: the parts may allocate and return arrays, and count references, too.
        options: of `numba.njit`, such as fastmath.
    """
    _watch()
    options |= {"cache": True, "nogil": True}
    inlined: dict[str, Any] = {"forceinline": True, "_nrt": allocating}
    return njit(**options), njit(**(options | inlined))


class _Compilations(event.Listener):
    """Logs the first compilation of a process, and refuses parts that return arrays they do not
    count; loading a kernel from disk is no compilation."""

    announced = False

    def on_start(self, event: Any) -> None:
        if not self.announced:
            logger.info("compiling kernels, once per machine: this takes a while")
        self.announced = True

    def on_end(self, event: Any) -> None:
        function, arguments = event.data["dispatcher"], tuple(event.data["args"])
        options, compiled = function.targetoptions, function.overloads.get(arguments)
        if compiled is None or not options.get("forceinline") or options.get("_nrt", True):
            return
        if _holds_arrays(compiled.signature.return_type):
            raise TypeError(f"{function.__name__} returns an array, which its caller would release")


def _holds_arrays(kind: Any) -> bool:
    """True if values of a numba type are arrays or hold some."""
    return isinstance(kind, types.Array) or any(map(_holds_arrays, getattr(kind, "types", ())))


@cache
def _watch() -> None:
    event.register("numba:compile", _Compilations())
