"""The command `plot`, which draws figures of runs."""

from pathlib import Path
from typing import Annotated

import typer

from gsba.cli.app import command


@command
def plot(
    runs: Annotated[
        list[Path],
        typer.Argument(help="Folders of finished runs, or trajectory files.", metavar="RUN..."),
    ],
    out: Annotated[
        Path,
        typer.Option(help="Folder or one file to write: PNG, SVG, PDF.", metavar="DIR|FILE"),
    ],
    truth: Annotated[Path | None, typer.Option(help="True trajectory (TUM).")] = None,
) -> None:
    """Plot trajectories, errors and residuals of several runs."""
    from gsba.plot import draw, load
    from gsba.trajectory.files import read_trajectory

    true = None if truth is None else read_trajectory(truth)
    for path in draw(load(runs, true), out, true):
        typer.echo(path)
