"""The documentation is true: its code runs, its commands exist, its links lead somewhere."""

import os
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import typer.main
from tiny_run import NUM_FRAMES, Case

from gsba.cli import app
from gsba.config_file import load_config

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]
IDS = [str(page.relative_to(ROOT)) for page in PAGES]
MAX_PICTURE = 150_000  # bytes


def _blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)


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


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)]+)\)", page.read_text()):
        if not target.startswith(("http://", "https://", "#")):
            assert (page.parent / target.partition("#")[0]).exists(), target


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


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_commands_and_options_exist(page: Path) -> None:
    known = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    for line in _commands(page):
        name, *arguments = shlex.split(line.replace("…", ""))[1:]
        assert name in known, line
        options = {option for param in known[name].params for option in param.opts}
        for argument in arguments:
            if argument.startswith("--"):
                assert argument in options, f"{line}: {argument}"


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_settings_exist(page: Path) -> None:
    for together in re.findall(r"(?:--set [a-z_]+\.[a-z_]+=[^\s`|]+\s*)+", page.read_text()):
        changes = together.replace("--set", "").split()
        if "…" not in together and changes != ["stage.key=value"]:
            load_config(None, changes)


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_config_files_exist(page: Path) -> None:
    for name in re.findall(r"configs/([a-z]+\.toml)", page.read_text()):
        assert (ROOT / "configs" / name).exists(), name
