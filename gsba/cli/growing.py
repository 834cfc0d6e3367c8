"""Commands on finished runs that grow: `add`."""

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
    """Add recordings of the same place to a finished run, and solve again from what it has solved.

    The settings are those of RUN, which is only read until the result is complete.
    """
    if not new and not recording:
        raise GsbaError("give the RECORDING to add: a folder of frames, or a video")
    shared: dict[str, Any] = {"odometry": False if no_trajectory else None, "fps": fps}
    shared |= {"masks": masks or "auto", "calibration": calibration}
    recordings = recordings_of(new or (), recording or (), shared)
    with loading():
        from gsba import pipeline
        from gsba.store.cluster import connected
    with connected(cluster) as client:
        given: dict[str, Any] = {"fixed": fixed, "segment": segment, "client": client}
        result = pipeline.add_recordings(run, recordings, out, **given)
    conclude([result], allow_partial)
