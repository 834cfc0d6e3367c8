"""Commands on finished runs: `add`, `merge`, `remove`, `localize`."""

from pathlib import Path
from typing import Annotated, Any

import typer

from gsba.cli.app import Run, command, loading
from gsba.cli.recordings import recordings_of
from gsba.cli.refining import (
    PARTIAL,
    AllowPartial,
    Calibration,
    Cluster,
    Fps,
    Masks,
    NoTrajectory,
    Recordings,
    Segment,
    conclude,
)
from gsba.log import GsbaError

Out = Annotated[
    Path | None,
    typer.Option(
        help="Folder of the result, which leaves RUN as it is; default: RUN, and what was there is "
        "kept as RUN-before.",
        metavar="DIR",
    ),
]


@command
def add(
    run: Run,
    new: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Folder or video of a recording to add, with trajectory files after it; more "
            "recordings after these.",
            metavar="RECORDING",
        ),
    ] = None,
    out: Out = None,
    fixed: Annotated[
        bool,
        typer.Option(
            "--fixed", help="Keep the poses of RUN to the byte; solve new ones against them."
        ),
    ] = False,
    recording: Recordings = None,
    no_trajectory: NoTrajectory = False,
    masks: Masks = None,
    segment: Segment = None,
    calibration: Calibration = None,
    fps: Fps = None,
    cluster: Cluster = None,
    allow_partial: AllowPartial = False,
) -> None:
    """Add recordings of the same place to a finished run.

    What is solved is the start.

    The settings are those of RUN, which is only read until the result is complete.
    """
    if not new and not recording:
        raise GsbaError("give the RECORDING to add: a folder of frames, or a video")
    with loading():
        from gsba import pipeline
        from gsba.store.cluster import connected
    shared: dict[str, Any] = {"odometry": False if no_trajectory else None, "fps": fps}
    shared |= {"masks": masks or "auto", "calibration": calibration}
    recordings = recordings_of(new or (), recording or (), shared)
    with connected(cluster) as client:
        given: dict[str, Any] = {"fixed": fixed, "segment": segment, "client": client}
        result = pipeline.add_recordings(run, recordings, out, **given)
    conclude([result], allow_partial)


@command
def merge(
    runs: Annotated[list[Path], typer.Argument(help="Folders of finished runs.", metavar="RUN...")],
    out: Annotated[Path, typer.Option(help="Folder of the result.", metavar="DIR")],
    rigid: Annotated[
        bool,
        typer.Option(
            "--rigid",
            help="Move each map as it is; report the covariance of the similarity between them.",
        ),
    ] = False,
    cluster: Cluster = None,
    allow_partial: AllowPartial = False,
) -> None:
    """Merge finished runs of one place into one.

    Their maps are joined where they meet, and solved together.

    World, scale and settings are those of the first run. The runs are only read.
    """
    with loading():
        from gsba import pipeline
        from gsba.store.cluster import connected
    with connected(cluster) as client:
        result = pipeline.merge_runs(runs, out, rigid=rigid, client=client)
    conclude([result], allow_partial)


@command
def remove(
    run: Run,
    names: Annotated[
        list[str], typer.Argument(help="Names of recordings to take out.", metavar="NAME...")
    ],
    out: Out = None,
    allow_partial: AllowPartial = False,
) -> None:
    """Take recordings out of a finished run.

    The rest is solved again from where it was.
    """
    with loading():
        from gsba import pipeline
    conclude([pipeline.remove_recordings(run, names, out)], allow_partial)


@command
def localize(
    run: Run,
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
    if num < 0.9 * len(pictures) and not allow_partial:
        raise typer.Exit(PARTIAL)
