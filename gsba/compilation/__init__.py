"""Compilation of kernels before they are needed, by processes beside the one that works.

Takes the kind of work that begins.
Gives nothing: compiled kernels in the cache of `factors.kernel_cache`.
"""

from gsba.compilation.ahead import compile_ahead

__all__ = ["compile_ahead"]
