"""The package as a whole: what importing it costs, its public names, how long its files are."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import gsba

ROOT = Path(__file__).parents[1]
HEAVY = {
    "av",
    "cv2",
    "gtsam",
    "kornia",
    "matplotlib",
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
    for folder in ("gsba", "factors")
    for path in sorted((ROOT / folder).rglob("*.py"))
}


def test_files_and_functions_stay_short() -> None:
    lengths = {}
    for module, path in FILES.items():
        text = path.read_text(encoding="utf-8")
        lengths[module] = len(text.splitlines()), 600
        statements: list[ast.AST] = [ast.parse(text)]
        for node in statements:  # which grow
            kinds = ast.stmt | ast.ExceptHandler | ast.match_case
            statements += [one for one in ast.iter_child_nodes(node) if isinstance(one, kinds)]
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                length = (node.end_lineno or 0) - node.lineno + 1
                lengths[f"{module}.{node.name}:{node.lineno}"] = length, 100
    long = [f"{name} has {num} lines" for name, (num, most) in lengths.items() if num > most]
    assert not long, long


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


def test_no_folder_of_tests_hides_a_package() -> None:
    """`tests` is on sys.path, where an editable install would find its packages too late."""
    assert not [name for name in ("factors", "gsba") if (ROOT / "tests" / name).exists()]


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
