"""Compiled kernels on disk, per user, keyed by content.

A kernel's key is a digest of all that its machine code follows from: its own byte code and
constants, those of the parts it calls in any file, its signature and options, the processor, and
the versions of Python, Numba and LLVM. Every installation, environment and process of a user finds
the same kernels, whatever their paths; editing a part renews the kernels that call it.

The folder is `$NUMBA_CACHE_DIR/gsba`, else `gsba/kernels` in the user's cache folder. A kernel
that another process is compiling is waited for. Whatever goes wrong with the folder, kernels are
compiled.
"""

# pyright: reportAttributeAccessIssue=false
# Numba declares neither its settings nor the inside of its compiler.

import contextlib
import fcntl
import hashlib
import logging
import os
import pickle
import sys
import time
import uuid
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import llvmlite
import numba
import numpy as np
from llvmlite.binding import get_host_cpu_name
from numba.core import config, types
from numba.core.caching import _Cache
from numba.core.compiler import CompileResult
from numba.core.dispatcher import Dispatcher
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps

logger = logging.getLogger(__name__)

_DIGEST_BYTES = 32  # of SHA-256, before each payload: a damaged file must not be executed
_DAY_S = 86400.0
_VERSIONED = {"builtins", "math", "numba", "numpy"}  # packages whose versions are in the key


class KernelCache(_Cache):
    """The compiled forms of one kernel on disk, as Numba's dispatchers use a cache."""

    def __init__(self, kernel: Dispatcher) -> None:
        self._kernel = kernel
        self._lock: Any = None  # file object while this process compiles a form

    @property
    def cache_path(self) -> str:
        return str(cache_folder())

    def enable(self) -> None: ...

    def disable(self) -> None: ...

    def flush(self) -> None: ...

    def load_overload(self, sig: Any, target_context: Any) -> CompileResult | None:
        """The compiled form of a signature, or None: then this process is to compile it, and
        others wait until `save_overload`."""
        rtsys.initialize(target_context)  # what machine code calls; Numba's compiler loads the rest
        path = self._path(sig, target_context.codegen())
        result = _load(path, target_context)
        if result is None:
            self._lock = _lock(path.with_suffix(".lock"))
            result = _load(path, target_context)  # another process may have just saved it
            if result is not None:
                self.release()
        return result

    def save_overload(self, sig: Any, data: CompileResult) -> None:
        """Keep a compiled form, and let other processes go on."""
        try:
            if not data.library.has_dynamic_globals:
                path = self._path(sig, data.codegen)
                payload = dumps(data._reduce())
                unfinished = path.with_suffix(f".{uuid.uuid4().hex}.tmp")
                try:
                    unfinished.write_bytes(hashlib.sha256(payload).digest() + payload)
                    unfinished.replace(path)
                    _remove_unused(path.parent)
                except OSError as error:
                    _tell_trouble(error.strerror or str(error))
                    with contextlib.suppress(OSError):
                        unfinished.unlink()
        finally:
            self.release()

    def is_missing(self, sig: Any, target_context: Any) -> bool:
        """True if a form is not in the cache, nor being compiled by any process."""
        path = self._path(sig, target_context.codegen())
        if path.exists():
            return False
        lock = _lock(path.with_suffix(".lock"), wait=False)
        if lock is not None:
            _unlock(lock)
        return lock is not None

    def release(self) -> None:
        """Let other processes compile this kernel: it is saved, or could not be compiled."""
        if self._lock is not None:
            _unlock(self._lock)
            self._lock = None

    def _path(self, sig: Any, codegen: Any) -> Path:
        args = tuple(getattr(sig, "args", sig))
        # Types of records are found by their modules when a kernel is loaded.
        records = [each.instance_class for each in args if isinstance(each, types.BaseNamedTuple)]
        homes = "".join(f" {each.__module__}.{each.__qualname__}" for each in records)
        facts = (digest(self._kernel), f"{args}{homes}", codegen.magic_tuple(), versions())
        name = hashlib.sha256(repr(facts).encode()).hexdigest()[:24]
        return cache_folder() / f"{self._kernel.py_func.__name__.strip('_')}-{name}.kernel"


def cache_folder() -> Path:
    """Folder of this user's compiled kernels; it may not exist yet."""
    if config.CACHE_DIR:
        return Path(config.CACHE_DIR) / "gsba"
    try:
        home = Path.home()
    except RuntimeError:  # a user whom the system does not know: nothing can be kept
        home = Path(os.devnull)
    if sys.platform == "darwin":
        return home / "Library" / "Caches" / "gsba" / "kernels"
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache") / "gsba" / "kernels"


