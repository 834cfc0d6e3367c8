"""The documentation is true: code runs, commands and messages exist, links lead somewhere."""

import ast
import os
import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import typer.main
import yaml
from tiny_run import NUM_FRAMES, Case

from gsba.cli import app
from gsba.config_file import PRESETS, load_config
from gsba.log import GsbaError

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]


def _name(page: Path) -> str:
    return str(page.relative_to(ROOT))


MAX_PICTURE = 400_000  # bytes
MAX_README = 120  # lines
LEAST_SAID = 12  # characters of a message that its code must have, beside what it fills in


def _blocks(page: Path, language: str) -> list[str]:
    found = re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)
    return [text for name, text in found if name == language]


def test_writing_a_factor_runs(case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "gsba-demo" / "walk").mkdir(parents=True)
    os.symlink(case.frames, tmp_path / "gsba-demo" / "walk" / "images")
    os.symlink(case.slam, tmp_path / "gsba-demo" / "walk" / "slam.tum")
    monkeypatch.chdir(tmp_path)
    code = "\n".join(_blocks(DOCS / "factors.md", "python"))
    names: dict = {"__name__": "factors_md"}
    exec(compile(code, "docs/factors.md", "exec"), names)
    assert names["result"].reconstruction.world_T_rigs.shape == (NUM_FRAMES, 4, 4)
    steps = np.abs(np.diff(names["heights"]))
    assert np.median(steps) < 0.05  # the factor's two hundredths had a say; the walk does wobble
    assert (tmp_path / "level-run" / "trajectory.tum").exists()


def test_library_and_readme_run(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    os.symlink(case.frames, tmp_path / "frames")
    os.symlink(case.slam, tmp_path / "frame_trajectory.txt")
    monkeypatch.chdir(tmp_path)
    for page in (ROOT / "README.md", DOCS / "library.md"):
        names: dict = {"__name__": page.stem}
        exec(compile("\n".join(_blocks(page, "python")), str(page), "exec"), names)
    assert names["settings"].solver.num_threads == 2
    assert len(names["frames"].names) == NUM_FRAMES


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= MAX_README


def _prose(page: Path) -> str:
    """A page without its fenced blocks."""
    return re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)


def _anchors(page: Path) -> set[str]:
    """Of the headings, as long as GitHub and the site name them alike."""
    found = set()
    for heading in re.findall(r"^#+ (.+)$", _prose(page), re.MULTILINE):
        text = re.sub(r"[^\w\s-]", "", re.sub(r"\]\([^)]*\)", "", heading)).strip().lower()
        github, site = text.replace(" ", "-"), re.sub(r"[-\s]+", "-", text)
        if github == site:
            found.add(site)
    return found


def test_links_lead_somewhere() -> None:
    pages = [*PAGES, *(ROOT / "benchmarks").rglob("*.md")]
    targets = [
        (page, target)
        for page in pages
        for target in re.findall(r"\]\(([^)]+)\)", _prose(page))
        if not target.startswith(("http://", "https://"))
    ]
    broken = [f"{_name(page)}: {target}" for page, target in targets if not _leads(page, target)]
    assert targets and not broken, broken


def _leads(page: Path, target: str) -> bool:
    """True if a link of a page has a target, on the site, too."""
    path, _, anchor = target.partition("#")
    linked = (page.parent / path) if path else page
    if not linked.exists():
        return False
    if page.parent == DOCS:  # what lies elsewhere is not on the site, but for these tables
        inside = linked.resolve().relative_to(ROOT)
        if inside.parts[0] != "docs" and (
            inside.parts[0] != "benchmarks" or inside.suffix != ".md"
        ):
            return False
    return not anchor or anchor in _anchors(linked)


def test_every_page_has_its_place() -> None:
    """In the site's navigation and in the list that GitHub shows; what is named there exists."""
    entries = yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]
    made = ("commands.md", "all-settings.md", "api.md")  # by docs/hooks.py
    shown = [e for entry in entries for e in _children(entry) if e not in made]
    pages = [page.name for page in DOCS.glob("*.md")]
    assert sorted(shown) == sorted(pages)
    listed = re.findall(r"^- \[.+?\]\((.+?)\)", (DOCS / "README.md").read_text(), re.MULTILINE)
    assert listed == shown[1:]
    for name in shown[1:]:
        assert f"](docs/{name})" in (ROOT / "README.md").read_text(), name


