"""Looking at footage before a run: `info`."""

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
    """Say what footage is: camera, layout, times, gyro, GPS, lenses, and the line to refine it."""
    from gsba.inspection import inspect

    found = [inspect(path) for path in files]
    if as_json:
        typer.echo(json.dumps([one.table() for one in found], indent=1, ensure_ascii=False))
        return
    typer.echo("\n\n".join(one.text() for one in found))
