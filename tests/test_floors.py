"""Who may import whom, and how long files and functions may be."""

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import gsba

ROOT = Path(__file__).parents[1]
FACTORS_MAY_USE = {"factors", "gtsam", "numba", "numpy", "scipy"}
HEAVY = {
    "av",
    "cv2",
    "gtsam",
    "kornia",
    "numba",
    "open3d",
    "pycolmap",
    "scipy",
    "torch",
    "trimesh",
    "viser",
}

FILES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for folder in ("gsba", "factors", "benchmarks")
    for path in sorted((ROOT / folder).rglob("*.py"))
}


def _package(module: str) -> str:
    """The part of a module's name that has a floor: `export` of `gsba.export.colmap`."""
    top, _, rest = module.partition(".")
    return rest.partition(".")[0] if top == "gsba" else top


def _statements(node: ast.AST) -> Iterator[ast.AST]:
    """All nodes, without what only type checkers see."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            continue
        yield child
        yield from _statements(child)


def _imports(module: str) -> set[str]:
    """Names of all modules a module imports, anywhere in it; ours down to the file."""
    found = set()
    for node in _statements(ast.parse(FILES[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: imports are absolute"
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            modules = inner & FILES.keys()
            found |= modules
            if inner - modules:
                found.add(str(node.module))
    return found


IMPORTS = {module: _imports(module) for module in FILES}
OURS = {module: names & FILES.keys() - {module} for module, names in IMPORTS.items()}


def test_factors_stand_alone() -> None:
    for module, names in IMPORTS.items():
        if _package(module) == "factors":
            used = {name.partition(".")[0] for name in names}
            foreign = used - FACTORS_MAY_USE - sys.stdlib_module_names
            assert not foreign, f"{module} imports {foreign}"


def test_there_are_no_cycles() -> None:
    try:
        TopologicalSorter(OURS).prepare()
    except CycleError as error:
        pytest.fail(f"import cycle: {' -> '.join(error.args[1])}")


@pytest.mark.parametrize("module", [name for name in FILES if _package(name) != "benchmarks"])
def test_files_and_functions_stay_short(module: str) -> None:
    text = FILES[module].read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 600, f"{module} is two things"
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            length = (node.end_lineno or 0) - node.lineno + 1
            assert length <= 60, f"{module}.{node.name} has {length} lines: it is two things"


@pytest.mark.parametrize("module", ["gsba", "gsba.cli", "gsba.config_file"])
def test_import_is_light(module: str) -> None:
    script = f"import sys, {module}; print(*{{n.partition('.')[0] for n in sys.modules}})"
    loaded = set(_python(script).stdout.split())
    assert module.partition(".")[0] in loaded and not loaded & HEAVY


def test_another_factors_package_is_refused(tmp_path: Path) -> None:
    (tmp_path / "factors").mkdir()
    (tmp_path / "factors/__init__.py").write_text("def factorize(n): ...\n")
    done = _python("import gsba", str(tmp_path))
    last = done.stderr.strip().splitlines()[-1]
    assert done.returncode == 1 and last.startswith("ImportError: gsba needs its own package")
    assert str(tmp_path) in last and "fresh virtual environment" in last


def test_public_names_exist() -> None:
    for name in gsba.__all__:
        assert getattr(gsba, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        gsba.nonsense  # type: ignore[attr-defined]  # noqa: B018


def _python(script: str, *folders: str) -> subprocess.CompletedProcess[str]:
    """A fresh interpreter that sees the same gsba behind the given folders."""
    path = os.pathsep.join([*folders, str(Path(gsba.__file__).parents[1])])
    environment = {**os.environ, "PYTHONPATH": path, "PYTHONSAFEPATH": "1"}
    return subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True
    )
