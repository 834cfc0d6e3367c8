"""The command `localize`: poses of new pictures in a finished run."""

from pathlib import Path
from typing import Annotated

import typer

from gsba.cli.app import command, loading
from gsba.cli.refining import PARTIAL
from gsba.log import GsbaError

_ENOUGH = 0.9  # share of the pictures that must be localised for exit code 0


@command
def localize(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run.", metavar="RUN")],
    images: Annotated[
        list[Path],
        typer.Argument(help="Pictures of the run's cameras, or photos: files, folders, videos."),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder to write; default: beside the pictures, NAME-localized.", metavar="DIR"
        ),
    ] = None,
    map_number: Annotated[
        int, typer.Option("--map", help="Number of the map; 1: the largest.", metavar="NUMBER")
    ] = 1,
    camera_of: Annotated[
        str | None,
        typer.Option(
            help="Recording whose camera took the pictures; default: their layout and size tell.",
            metavar="RECORDING",
        ),
    ] = None,
    fast: Annotated[
        bool,
        typer.Option(
            "--fast",
            help="Rest on keypoints alone: half the time, errors about three times as large.",
        ),
    ] = False,
    allow_partial: Annotated[
        bool,
        typer.Option(
            "--allow-partial",
            help="Exit with 0 even if less than nine tenths of the pictures are localised.",
        ),
    ] = False,
) -> None:
    """Find the poses of new pictures in a finished run.

    The run stays as it is.

    The index of the run's places is kept beside it, in RUN-index.
    """
    with loading():
        from gsba.localization import Localizer, find_pictures, localize_all, write_localized

    out = out or images[0].with_name(f"{images[0].stem}-localized")
    if out.resolve() == run.resolve() or run.resolve() in out.resolve().parents:
        raise GsbaError(f"--out {out} is in the run's folder, which stays as it is: choose another")
    localizer = Localizer(run, map_number, not fast, camera_of)
    pictures = find_pictures(images, localizer.cameras, out)
    found = localize_all(localizer, pictures)
    for frame in found.frames:
        if not frame.found:
            typer.echo(f"{frame.name}: not localised: {frame.reason}", err=True)
    write_localized(out, run, found, pictures)
    num = sum(frame.found for frame in found.frames)
    typer.echo(f"{num} of {len(pictures)} pictures localised: {out}")
    if num < _ENOUGH * len(pictures) and not allow_partial:
        raise typer.Exit(PARTIAL)
