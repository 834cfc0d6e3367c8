"""What the C library does with freed memory: kept where it is soon needed again, else returned."""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # parameters of mallopt(3), from malloc.h
_USUAL = 32 << 20, 64 << 20  # where glibc itself moves both thresholds in the end
_WORTH = 256 << 20  # bytes: to fetch and clear as much again is a tenth of a second


@contextmanager
def freed_memory_kept() -> Iterator[None]:
    """Have glibc hold on to freed blocks meanwhile, not return them to the system at once.

    SIFT's pyramids allocate the same tens of megabytes for every face. Without this, fetching and
    clearing fresh pages is a third of its time on faces of 600 pixels and more. Afterwards large
    blocks are the system's again: on a heap they leave gaps, gigabytes of thousands of frames.
    """
    _set_thresholds(1 << 30, 1 << 30)
    try:
        yield
    finally:
        _set_thresholds(*_USUAL)


def give_back_freed_memory(least: int = _WORTH) -> None:
    """Have glibc return what was freed and it holds on to, where that is so many bytes."""
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
    """Bytes from which a block is mapped by itself, and of free heap that goes back."""
    libc = ctypes.CDLL(None)
    if hasattr(libc, "mallopt"):
        libc.mallopt(_M_MMAP_THRESHOLD, mapped)
        libc.mallopt(_M_TRIM_THRESHOLD, trimmed)
