"""Commands on finished runs that grow: `add`, `merge`, `remove`."""

from pathlib import Path
from typing import Annotated, Any

import typer

from gsba.cli.app import command, loading
from gsba.cli.recordings import recordings_of
from gsba.cli.refining import (
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

Run = Annotated[Path, typer.Argument(help="Folder of a finished run.", metavar="RUN")]
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
