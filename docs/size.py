"""Size of the code, counted: `python docs/size.py` from anywhere in the repository.

Counts of one commit are compared with those of another by running this file in both. Functions are
told by name alone, so that a name that several functions share counts as used more than once.
"""

import ast
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("gsba", "factors")


def trees(folder: str) -> dict[Path, ast.Module]:
    """Syntax tree of every Python file under a folder of the repository."""
    return {path: ast.parse(path.read_text()) for path in sorted((ROOT / folder).rglob("*.py"))}


def num_lines(files: dict[Path, ast.Module]) -> int:
    """Lines of all files, comments, docstrings and blank ones included."""
    return sum(len(path.read_text().splitlines()) for path in files)


def num_statements(files: dict[Path, ast.Module]) -> int:
    """Statements of all files without docstrings."""
    nodes = [node for tree in files.values() for node in ast.walk(tree)]
    statements = [node for node in nodes if isinstance(node, ast.stmt)]
    texts = [s for s in statements if isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant)]
    return len(statements) - len(texts)


def functions(files: dict[Path, ast.Module]) -> list[str]:
    """Names of all functions and methods."""
    kinds = ast.FunctionDef | ast.AsyncFunctionDef
    return [
        node.name for tree in files.values() for node in ast.walk(tree) if isinstance(node, kinds)
    ]


def uses(files: dict[Path, ast.Module]) -> Counter[str]:
    """Number of times that each name is read, as a name or as an attribute."""
    nodes = [node for tree in files.values() for node in ast.walk(tree)]
    names = Counter(node.id for node in nodes if isinstance(node, ast.Name))
    return names + Counter(node.attr for node in nodes if isinstance(node, ast.Attribute))


def records(files: dict[Path, ast.Module]) -> list[str]:
    """Names of dataclasses and named tuples."""
    classes = [n for tree in files.values() for n in ast.walk(tree) if isinstance(n, ast.ClassDef)]
    marks = {node: map(ast.unparse, [*node.decorator_list, *node.bases]) for node in classes}
    return [
        node.name
        for node, words in marks.items()
        if any(word.partition("(")[0] in ("dataclass", "NamedTuple") for word in words)
    ]


def numbers(files: dict[Path, ast.Module]) -> list[str]:
    """Names in capitals that modules give a number, or several."""
    named = []
    for tree in files.values():
        for node in tree.body:
            if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                held = [n.value for n in ast.walk(node.value) if isinstance(n, ast.Constant)]
                if any(
                    isinstance(value, int | float) and not isinstance(value, bool) for value in held
                ):
                    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                    targets = [name for target in targets for name in ast.walk(target)]
                    named += [n.id for n in targets if isinstance(n, ast.Name) and n.id.isupper()]
    return named


def settings() -> list[str]:
    """Names of fields of settings that hold a value, not another table; private ones are none."""
    classes = [
        node
        for node in trees("gsba")[ROOT / "gsba/config.py"].body
        if isinstance(node, ast.ClassDef)
    ]
    tables = {node.name for node in classes}
    return [
        f"{node.name}.{ast.unparse(field.target)}"
        for node in classes
        for field in node.body
        if isinstance(field, ast.AnnAssign)
        and ast.unparse(field.annotation) not in tables
        and not ast.unparse(field.target).startswith("_")
    ]


def counts() -> dict[str, int]:
    """All counts, by what is counted."""
    files = {path: tree for package in PACKAGES for path, tree in trees(package).items()}
    tests, scripts = trees("tests"), trees("benchmarks")
    used, names = uses(files), functions(files)
    twins = Counter(
        node.name for tree in files.values() for node in tree.body if isinstance(node, ast.ClassDef)
    )
    return {
        "lines of gsba and factors": num_lines(files),
        "statements": num_statements(files),
        "files": len(files),
        "functions": len(names),
        "functions used once": sum(used[name] == 1 for name in names),
        "dataclasses and named tuples": len(records(files)),
        "class names of several classes": sum(count > 1 for count in twins.values()),
        "numeric constants of modules": len(numbers(files)),
        "settings": len(settings()),
        "lines of tests": num_lines(tests),
        "test functions": sum(name.startswith("test_") for name in functions(tests)),
        "lines of benchmarks": num_lines(scripts),
        "scripts of benchmarks": len(scripts),
    }


if __name__ == "__main__":
    for what, number in counts().items():
        print(f"{number:8,} {what}")
