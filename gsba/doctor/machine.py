"""Machine that gsba runs on: processor, memory and disk, with the limits of its container."""

import os
import platform
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

from gsba.memory import processor_name, total_memory_bytes, usable_cpus

_CGROUP = Path("/sys/fs/cgroup")


@dataclass(frozen=True, slots=True)
class Machine:
    """Hardware and software, with the limits of the container."""

    system: str  # distribution, architecture and C library
    python: str  # version
    processor: str  # model
    cores: int
    usable_cores: float  # by affinity and by the container's quota
    memory_bytes: int  # of the machine, or the container's limit if that is less
    free_memory_bytes: int
    free_disk_bytes: int  # on the disk of the working folder


def look() -> Machine:
    """Examine this machine."""
    total, free = _memory()
    quota, _, period = _text(_CGROUP / "cpu.max").strip().partition(" ")
    return Machine(
        system=_system(),
        python=platform.python_version(),
        processor=processor_name(),
        cores=os.cpu_count() or 1,
        usable_cores=min(
            usable_cpus(),
            int(quota) / int(period) if quota.isdigit() and period.isdigit() else float("inf"),
        ),
        memory_bytes=total,
        free_memory_bytes=free,
        free_disk_bytes=shutil.disk_usage(Path.cwd()).free,
    )


def _system() -> str:
    if sys.platform == "darwin":
        return f"macOS {platform.mac_ver()[0]}, {platform.machine()}"
    try:
        name = platform.freedesktop_os_release()["PRETTY_NAME"]
    except (OSError, KeyError):
        name = platform.system()
    library, version = platform.libc_ver()
    return ", ".join(filter(None, (name, platform.machine(), f"{library} {version}".strip())))


def _memory() -> tuple[int, int]:
    """Total and available memory, bytes."""
    pages = total_memory_bytes()
    fields = dict(line.split(":")[:2] for line in _text(Path("/proc/meminfo")).splitlines())
    free = int(fields.get("MemAvailable", "0 kB").split()[0]) * 1024 or pages
    limit, used = (_text(_CGROUP / name).strip() for name in ("memory.max", "memory.current"))
    if limit.isdigit() and int(limit) <= pages:
        return int(limit), min(free, int(limit) - int(used or 0))
    return pages, free


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""
