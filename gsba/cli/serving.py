"""The command `app`, which opens a page in the browser around the other commands."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints

import typer
import typer.main

from gsba.cli.app import app as commands
from gsba.cli.app import command
from gsba.log import GsbaError

if TYPE_CHECKING:
    from gsba.app import Field, Form

COMMANDS = ("refine", "add", "merge", "remove", "localize", "export", "plot")  # that pages can run
_NOT_ON_A_PAGE = ("segment", "help")  # --segment runs any command of the machine
_USAGE_ERROR: Any = typer.BadParameter.__bases__[0]  # of click, or of the copy of it that typer has


@command
def app(root: Path = Path(), port: int = 8360, state: Path | None = None) -> None:
    """Open a page in the browser to start, watch and compare runs.

    Runs go on when the page, this command or the terminal is closed.
    """
    from gsba.app import App, serve, state_folder

    folder = state or state_folder(root)
    page = App(root, folder, [form_of(name) for name in COMMANDS], choices(), check)
    serve(page, port, lambda address: typer.echo(f"{address} (Ctrl-C ends the page, not the runs)"))


def form_of(name: str) -> "Form":
    """Form of a command, from the definitions of its arguments and options."""
    from gsba.app import Form

    found = _command(name)
    hints = get_type_hints(found.callback)
    shown = [parameter for parameter in found.params if parameter.name not in _NOT_ON_A_PAGE]
    fields = tuple(_field(parameter, str(hints[parameter.name])) for parameter in shown)
    return Form(name, (found.help or "").partition("\n")[0], fields)


def check(arguments: Sequence[str]) -> None:
    """Parse arguments as the command line does, without running the command. Raises GsbaError: the
    command line would refuse them."""
    name, *rest = arguments
    try:
        _command(name).make_context(name, list(rest))
    except _USAGE_ERROR as error:
        raise GsbaError(" ".join(error.format_message().split())) from None


def choices() -> dict[str, Any]:
    """Known values of fields, from the definitions of settings and formats."""
    from gsba.config import CAMERAS, RefineSettings
    from gsba.config_file import PRESETS, allowed_settings
    from gsba.export import ExportFormat
    from gsba.export.trainers import PROGRAMS

    presets = [(path.stem, _first_sentence(path)) for path in sorted(PRESETS.glob("*.toml"))]
    return {
        "cameras": list(CAMERAS),
        "presets": presets,  # name and purpose of each
        "masks": ["auto", "carrier", "distractors", "none"],
        "programs": list(PROGRAMS),
        "formats": list(ExportFormat),
        "settings": list(allowed_settings(RefineSettings())),  # name, default, allowed values
    }


def _command(name: str) -> Any:
    return typer.main.get_command(commands).commands[name]  # type: ignore[attr-defined]


def _field(parameter: Any, annotation: str) -> "Field":
    """Field of a parameter of the command line, whose annotation names the type of its values."""
    from gsba.app import Field

    kinds = {"pathlib.Path": "path", "int": "number", "float": "number", "bool": "flag"}
    kind = next((kinds[name] for name in kinds if re.search(rf"\b{name}\b", annotation)), "text")
    is_option = parameter.param_type_name == "option"
    return Field(
        name=parameter.name,
        option=parameter.opts[0] if is_option else "",
        kind=kind,  # type: ignore[arg-type]
        help=parameter.help or "",
        metavar=parameter.metavar or "",
        required=parameter.required,
        repeatable=bool(getattr(parameter, "multiple", False)) or parameter.nargs == -1,
        parts=max(parameter.nargs, 1),
    )


def _first_sentence(path: Path) -> str:
    """First sentence of the comment that a preset begins with."""
    lines = path.read_text(encoding="utf-8").splitlines()
    text = " ".join(line.removeprefix("#").strip() for line in lines if line.startswith("#"))
    return re.split(r"(?<=[.:])\s", text)[0].rstrip(":")