def can_keep() -> bool:
    """True if compiled kernels can be written to the folder, which is made."""
    try:
        cache_folder().mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(cache_folder(), os.W_OK)


@cache
def digest(kernel: Dispatcher) -> str:
    """Digest of a kernel's code and of all code and constants that it uses."""
    found = hashlib.sha256()
    for fact in _facts(kernel, set()):
        found.update(fact.encode() + b"\0")
    return found.hexdigest()


def _facts(thing: Any, seen: set[int]) -> Iterator[str]:
    """Texts of which one changes whenever code compiled from a global value may change."""
    name = thing.__name__ if isinstance(thing, ModuleType) else getattr(thing, "__module__", None)
    module = sys.modules.get(str(name))
    if module is None or module.__name__.partition(".")[0] in _VERSIONED:
        yield f"{name}.{thing.__qualname__}" if hasattr(thing, "__qualname__") else _text(thing)
    elif isinstance(thing, Dispatcher | FunctionType):
        if id(thing) in seen:
            return
        seen.add(id(thing))
        if isinstance(thing, Dispatcher):
            yield repr(sorted((name, _text(x)) for name, x in thing.targetoptions.items()))
            thing = thing.py_func
        yield f"{name}.{thing.__qualname__}"
        yield from map(_code_text, _codes(thing.__code__))
        values = [cell.cell_contents for cell in thing.__closure__ or ()]
        names = sorted({each for code in _codes(thing.__code__) for each in code.co_names})
        for value in values + [thing.__globals__[x] for x in names if x in thing.__globals__]:
            yield from _facts(value, seen)
    else:  # a module, a record, or code made for Numba by hand
        file = getattr(module, "__file__", None)
        yield hashlib.sha256(Path(file).read_bytes()).hexdigest() if file else _text(thing)


def _codes(code: CodeType) -> Iterator[CodeType]:
    """A code object and those inside it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _code_text(code: CodeType) -> str:
    """Byte code, constants and names of a code object, docstrings included."""
    constants = [_text(each) for each in code.co_consts if not isinstance(each, CodeType)]
    return f"{code.co_code.hex()} {constants} {code.co_names} {code.co_varnames}"


def _text(value: Any) -> str:
    """Text of a constant, the same in every process."""
    if isinstance(value, set | frozenset):
        return f"{{{sorted(map(repr, value))}}}"
    if isinstance(value, np.ndarray):
        return f"{value.dtype.str} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
    return f"{type(value).__name__} {value!r}"


@cache
def versions() -> tuple[str, ...]:
    """Versions of all that compiles, and the processor that it compiles for."""
    processor = config.CPU_NAME or get_host_cpu_name()
    return (sys.version, numba.__version__, llvmlite.__version__, np.__version__, processor)


def _load(path: Path, target_context: Any) -> CompileResult | None:
    """A kernel from its file; None if there is none, or this version cannot use it."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        _tell_trouble(error.strerror or str(error))
        return None
    with contextlib.suppress(OSError):  # of another user, perhaps
        if time.time() - path.stat().st_mtime > _DAY_S:
            os.utime(path)
    checksum, payload = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
    if hashlib.sha256(payload).digest() != checksum:
        return None
    try:
        parts = pickle.loads(payload)
    except (ImportError, AttributeError):  # it takes records that another version has elsewhere
        return None
    return CompileResult._rebuild(target_context, *parts)


def _lock(path: Path, *, wait: bool = True) -> Any:
    """A locked file, closed to unlock it; None = unsupported, or another's and not waited for."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("w")
    except OSError as error:
        _tell_trouble(error.strerror or str(error))
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # a file system without locks
        file.close()
        return None
    except BaseException:
        file.close()
        raise
    return file


def _unlock(file: Any) -> None:
    with contextlib.suppress(OSError):
        os.unlink(file.name)
    file.close()


@cache
def _remove_unused(folder: Path) -> None:
    """Remove kernels that were not used for long, once per process."""
    for path in folder.iterdir():
        if time.time() - path.stat().st_mtime > 90 * _DAY_S:
            with contextlib.suppress(OSError):
                path.unlink()


@cache
def _tell_trouble(reason: str) -> None:
    logger.warning(
        f"compiled kernels cannot be kept in {cache_folder()}: {reason}; each process compiles "
        "them anew: set NUMBA_CACHE_DIR to a folder that can be written"
    )
