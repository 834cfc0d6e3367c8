"""Kernels stand alone: see `factors.compiled`."""

import ast
import importlib
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from textwrap import dedent

import pytest
from numba.core.dispatcher import Dispatcher

ROOT = Path(__file__).parents[1]
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
    assert "factors._kernels.eliminate_range" in FUNCTIONS
    assert "gsba.demo.sampling.albedo_at" in FUNCTIONS


@pytest.mark.parametrize("name", FUNCTIONS)
def test_what_a_kernel_uses_is_inlined(name: str) -> None:
    function = FUNCTIONS[name].py_func
    code = inspect.getclosurevars(function)
    for other in {**code.globals, **code.nonlocals}.values():
        if isinstance(other, Dispatcher):
            assert other.targetoptions.get("forceinline"), f"{other.__name__} must be a part"


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_kernel_leaves_no_sums_to_numpy(name: str) -> None:
    tree = ast.parse(dedent(inspect.getsource(FUNCTIONS[name].py_func)))
    used = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    assert not used & ROUNDED_ELSEWHERE
    assert not any(isinstance(node, ast.MatMult) for node in ast.walk(tree))
