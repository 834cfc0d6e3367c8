"""Commands that show: `view`, `info`, `doctor`, `plot`."""

import json
import time
from pathlib import Path

import typer

from gsba.cli.app import command
from gsba.log import GsbaError


@command
def view(run: Path, port: int = 8080) -> None:
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


@command
def info(files: list[Path], as_json: bool = False) -> None:
    """Describe footage or a run, and print the command to give next.

    The description names camera, layout, times, gyro, GPS and lenses; of a run, its inputs, result
    and verdict.
    """
    from gsba.inspection import inspect

    found = [inspect(path) for path in files]
    if as_json:
        typer.echo(json.dumps([one.table() for one in found], indent=1, ensure_ascii=False))
        return
    typer.echo("\n\n".join(one.text() for one in found))


@command
def doctor(as_json: bool = False) -> None:
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


@command
def plot(runs: list[Path], out: Path, truth: Path | None = None) -> None:
    """Plot trajectories, errors and residuals of several runs."""
    from gsba.report.plots import draw, load
    from gsba.trajectory.files import read_trajectory

    true = None if truth is None else read_trajectory(truth)
    for path in draw(load(runs, true), out, true):
        typer.echo(path)
