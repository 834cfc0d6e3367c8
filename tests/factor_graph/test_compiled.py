"""Kernels stand alone: see `factors.compiled`."""

import ast
import importlib
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

from factors.compiled import kernel_and_part

ROOT = Path(__file__).parents[2]
MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for folder in ("factors", "gsba")
    for path in (ROOT / folder).rglob("*.py")
    if re.search(r"^@_?(kernel|part)$", path.read_text(), re.MULTILINE)
)
ROUNDED_ELSEWHERE = {"sum", "mean", "dot", "cross", "std", "var", "prod", "trace", "outer", "norm"}


def compiled_functions() -> Iterator[Dispatcher]:
    for name in MODULES:
        for member in vars(importlib.import_module(name)).values():
            if isinstance(member, Dispatcher) and member.__module__ == name:
                yield member


FUNCTIONS = {f"{each.__module__}.{each.__name__}": each for each in compiled_functions()}


def test_kernels_are_found() -> None:
    assert "factors._kernels.eliminate_rows" in FUNCTIONS
    assert "gsba.demo.sampling.albedo_at" in FUNCTIONS


def test_what_a_kernel_uses_is_inlined() -> None:
    wrong = []
    for name, function in FUNCTIONS.items():
        code = inspect.getclosurevars(function.py_func)
        for other in {**code.globals, **code.nonlocals}.values():
            if isinstance(other, Dispatcher) and not other.targetoptions.get("forceinline"):
                wrong.append(f"{name} calls {other.__name__}, which must be a part")
    assert not wrong, wrong


def test_a_kernel_leaves_no_sums_to_numpy() -> None:
    wrong = []
    for name, function in FUNCTIONS.items():
        tree = ast.parse(dedent(inspect.getsource(function.py_func)))
        used = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
        used &= ROUNDED_ELSEWHERE
        used |= {"@" for node in ast.walk(tree) if isinstance(node, ast.MatMult)}
        wrong += [f"{name} uses {each}" for each in sorted(used)]
    assert not wrong, wrong


def test_a_part_that_returns_an_array_is_refused() -> None:
    """It does not count the reference that its caller would release."""

    def given(array: np.ndarray) -> tuple[int, np.ndarray]:
        return 1, array

    kernel, part = kernel_and_part()
    inner = part(given)

    @kernel
    def outer(array: np.ndarray) -> float:
        return inner(array)[1][0]

    with pytest.raises(Exception, match="given returns an array"):
        outer(np.zeros(2))


def test_errors_of_numbas_own_functions_reach_the_caller() -> None:
    """They are linked into the kernel, as parts are."""
    kernel, _ = kernel_and_part()

    @kernel
    def copied(array: np.ndarray, other: np.ndarray) -> None:
        array[:] = other

    for _ in range(2):
        with pytest.raises(ValueError, match=r"cannot assign slice of shape \(3,\)"):
            copied(np.zeros(3), np.zeros(4))
        copied._reset_overloads()  # the second time from the disk


def test_a_part_called_from_python_runs_as_python() -> None:
    _, part = kernel_and_part()

    @part
    def doubled(x: float) -> float:
        return 2 * x

    assert doubled(1.5) == 3.0
