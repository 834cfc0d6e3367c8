"""The command `track`: odometry on a video or a folder of frames."""

from pathlib import Path
from typing import Annotated

import typer

from gsba.cli.app import command
from gsba.log import GsbaError

Keyframes = Annotated[
    Path | None,
    typer.Option(
        help="Keyframes to write, TUM; default: beside --out, named -keyframes.", metavar="FILE"
    ),
]
Report = Annotated[
    Path | None,
    typer.Option(
        help="Report to write, JSON; default: beside --out, named -report.", metavar="FILE"
    ),
]
Poses = Annotated[
    Path | None,
    typer.Option(
        help="Maps, statuses and covariances of poses to write, CSV; default: beside --out, "
        "named -poses.",
        metavar="FILE",
    ),
]
Width = Annotated[
    int | None,
    typer.Option(help="Width in pixels of the panoramas that odometry uses; default: 800."),
]


@command
def track(
    frames: Annotated[
        Path,
        typer.Argument(help="Video, or folder of 2:1 panoramas or raw fisheyes, in time order."),
    ],
    out: Annotated[
        Path, typer.Option(help="Trajectory to write: TUM, poses of all frames.", metavar="FILE")
    ],
    keyframes: Keyframes = None,
    poses: Poses = None,
    report: Report = None,
    masks: Annotated[
        str,
        typer.Option(help="auto: mask the carrier of the camera; none; or a mask, white = use."),
    ] = "auto",
    width: Width = None,
    fps: Annotated[float | None, typer.Option(help="Frame rate of a folder without times.")] = None,
    timestamps: Annotated[
        Path | None, typer.Option(help="File with the times of a folder's frames.", metavar="FILE")
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(help="Calibration of the lenses of raw fisheyes.", metavar="FILE"),
    ] = None,
) -> None:
    """Estimate a pose for every frame by visual odometry."""
    from gsba import odometry
    from gsba.config_file import validated
    from gsba.odometry.walk import write_odometry
    from gsba.video import is_video

    if out.is_dir():
        raise GsbaError(f"{out}: is a folder; --out names the trajectory file to write")
    width = validated({"odometry": {} if width is None else {"width": width}}).odometry.width
    mask = None if masks in ("auto", "none") else Path(masks)
    if is_video(frames):
        if fps is not None or timestamps is not None:
            raise GsbaError(
                "a video holds the times of its frames: leave out --fps and --timestamps"
            )
        panoramas = odometry.of_video(frames, width, calibration)
    else:
        from gsba.frames.scan import scan

        found = scan(frames, timestamps, fps, None, order_suffices=True, calibration=calibration)
        panoramas = odometry.of_frames(found, frames, width)
    if mask is not None:
        panoramas = odometry.masked(panoramas, mask)
    elif masks == "auto":
        panoramas = odometry.without_carrier(panoramas)
    unfinished = out.with_name(f"{out.stem}-unfinished.npz")
    walk = odometry.track_panoramas(panoramas, checkpoint=unfinished)
    write_odometry(
        walk,
        out,
        keyframes or out.with_name(f"{out.stem}-keyframes{out.suffix}"),
        poses or out.with_name(f"{out.stem}-poses.csv"),
        report or out.with_name(f"{out.stem}-report.json"),
    )
    typer.echo(f"{walk.summary()}: {out}")
