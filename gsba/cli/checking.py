"""The command `doctor`, which checks the installation."""

import json
from typing import Annotated

import typer

from gsba.cli.app import command
from gsba.log import GsbaError


@command
def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="As JSON, for reports.")] = False,
) -> None:
    """Check the installation and suggest repairs.

    The exit code is 0 if everything that a run needs works, else 1; extras do not count.
    """
    try:
        from gsba.doctor import examine
    except ModuleNotFoundError as error:  # of the parser of requirements
        raise GsbaError(f"doctor needs {error.name}: pip install {error.name}") from None

    found = examine()
    typer.echo(json.dumps(found.table(), indent=1) if as_json else found.text())
    if not found.works:
        raise typer.Exit(1)
