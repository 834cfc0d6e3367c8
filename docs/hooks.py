"""Hooks of mkdocs: pages that are not files of docs/.

The site opens with the first screen of the repository's README. Tables of benchmarks/, which pages
of docs/ link to, are on the site, too. Commands and settings are listed from the code, and the
public interface from its docstrings.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]


def on_files(files: Files, config: Any) -> Files:
    """Add generated pages, and those of benchmarks/ under their paths in the repository."""
    pages = {"commands.md": commands(), "all-settings.md": settings(), "api.md": interface()}
    for path in sorted((ROOT / "benchmarks").rglob("*.md")):
        pages[path.relative_to(ROOT).as_posix()] = path.read_text()
    for name, content in pages.items():
        files.append(File.generated(config, name, content=content))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """From a page of docs/ benchmarks are one folder nearer on the site than in the repository."""
    if page.file.src_uri == "README.md":
        first_screen = (ROOT / "README.md").read_text().partition("\n## Try it")[0]
        first_screen = re.sub(r"\]\(docs/", "](", first_screen)
        markdown = first_screen + "\n\n**Begin**" + markdown.partition("\n**Begin**")[2]
    markdown = re.sub(r"\[([^\]]+)\]\([\w./-]+\.(?:py|toml)\)", r"\1", markdown)  # not published
    return re.sub(r"\]\(\.\./benchmarks/", "](benchmarks/", markdown)


def commands() -> str:
    """Page of all commands with their options."""
    import typer.main

    from gsba.cli import app

    group: Any = typer.main.get_command(app)
    lines = ["# Commands", "", "What `gsba COMMAND --help` says, made from the code.", ""]
    for name, command in sorted(group.commands.items()):
        lines += [f"## gsba {name}", "", " ".join((command.help or "").split()), ""]
        lines += ["| | | default |", "|---|---|---|"]
        for param in command.params:
            words = param.opts if param.param_type_name == "option" else [str(param.name).upper()]
            default = "" if param.default in (None, False, ()) else f"`{param.default}`"
            shown = ", ".join(f"`{word}`" for word in words)
            lines.append(f"| {shown} | {_cell(getattr(param, 'help', ''))} | {_cell(default)} |")
        lines.append("")
    return "\n".join(lines)


def settings() -> str:
    """Page of all settings with their defaults and what is allowed."""
    from gsba.config import RefineSettings
    from gsba.config_file import to_toml

    intro = "What `gsba show-config` prints, as tables made from the code."
    lines = ["# All settings", "", intro, ""]
    return "\n".join([*lines, *_settings_rows(to_toml(RefineSettings()))]) + "\n"


def _settings_rows(toml: str) -> Iterator[str]:
    head = ["", "| setting | default | allowed |", "|---|---|---|"]
    yield from head
    stage = ""
    for line in toml.splitlines():
        if table := re.match(r"\[([\w.]+)\]\s*# (.*)", line):
            stage = f"{table[1]}."
            yield from ["", f"## {table[1]}", "", table[2], *head]
        elif row := re.match(r"(\w+) = (.*?)  # (.*)", line):
            yield f"| `{stage}{row[1]}` | `{_cell(row[2])}` | {_cell(row[3])} |"


def interface() -> str:
    """Page of the public interface; mkdocstrings fills in docstrings."""
    import gsba

    lines = ["# API", "", "The [public interface](interface.md), from its docstrings.", ""]
    for name in gsba.__all__:
        thing = getattr(gsba, name)
        if hasattr(thing, "__module__"):
            lines += [f"## {name}", "", f"::: {thing.__module__}.{name}", ""]
    return "\n".join(lines)


def _cell(text: str | None) -> str:
    return " ".join((text or "").split()).replace("|", "\\|")
