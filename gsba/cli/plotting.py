"""Figures of runs: `plot`."""

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
        Path, typer.Option(help="Folder, or one file: PNG, SVG, PDF.", metavar="DIR|FILE")
    ],
    truth: Annotated[Path | None, typer.Option(help="True trajectory (TUM).")] = None,
) -> None:
    """Draw trajectories, errors and residuals of several runs side by side."""
    from gsba.plot import draw, load
    from gsba.trajectory.files import read_trajectory

    true = None if truth is None else read_trajectory(truth)
    for path in draw(load(runs, true), out, true):
        typer.echo(path)
