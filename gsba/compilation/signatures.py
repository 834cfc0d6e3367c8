"""Signatures of the kernels that each kind of work calls, in `signatures.json`.

A kernel is `module.function`, its signature the list of its arguments' types: a scalar is Numba's
name of it, an array `dtype dimensions layout` and `readonly` where it lies in a mapped file, a
named tuple `{"module.class": [types]}`, a tuple the list of its types. Kernels are in the order of
their first call; `benchmarks/cold.py --record` writes them.
"""

# pyright: reportAttributeAccessIssue=false
# Numba declares neither its settings nor the inside of its compiler.

import importlib
import json
from pathlib import Path
from typing import Any

from numba import types

FILE = Path(__file__).with_name("signatures.json")
KINDS = ("demo", "refine", "odometry")  # of work

Signature = tuple[types.Type, ...]


def names(kind: str) -> list[str]:
    """Full names of the kernels of a kind of work."""
    return [name for name, _ in _recorded(kind)]


def read(kind: str) -> list[tuple[str, Signature]]:
    """Kernels of a kind of work and their signatures."""
    return [(name, tuple(map(_decode, signature))) for name, signature in _recorded(kind)]


def write(recorded: dict[str, list[tuple[str, Signature]]]) -> None:
    """Replace the file by these kernels, by kind of work."""
    lines = []
    for kind, kernels in recorded.items():
        rows = [json.dumps([name, list(map(_encode, signature))]) for name, signature in kernels]
        lines.append(f'"{kind}": [\n' + ",\n".join(rows) + "\n]")
    FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def _recorded(kind: str) -> list[list[Any]]:
    return json.loads(FILE.read_text(encoding="utf-8"))[kind]


def find(name: str) -> Any:
    """A kernel, or another member of a module, by its full name; imports the module."""
    module, _, member = name.rpartition(".")
    return getattr(importlib.import_module(module), member)


def _encode(kind: types.Type) -> Any:
    if isinstance(kind, types.Array):
        return f"{kind.dtype} {kind.ndim} {kind.layout}{'' if kind.mutable else ' readonly'}"
    if isinstance(kind, types.BaseNamedTuple):
        made = kind.instance_class
        return {f"{made.__module__}.{made.__qualname__}": list(map(_encode, kind.types))}
    if isinstance(kind, types.BaseTuple):
        return list(map(_encode, kind.types))
    return str(kind)


def _decode(text: Any) -> Any:
    if isinstance(text, dict):
        ((name, members),) = text.items()
        return types.BaseNamedTuple.from_types(list(map(_decode, members)), find(name))
    if isinstance(text, list):
        return types.BaseTuple.from_types(list(map(_decode, text)))
    name, *layout = text.split()
    kind = types.boolean if name == "bool" else getattr(types, name)
    return types.Array(kind, int(layout[0]), layout[1], len(layout) == 3) if layout else kind