def _children(entry: str | dict) -> list[str]:
    """Pages of an entry of the navigation."""
    return [entry] if isinstance(entry, str) else [page for row in entry.values() for page in row]


def test_pictures_are_small_and_shown() -> None:
    shown = "".join(page.read_text() for page in PAGES)
    pictures = list((DOCS / "images").iterdir())
    assert len(pictures) >= 3
    for picture in pictures:
        assert picture.stat().st_size <= MAX_PICTURE, picture.name
        assert f"images/{picture.name})" in shown, f"{picture.name} is shown nowhere"


def _commands(page: Path) -> list[str]:
    """Calls of gsba, in fenced blocks and in code within the text."""
    text = page.read_text()
    fenced = "".join(_blocks(page, "")).replace("\\\n", " ")
    lines = [line for line in fenced.splitlines() if line.startswith("gsba ")]
    lines += re.findall(r"`(gsba [^`\n]+)`", text)
    return [re.sub(r"\s#.*", "", line).split("&&")[-1].strip() for line in lines]


def test_commands_and_options_exist() -> None:
    known = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    unknown = []
    for page, line in ((each, line) for each in PAGES for line in _commands(each)):
        name, *arguments = shlex.split(line.replace("…", ""))[1:]
        params = known[name].params if name in known else []
        options = {option for param in params for option in param.opts}
        given = {argument for argument in arguments if argument.startswith("--")}
        if name not in known or given - options:
            unknown.append(f"{_name(page)}: {line}")
    assert not unknown, unknown


def test_settings_exist() -> None:
    refused = []
    for page in PAGES:
        for together in re.findall(r"(?:--set [a-z_]+\.[a-z_]+=[^\s`|]+\s*)+", page.read_text()):
            changes = together.replace("--set", "").split()
            if "…" not in together and changes != ["stage.key=value"]:
                try:
                    load_config(None, changes)
                except GsbaError as error:
                    refused.append(f"{_name(page)}: {error}")
    assert not refused, refused


def test_events_are_listed() -> None:
    code = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "gsba").rglob("*.py"))
    kinds = set(re.findall(r"(?<!\w)event\(\s*\"(\w+)\"", code))
    table = (DOCS / "app.md").read_text().partition("## Events")[2]
    assert kinds == set(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)) - {"event"}


def test_presets_exist() -> None:
    missing = [
        f"{_name(page)}: {name}"
        for page in PAGES
        for name in re.findall(r"--config ([a-z]+)\b(?!\.)", page.read_text())
        if not (PRESETS / f"{name}.toml").exists()
    ]
    assert not missing, missing


def _constants(node: ast.AST) -> Iterator[list[str]]:
    """Texts in code, but docstrings: fixed parts, what is filled in lies between them."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.JoinedStr):
            parts = [""]
            for value in child.values:
                if isinstance(value, ast.Constant):
                    parts[-1] += str(value.value)
                else:
                    parts.append("")
            yield parts
            for value in child.values:
                yield from _constants(value)
        elif isinstance(child, ast.Constant) and isinstance(child.value, str):
            yield re.split(r"%[-.\d]*[a-z]", child.value)
        elif not (isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant)):
            yield from _constants(child)


@cache
def _texts() -> tuple[tuple[str, ...], ...]:
    """Fixed parts of whole texts of the code; something is filled in between them."""
    trees = (ast.parse(path.read_text(encoding="utf-8")) for path in (ROOT / "gsba").rglob("*.py"))
    texts = {tuple(parts) for tree in trees for parts in _constants(tree)}
    return tuple(parts for parts in sorted(texts) if len("".join(parts)) >= LEAST_SAID)


def _is_said(text: str) -> bool:
    """Whether a text of the code reads like this, filled in with names, numbers and others."""
    if len(re.findall(r"(?<![\w.])[a-z]{3,}(?![\w./=])", text)) < 3:
        return True
    able = (parts for parts in _texts() if all(part in text for part in parts))
    found = (re.fullmatch("(.*?)".join(map(re.escape, parts)), text) for parts in able)
    return any(match and all(map(_is_said, match.groups())) for match in found)


QUOTED = re.findall(r"^> `(.+)`$", (DOCS / "faq.md").read_text(), re.MULTILINE)


def test_quoted_messages_are_those_of_the_code() -> None:
    assert QUOTED and not [text for text in QUOTED if len(text.split()) <= 3 or not _is_said(text)]


def test_a_message_that_nobody_prints_is_found_out() -> None:
    assert not _is_said("frames and trajectory are not friends in time: make them meet")
