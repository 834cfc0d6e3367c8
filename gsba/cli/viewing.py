"""The command `view`, which shows finished runs in the browser."""

import time
from pathlib import Path
from typing import Annotated

import typer

from gsba.cli.app import command


@command
def view(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run.", metavar="RUN")],
    port: Annotated[int, typer.Option(help="Port of 127.0.0.1; 0: any free one.")] = 8080,
) -> None:
    """Show a run in the browser.

    The scene holds the point cloud, rigs, images, trajectories and splats.
    """
    from gsba.view import load_scene, serve

    shown = serve(load_scene(run), port)
    try:
        typer.echo(f"{shown.address} shows {run}; Ctrl-C ends it.")
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        typer.echo()  # ends the line of ^C
    finally:
        shown.stop()
