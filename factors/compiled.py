"""Compilation of kernels by Numba: each kernel as a whole, with its parts inlined.

A kernel is called from Python; parts are what kernels are made of. Parts are linked into each
kernel as they are, and optimised there alone: a function that is optimised and turned into machine
code by itself, to be inlined afterwards, costs Numba most of the time that it takes to compile.
Since each kernel holds its own copy of its parts, kernels leave no sums or products of arrays to
numpy, whose copies would be shared and round differently. Both are tested in
`tests/factor_graph/test_compiled.py`.

`factors.kernel_cache` keeps compiled kernels between processes.
"""

# pyright: reportAttributeAccessIssue=false
# Numba declares neither its settings nor the inside of its compiler.

import gc
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import compiler, config, types
from numba.core.codegen import JITCodeLibrary
from numba.core.dispatcher import _FunctionCompiler
from numba.core.registry import CPUDispatcher
from numba.core.untyped_passes import LiteralPropagationSubPipelinePass, LiteralUnroll

from factors.kernel_cache import KernelCache

logger = logging.getLogger(__name__)

_DEFAULT_FLAGS = compiler.Flags().values()
_FLAGS_HASH = hash(compiler.Flags())  # Numba hashes only the names of flags
_FOR_LITERALS = {LiteralUnroll, LiteralPropagationSubPipelinePass}


def kernel_and_part(
    *, allocating: bool = False, **options: Any
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Decorators of kernels, called from Python, and of the parts they are made of.

    Kernels are cached on disk and release the GIL. Calling a part from Python runs its Python code.

    Kernels count references to arrays, atomically: each row of an array that is taken in a loop
    costs more than the arithmetic on it, and more still where threads count the same array. Parts
    do not count, so that loops belong in parts; they neither allocate arrays nor return any.

    Slices that are written to, array expressions, `np.linalg` and sorts by numpy bring hundreds of
    lines of Numba's own into a kernel, each of them compiled anew: loops over scalars do not.

    Args:
        allocating: the parts may allocate and return arrays, and count references, too.
        options: of `numba.njit`, such as fastmath. Division by zero gives inf or nan.
    """
    usual = {"nopython": True, "nogil": True, "boundscheck": None, "error_model": "numpy"}
    options = usual | options

    def kernel(function: Callable[..., Any]) -> Any:
        return function if config.DISABLE_JIT else Kernel(function, {}, dict(options))

    def part(function: Callable[..., Any]) -> Any:
        inlined = options | {"forceinline": True, "_nrt": allocating}
        return function if config.DISABLE_JIT else Part(function, {}, inlined)

    return kernel, part


class Kernel(CPUDispatcher):
    """A function compiled with its parts inlined, kept on disk."""

    def __init__(self, function: Callable[..., Any], local: dict, options: dict) -> None:
        super().__init__(function, local, options)
        self._compiler = _KernelCompiler(function, self.targetdescr, options, local, _Pipeline)
        self._cache = KernelCache(self)

    def compile(self, sig: Any) -> Any:
        try:
            return super().compile(sig)
        finally:
            self._cache.release()

    def is_missing(self, sig: Any) -> bool:
        """True if the form of a signature is not on disk, nor being compiled by any process."""
        return self._cache.is_missing(sig, self.targetctx)


class Part(CPUDispatcher):
    """A function that is compiled only as a part of kernels."""

    def __init__(self, function: Callable[..., Any], local: dict, options: dict) -> None:
        super().__init__(function, local, options)
        self._compiler = _PartCompiler(function, self.targetdescr, options, local, _Pipeline)

    def __call__(self, *args: Any) -> Any:
        return self.py_func(*args)


class _Flags(compiler.Flags):
    """Numba's flags, which it hashes and compares for each call that it resolves, in less time."""

    def __hash__(self) -> int:
        return _FLAGS_HASH

    def values(self) -> dict[str, Any]:
        return _DEFAULT_FLAGS | self._values


class _Pipeline(compiler.CompilerBase):
    """Numba's passes without those for literal arguments, which infer all types once more."""

    def define_pipelines(self) -> list[Any]:
        passes = compiler.DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.passes = [one for one in passes.passes if one[0] not in _FOR_LITERALS]
        passes._finalized = False
        passes.finalize()
        return [passes]


class _KernelCompiler(_FunctionCompiler):
    """Compiles a function, and what it calls only to be linked into it."""

    _announced = False

    def _compile_core(self, args: tuple, return_type: Any) -> Any:
        if not _KernelCompiler._announced:
            logger.info("compiling kernels, once per machine: this takes some seconds")
            _KernelCompiler._announced = True
        codegen = self.targetdescr.target_context.codegen()
        library = codegen.create_library(self.py_func.__qualname__)
        library.enable_object_caching()
        with _collecting_no_garbage(), _linking_callees(codegen):
            result = self._compile(args, return_type, library)
        for environment in result._find_referenced_environments():  # of callees that raise errors
            codegen.set_env(environment.env_name, environment)
        return result

    def _compile(self, args: tuple, return_type: Any, library: Any, *, part: bool = False) -> Any:
        flags = _Flags()
        self.targetdescr.options.parse_as_flags(flags, self.targetoptions)
        flags.no_cfunc_wrapper = True
        flags.no_cpython_wrapper = flags.no_compile = part
        return compiler.compile_extra(
            self.targetdescr.typing_context,
            self.targetdescr.target_context,
            self.py_func,
            args,
            return_type,
            flags,
            self.locals,
            library=library,
            pipeline_class=self.pipeline_class,
        )


class _PartCompiler(_KernelCompiler):
    """Compiles a function that is always inlined into its callers."""

    def _compile_core(self, args: tuple, return_type: Any) -> Any:
        context = self.targetdescr.target_context
        library = _LinkedLibrary(context.codegen(), self.py_func.__qualname__)
        result = self._compile(args, return_type, library, part=True)
        counts = self.targetoptions["_nrt"]
        if not counts and _holds_arrays(result.signature.return_type):
            name = self.py_func.__name__
            raise TypeError(f"{name} returns an array, which its caller would release")
        # Numba finds the code of a call by its entry point. Parts have none: this one is unique.
        result = result._replace(entry_point=[].index)
        context.insert_user_function(result.entry_point, result.fndesc, [result.library])
        return result


class _LinkedLibrary(JITCodeLibrary):
    """Code to be linked into kernels: neither optimised nor turned into machine code."""

    @property
    def codegen(self) -> Any:
        return self

    def set_env(self, _name: str, _environment: Any) -> None:
        """Nothing: code that does not exist yet has no address of its environment."""

    def _optimize_functions(self, ll_module: Any) -> None:
        ll_module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None: ...

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


def _holds_arrays(kind: Any) -> bool:
    """True if values of a Numba type are arrays or hold some."""
    return isinstance(kind, types.Array) or any(map(_holds_arrays, getattr(kind, "types", ())))


@contextmanager
def _collecting_no_garbage() -> Iterator[None]:
    """Pauses the garbage collector, which Numba's many small objects keep busy for nothing."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@contextmanager
def _linking_callees(codegen: Any) -> Iterator[None]:
    """Keeps Numba from optimising its own functions that a kernel calls apart from the kernel."""
    usual = codegen._library_class
    codegen._library_class = _LinkedLibrary
    try:
        yield
    finally:
        codegen._library_class = usual
