"""Settings of glibc's allocator: keep freed memory that is soon used again, return the rest."""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # parameters of mallopt(3), from malloc.h
_DEFAULT_THRESHOLDS = 32 << 20, 64 << 20  # bytes, glibc's own mapping and trimming thresholds
_MIN_RETURNED_BYTES = 256 << 20  # fetching and clearing so much again takes a tenth of a second


@contextmanager
def freed_memory_kept() -> Iterator[None]:
    """Make glibc keep freed blocks within this context, not return them to the system.

    SIFT's pyramids allocate the same tens of megabytes for every face. Without this, fetching and
    clearing fresh pages takes a third of its time on faces of 600 pixels and more. Afterwards
    glibc maps large blocks separately again: on the heap they leave gaps, which grow to gigabytes
    over thousands of frames.
    """
    _set_thresholds(1 << 30, 1 << 30)
    try:
        yield
    finally:
        _set_thresholds(*_DEFAULT_THRESHOLDS)


def give_back_freed_memory(least: int = _MIN_RETURNED_BYTES) -> None:
    """Make glibc return freed memory to the system if it keeps at least `least` bytes."""
    libc = ctypes.CDLL(None)
    if hasattr(libc, "mallinfo2"):
        libc.mallinfo2.restype = _Mallinfo
        if libc.mallinfo2().fordblks < least:
            return
    if hasattr(libc, "malloc_trim"):
        libc.malloc_trim(0)


class _Mallinfo(ctypes.Structure):
    """`struct mallinfo2` of malloc.h, over all arenas."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in (
            "arena", "ordblks", "smblks", "hblks", "hblkhd",
            "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost",
        )
    ]  # fmt: skip


def _set_thresholds(mapped: int, trimmed: int) -> None:
    """Set the smallest block that is mapped separately, and the free heap to return, in bytes."""
    libc = ctypes.CDLL(None)
    if hasattr(libc, "mallopt"):
        libc.mallopt(_M_MMAP_THRESHOLD, mapped)
        libc.mallopt(_M_TRIM_THRESHOLD, trimmed)
