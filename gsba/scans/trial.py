"""Trial reading of scans in a separate process, as damaged files crash the reading libraries."""

import json
import os
import re
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from gsba.log import GsbaError
from gsba.memory import peak_memory_bytes

_BASE_CPU_S, _BYTES_PER_CPU_S = 20.0, 1e6  # limit of processor time, by the file's size
_BASE_MEMORY_BYTES, _MEMORY_PER_BYTE = 2 << 30, 100  # limit of memory besides that of libraries
_CHILD = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1])\n"
    "from gsba.scans.files import read_on_trial; read_on_trial(sys.argv[2])"
)
_REFUSED = 3  # exit code of the process after it has printed a message


def try_in_process(path: Path) -> None:
    """Read a scan in another process, see `limited`; GsbaError if that fails or crashes."""
    found = subprocess.run(
        [sys.executable, "-P", "-c", _CHILD, json.dumps(sys.path), str(path.absolute())],
        stdin=subprocess.DEVNULL,
        capture_output=True,
    )
    torn = re.search(rb"RPly: [^\n]*", found.stderr)
    if torn:  # open3d returns the part that it could read
        cause = torn[0].decode("ascii", "replace")
        raise GsbaError(f"{path}: cannot be read to its end ({cause}): copy or export it again")
    if found.returncode == 0:
        return
    if found.returncode == _REFUSED:
        raise GsbaError(found.stdout.decode("utf-8", "replace"))
    cause = f"exit {found.returncode}"
    if found.returncode < 0:
        cause = signal.Signals(-found.returncode).name
        if -found.returncode == signal.SIGXCPU:
            cause = "it took too long for a file of this size"
    raise GsbaError(
        f"{path}: cannot be read: the library that reads it crashed or was stopped ({cause}); the "
        "file is damaged: copy or export it again"
    )


def limited(path: Path, read: Callable[[Path], object]) -> None:
    """Read a scan with limits on memory and processor time by its size, and end the process."""
    size = path.stat().st_size
    memory = _mapped_bytes() + _BASE_MEMORY_BYTES + _MEMORY_PER_BYTE * size
    spent = sum(os.times()[:2])
    _lower(resource.RLIMIT_AS, memory)
    _lower(resource.RLIMIT_CPU, int(spent + _BASE_CPU_S + size / _BYTES_PER_CPU_S))
    _lower(resource.RLIMIT_CORE, 0)
    code, message = 0, ""
    try:
        read(path)
    except GsbaError as error:
        code, message = _REFUSED, str(error)
    except BaseException as error:  # panics of Rust are no Exception
        kind = "out of memory" if isinstance(error, MemoryError) else type(error).__name__
        cause = " ".join(str(error).split()) or kind
        code, message = _REFUSED, f"{path}: cannot be read ({cause}): copy or export it again"
    os.write(1, message.encode("utf-8", "replace"))
    os._exit(code)


def _mapped_bytes() -> int:
    """Address space of this process; the most memory it has held where /proc is not there."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
    except OSError:
        return peak_memory_bytes()
    return pages * os.sysconf("SC_PAGE_SIZE")


def _lower(kind: int, limit: int) -> None:
    soft, hard = resource.getrlimit(kind)
    known = [limit, *(x for x in (soft, hard) if x != resource.RLIM_INFINITY)]
    with suppress(OSError, ValueError):  # macOS refuses some: the file is read without this limit
        resource.setrlimit(kind, (min(known), hard))
