"""Hooks of mkdocs: tables of benchmarks/, which pages of docs/ link to, are on the site, too."""

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]


def on_files(files: Files, config: Any) -> Files:
    """Add the pages under the paths they have in the repository."""
    for path in sorted((ROOT / "benchmarks").rglob("*.md")):
        files.append(
            File.generated(config, path.relative_to(ROOT).as_posix(), content=path.read_text())
        )
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """From a page of docs/ they are one folder nearer on the site than in the repository."""
    return re.sub(r"\]\(\.\./benchmarks/", "](benchmarks/", markdown)
