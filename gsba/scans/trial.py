"""Scans read on trial by a process of its own, as damaged files crash the libraries that read them.

What passes is read again by the process that wants it.
"""

import json
import os
import re
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from gsba.log import GsbaError

_FIRST_S, _BYTES_PER_S = 20.0, 1e6  # processor time that is enough, by the file's size
_FIRST_MEMORY, _MEMORY_PER_BYTE = 2 << 30, 100  # bytes beside what the libraries take
_CHILD = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1])\n"
    "from gsba.scans.files import read_on_trial; read_on_trial(sys.argv[2])"
)
_REFUSED = 3  # exit code after a message


def try_in_process(path: Path) -> None:
    """Have another process read a scan, see `limited`.

    Raises:
        GsbaError: what it says of the file, or how it ended.
    """
    found = subprocess.run(
        [sys.executable, "-P", "-c", _CHILD, json.dumps(sys.path), str(path.absolute())],
        stdin=subprocess.DEVNULL,
        capture_output=True,
    )
    torn = re.search(rb"RPly: [^\n]*", found.stderr)
    if torn:  # of which open3d gives the part that it could read
        said = torn[0].decode("ascii", "replace")
        raise GsbaError(f"{path}: cannot be read to its end ({said}): copy or export it again")
    if found.returncode == 0:
        return
    if found.returncode == _REFUSED:
        raise GsbaError(found.stdout.decode("utf-8", "replace"))
    how = f"exit {found.returncode}"
    if found.returncode < 0:
        how = signal.Signals(-found.returncode).name
        if -found.returncode == signal.SIGXCPU:
            how = "too long for a file of this size"
    raise GsbaError(
        f"{path}: cannot be read: the library that reads it crashed or was stopped ({how}); it is "
        "damaged: copy or export it again"
    )


def limited(path: Path, read: Callable[[Path], object]) -> None:
    """Read a scan within the memory and processor time that its size allows, and end the process.

    Args:
        path: of the scan.
        read: called with it.
    """
    size, mapped = path.stat().st_size, int(Path("/proc/self/statm").read_text().split()[0])
    memory = mapped * os.sysconf("SC_PAGE_SIZE") + _FIRST_MEMORY + _MEMORY_PER_BYTE * size
    spent = sum(os.times()[:2])
    _lower(resource.RLIMIT_AS, memory)
    _lower(resource.RLIMIT_CPU, int(spent + _FIRST_S + size / _BYTES_PER_S))
    _lower(resource.RLIMIT_CORE, 0)
    code, said = 0, ""
    try:
        read(path)
    except GsbaError as error:
        code, said = _REFUSED, str(error)
    except BaseException as error:  # Rust's panics are no Exception
        code, said = _REFUSED, f"{path}: cannot be read ({' '.join(str(error).split())})"
    os.write(1, said.encode("utf-8", "replace"))
    os._exit(code)


def _lower(kind: int, limit: int) -> None:
    soft, hard = resource.getrlimit(kind)
    known = [limit, *(x for x in (soft, hard) if x != resource.RLIM_INFINITY)]
    resource.setrlimit(kind, (min(known), hard))
