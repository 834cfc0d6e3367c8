"""How kernels are compiled: each one whole, with all its parts inlined.

A kernel that calls another compiled function is answered by whichever copy of that function was
loaded first: the function's own while kernels are being compiled, the kernel's, or that of another
kernel, once they come from the cache. Each copy is optimised where it stands, so they may round
differently. Parts are therefore inlined, and kernels leave no sums or products of arrays to numpy.
`tests/test_compiled.py` holds both.
"""

from collections.abc import Callable
from typing import Any

from numba import njit


def kernel_and_part(**options: Any) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Decorators of one file's kernels, called from Python, and of the parts they are made of.

    Both are cached and release the GIL. All parts of a kernel should be in its file: numba renews
    a cached kernel when its own file changes, not when a part in another file does.

    Args:
        options: of `numba.njit`, such as fastmath.
    """
    options |= {"cache": True, "nogil": True}
    return njit(**options), njit(**options, forceinline=True)
