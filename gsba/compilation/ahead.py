"""Processes that compile kernels while the one that needs them reads its first frames."""

# pyright: reportAttributeAccessIssue=false
# Numba declares neither its settings nor the inside of its compiler.

import atexit
import contextlib
import hashlib
import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from numba.core import config

from factors.kernel_cache import cache_folder, can_keep, versions
from gsba.compilation import signatures
from gsba.memory import usable_cpus

_MAX_PROCESSES = 4  # each imports Numba first, a second of CPU time
_PACKAGES = Path(__file__).parents[2]  # folder of the packages gsba and factors
_begun: set[str] = set()  # kinds of work that this process has begun


def compile_ahead(*kinds: str) -> None:
    """Begin to compile kernels for kinds of work (`signatures.KINDS`) that are not yet in the
    cache, in processes that end with this one; any other kernel is compiled by whoever needs it
    first."""
    if config.DISABLE_JIT or not can_keep():
        return
    kinds = tuple(kind for kind in kinds if kind not in _begun)
    _begun.update(kinds)
    kinds = tuple(kind for kind in kinds if not _marker(kind).exists())
    if not kinds:
        return
    program = f"import sys; sys.path.append({str(_PACKAGES)!r}); "
    program += f"from gsba.compilation.ahead import work; work({kinds!r})"
    for _ in range(min(_MAX_PROCESSES, max(1, usable_cpus() - 1))):
        with contextlib.suppress(OSError):
            process = subprocess.Popen(
                [sys.executable, "-c", program],
                stdin=subprocess.PIPE,  # closed when this process ends, however it does
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
            atexit.register(process.kill)


def work(kinds: Sequence[str]) -> None:
    """Compile all kernels that are neither compiled nor being compiled, and leave a marker of each
    kind of work that misses none; end when standard input does."""
    threading.Thread(target=_end_with_input, daemon=True).start()
    for kind in kinds:
        kernels = [(signatures.find(name), types) for name, types in signatures.read(kind)]
        for kernel, types in kernels:
            if kernel.is_missing(types):
                kernel.compile(types)
        with contextlib.suppress(OSError):
            if not any(kernel.is_missing(types) for kernel, types in kernels):
                _marker(kind).touch()


def _end_with_input() -> None:
    while os.read(0, 1):
        pass
    os._exit(0)


def _marker(kind: str) -> Path:
    """File that says: all kernels of this kind of work are in the cache, for the code as it is."""
    modules = {name.rpartition(".")[0] for name in signatures.names(kind)}
    files = {_PACKAGES / f"{module.replace('.', '/')}.py" for module in modules}
    files |= {*(_PACKAGES / "factors").glob("*.py"), signatures.FILE}
    found = hashlib.sha256(repr(versions()).encode())
    for file in sorted(files):
        found.update(file.read_bytes())
    return cache_folder() / f"{kind}-{found.hexdigest()[:24]}.complete"
