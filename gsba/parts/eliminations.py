"""Cholesky factors that a process keeps between the two passes of a step over the parts.

A step eliminates a part's own variables, and substitutes the steps of those on cuts afterwards:
both need the same factor. It is kept in between where memory permits, and computed again where it
does not, or where another worker has eliminated the part. Results are the same.
"""

import threading
from pathlib import Path

from factors.part_system import PartElimination, PartEquations
from gsba.memory import total_memory_bytes
from gsba.parts.folder import load

_MEMORY_SHARE = 64  # of the machine's memory: a process keeps factors of this part of it at most

_Key = tuple[str, int, int, float]  # file, its inode, time of writing, damping


class _Kept:
    """Factors by the file of their equations and the damping."""

    def __init__(self) -> None:
        self._factors: dict[_Key, PartElimination] = {}
        self._num_bytes, self._lock = 0, threading.Lock()

    def put(self, key: _Key, factor: PartElimination, most: int) -> None:
        """Keep a factor if all that are kept take `most` bytes at most, older ones of its file
        left out."""
        with self._lock:
            for old in [old for old in self._factors if old[0] == key[0]]:
                self._drop(old)
            if self._num_bytes + factor.num_bytes <= most:
                self._factors[key] = factor
                self._num_bytes += factor.num_bytes

    def take(self, key: _Key) -> PartElimination | None:
        """A factor, which is not kept any longer."""
        with self._lock:
            return self._drop(key) if key in self._factors else None

    def _drop(self, key: _Key) -> PartElimination:
        factor = self._factors.pop(key)
        self._num_bytes -= factor.num_bytes
        return factor


_kept = _Kept()


def eliminated(file: Path, damping: float) -> PartElimination:
    """Factorize the equations in a file; the factor is kept for `substituting`."""
    factor = PartElimination(load(file, PartEquations), damping)
    if factor.regular:
        _kept.put(_key(file, damping), factor, total_memory_bytes() // _MEMORY_SHARE)
    return factor


def substituting(file: Path, damping: float) -> PartElimination:
    """The factor that `eliminated` returned, or computed again."""
    factor = _kept.take(_key(file, damping))
    return PartElimination(load(file, PartEquations), damping) if factor is None else factor


def _key(file: Path, damping: float) -> _Key:
    stat = file.stat()
    return str(file), stat.st_ino, stat.st_mtime_ns, damping
