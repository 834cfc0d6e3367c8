"""Looking at the installation itself: `doctor`."""

import json
from typing import Annotated

import typer

from gsba.cli.app import command


@command
def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="As JSON, for reports.")] = False,
) -> None:
    """Say what is installed, what of it works, and what to do about the rest.

    The exit code is 0 where all works that a run needs, else 1; extras do not count.
    """
    from gsba.doctor import examine

    found = examine()
    typer.echo(json.dumps(found.table(), indent=1) if as_json else found.text())
    if not found.works:
        raise typer.Exit(1)
