"""What is published: the public interface as documented and typed, versions, and what is packed."""

import ast
import inspect
import os
import re
import subprocess
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import factors
import gsba

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
SCRIPTS = sorted((ROOT / "packaging").glob("*.sh"))


def _documented(package: str) -> list[str]:
    """Names of a package's table in docs/interface.md."""
    page = (ROOT / "docs" / "interface.md").read_text()
    section = page.partition(f"## `{package}`\n")[2].partition("\n## ")[0]
    return re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)


@pytest.mark.parametrize("package", [gsba, factors], ids=["gsba", "factors"])
def test_the_public_interface_is_the_documented_one(package: ModuleType) -> None:
    names = _documented(package.__name__)
    assert len(names) == len(set(names))
    assert sorted(names) == sorted(package.__all__)
    for name in names:
        assert getattr(package, name) is not None


def _functions(thing: Any) -> dict[str, Any]:
    """Python functions of a public name: itself, or its public methods and properties."""
    if inspect.isfunction(thing):
        return {thing.__name__: thing}
    found = {}
    for name, member in vars(thing).items() if inspect.isclass(thing) else ():
        if name.startswith("_") and name not in ("__init__", "__call__"):
            continue
        inner = getattr(member, "fget", None) or getattr(member, "__func__", member)
        if inspect.isfunction(inner) and inner.__module__.partition(".")[0] in ("gsba", "factors"):
            found[f"{thing.__name__}.{name}"] = inner
    return found


def test_public_names_are_typed_and_explained() -> None:
    wrong = []
    for package, name in [(each, name) for each in (gsba, factors) for name in each.__all__]:
        thing = getattr(package, name)
        if not inspect.getdoc(thing):
            wrong.append(f"{package.__name__}.{name} has no docstring")
        for label, function in _functions(thing).items():
            hints = inspect.get_annotations(function)
            untyped = set(inspect.signature(function).parameters) - hints.keys() - {"self", "cls"}
            wrong += [f"{label}: {parameter} has no type" for parameter in sorted(untyped)]
            if "return" not in hints and function.__name__ != "__init__":
                wrong.append(f"{label}: its result has no type")
    assert not wrong, wrong


def test_checkers_see_the_names_that_are_imported_late() -> None:
    """What stands under TYPE_CHECKING is what `gsba.__getattr__` gives."""
    tree = ast.parse((ROOT / "gsba" / "__init__.py").read_text())
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    seen = {
        alias.name: node.module
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert seen == gsba._HOMES and sorted(seen) == sorted(gsba.__all__)


def test_both_packages_are_marked_as_typed() -> None:
    data = PROJECT["tool"]["setuptools"]["package-data"]
    for package in ("gsba", "factors"):
        assert (ROOT / package / "py.typed").is_file() and "py.typed" in data[package]


def test_what_lies_beside_the_code_is_packed() -> None:
    data = PROJECT["tool"]["setuptools"]["package-data"]
    for package in ("gsba", "factors"):
        for path in (ROOT / package).rglob("*"):
            if path.is_file() and path.suffix not in (".py", ".pyc", ".nbi", ".nbc"):
                owners = path.relative_to(ROOT).parents[:-1]  # the package, or one that it is in
                patterns = [
                    f"{owner}/{pattern}"
                    for owner in owners
                    for pattern in data.get(".".join(owner.parts), ())
                ]
                assert any(path.match(pattern) for pattern in patterns), path


def test_the_changelog_opens_with_this_version() -> None:
    heading = re.search(r"^## (\S+), ", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert heading is not None and heading[1] == gsba.__version__
    assert PROJECT["tool"]["setuptools"]["dynamic"]["version"]["attr"] == "gsba.version.__version__"


def test_the_containers_steps_are_a_script_that_is_there() -> None:
    text = (ROOT / "Dockerfile").read_text()
    steps = re.findall(r"^RUN (.*)$", text, re.MULTILINE)
    assert len(steps) == 1 and steps[0].startswith("sh /source/packaging/install.sh ")
    assert "COPY . /source\n" in text
    ignored = (ROOT / ".dockerignore").read_text().split()
    needed = {"gsba", "factors", "packaging", "pyproject.toml", "README.md", "LICENSE"}
    assert not needed & set(ignored) and all((ROOT / name).exists() for name in needed)
    extras = re.search(r"\.whl\)\[([a-z,]+)\]", (ROOT / "packaging" / "install.sh").read_text())
    assert set(extras[1].split(",")) <= set(PROJECT["project"]["optional-dependencies"])


@pytest.mark.parametrize("script", SCRIPTS, ids=[path.name for path in SCRIPTS])
def test_scripts_can_be_run(script: Path) -> None:
    assert os.access(script, os.X_OK)
    shell = script.read_text().splitlines()[0].rpartition("/")[2].split()[-1]
    done = subprocess.run([shell, "-n", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
