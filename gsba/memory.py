"""Memory and processors of this machine, on Linux and macOS; settings of glibc's allocator."""

import ctypes
import mmap
import os
import platform
import resource
import sys
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # parameters of mallopt(3), from malloc.h
_mapped_files = weakref.WeakSet[mmap.mmap]()


def total_memory_bytes() -> int:
    """Memory of the machine, or of the container or job that this process is confined to."""
    machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return min([machine, *_limits_of_control_groups()])


def _limits_of_control_groups(root: Path = Path("/")) -> list[int]:
    """Limits, bytes, that Linux's control groups (versions 1 and 2) set to this process."""
    limits = []
    with suppress(OSError, ValueError):
        for line in (root / "proc/self/cgroup").read_text().splitlines():
            _, controllers, group = line.split(":", 2)
            folder, name = root / "sys/fs/cgroup", "memory.max"
            if controllers:
                folder, name = folder / "memory", "memory.limit_in_bytes"
            if controllers and "memory" not in controllers.split(","):
                continue
            inner = folder / group.lstrip("/")
            for place in (inner, *inner.parents):
                if not place.is_relative_to(folder):
                    break
                with suppress(OSError, ValueError):  # "max": no limit
                    limits.append(int((place / name).read_text()))
    return limits


def peak_memory_bytes() -> int:
    """Most memory that this process has held."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak  # elsewhere it is in kB


def usable_cpus() -> int:
    """Processors that this process may use; all where the system has no affinity, as macOS."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def processor_name() -> str:
    """Model of the processor, or its kind where the system names no model."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


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
        _set_thresholds(32 << 20, 64 << 20)  # glibc's own


def give_back_freed_memory(least: int = 256 << 20) -> None:
    """Make glibc return freed memory to the system if it keeps at least `least` bytes: less is
    taken again by what follows, and fetching and clearing its pages costs a short run some percent
    of its time."""
    libc = ctypes.CDLL(None)
    if hasattr(libc, "mallinfo2"):
        libc.mallinfo2.restype = _Mallinfo
        if libc.mallinfo2().fordblks < least:
            return
    if hasattr(libc, "malloc_trim"):
        libc.malloc_trim(0)


def mapped_file(file: IO[bytes]) -> mmap.mmap:
    """Content of an open file, read-only, whose pages are read as they are used; ValueError if it
    is empty."""
    content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    _mapped_files.add(content)
    return content


def release_mapped_files() -> None:
    """Take the pages of all mapped files, which are not written, out of this process's memory; they
    are read again as they are used."""
    if hasattr(mmap, "MADV_DONTNEED"):
        for content in list(_mapped_files):
            content.madvise(mmap.MADV_DONTNEED)


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
