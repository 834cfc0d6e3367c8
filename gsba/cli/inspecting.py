"""The command `info`, which describes footage before a run."""

import json
from pathlib import Path
from typing import Annotated

import typer

from gsba.cli.app import command


@command
def info(
    files: Annotated[list[Path], typer.Argument(help="Videos, folders of frames, pictures.")],
    as_json: Annotated[bool, typer.Option("--json", help="As JSON, for programs.")] = False,
) -> None:
    """Describe footage and print the command that refines it.

    The description names camera, layout, times, gyro, GPS and lenses.
    """
    from gsba.inspection import inspect

    found = [inspect(path) for path in files]
    if as_json:
        typer.echo(json.dumps([one.table() for one in found], indent=1, ensure_ascii=False))
        return
    typer.echo("\n\n".join(one.text() for one in found))
