"""Commands on footage: `extract`, `mask`, `track`."""

from pathlib import Path
from typing import Annotated

import typer

from gsba.cli.app import command
from gsba.cli.refining import Calibration
from gsba.log import GsbaError


@command
def extract(
    video: Annotated[Path, typer.Argument(help="Video: 2:1, .360, or raw of two fisheyes.")],
    out: Annotated[Path, typer.Option(help="Folder to write the frames to.", metavar="FRAMES")],
    fps: Annotated[
        float | None, typer.Option(help="Frames to keep per second; default: 1.")
    ] = None,
    every: Annotated[
        str | None,
        typer.Option(
            help="Keep one of N frames. auto: keep sharp frames with baselines that suit the "
            "scene's depth, which odometry on the video estimates.",
            metavar="N|auto",
        ),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(help="With --every auto: largest number of frames to keep.")
    ] = None,
    at: Annotated[
        Path | None,
        typer.Option(help="Keep the frames at the times of this file.", metavar="TRAJECTORY"),
    ] = None,
    sharpest: Annotated[
        bool,
        typer.Option("--sharpest", help="Keep the sharpest frame of each interval, not the first."),
    ] = False,
    from_s: Annotated[float | None, typer.Option("--from", help="Seconds to start at.")] = None,
    to_s: Annotated[float | None, typer.Option("--to", help="Seconds to end at.")] = None,
    width: Annotated[
        int | None, typer.Option(help="Width of a frame in pixels; default: as the video.")
    ] = None,
    keep_standing: Annotated[
        bool, typer.Option("--keep-standing", help="Also keep frames while the camera stands.")
    ] = False,
    fresh: Annotated[bool, typer.Option("--fresh", help="Replace an earlier extraction.")] = False,
) -> None:
    """Extract frames of a video with their exact times.

    The same call again resumes.
    """
    from gsba.config_file import validated
    from gsba.video import extract as write

    if sum(choice is not None for choice in (fps, every, at)) > 1:
        raise GsbaError("--fps, --every and --at exclude each other: pass one")
    if from_s is not None and to_s is not None and to_s <= from_s:
        raise GsbaError(f"--to {to_s:g} must be later than --from {from_s:g}")
    if frames is not None and every != "auto":
        raise GsbaError("--frames needs --every auto: pass that, too")
    if every == "auto":
        every, at = None, _chosen_by_odometry(video, out, frames, fresh, (from_s, to_s))
    options = {"fps": fps, "every": every, "at": None if at is None else str(at)}
    options |= {"from_s": from_s, "to_s": to_s, "width": width}
    chosen = {key: value for key, value in options.items() if value is not None}
    chosen |= {"sharpest": sharpest} | ({"standing_deg": 0.0} if keep_standing else {})
    counts = write(video, out, validated({"video": chosen}).video, fresh)
    why = ", ".join(f"{n} {reason}" for reason, n in counts.dropped.items() if n)
    typer.echo(f"{counts.kept} of {counts.received} frames kept{f' ({why})' if why else ''}: {out}")


def _chosen_by_odometry(
    video: Path,
    out: Path,
    frames: int | None,
    fresh: bool,
    part: tuple[float | None, float | None],
) -> Path:
    """Trajectory file beside the folder of frames, with the poses of frames that odometry chose."""
    from gsba import odometry
    from gsba.config_file import validated
    from gsba.frames.files import EXTRACTED
    from gsba.odometry.walk import write_chosen

    path = out.with_name(f"{out.name}.tum")
    if path.is_file() and (out / EXTRACTED).is_file() and not fresh:
        return path  # chosen before
    settings = validated({"odometry": {} if frames is None else {"max_frames": frames}}).odometry
    panoramas = odometry.without_carrier(odometry.of_video(video, from_s=part[0], to_s=part[1]))
    found = odometry.track_panoramas(panoramas)
    if not found.usable():
        raise GsbaError(
            f"{video}: its odometry has too few poses to choose frames by ({found.summary()}): "
            "choose them by --fps or --every N"
        )
    write_chosen(found, odometry.choose_frames(found, settings), path)
    return path


@command
def mask(
    frames: Annotated[
        Path, typer.Argument(help="Folder of 2:1 panoramas, tracks or raw fisheyes.")
    ],
    out: Annotated[Path, typer.Option(help="Folder to write the masks to.", metavar="DIR")],
    masks: Annotated[
        Path | None, typer.Option(help="Masks of your own, merged with the carrier's.")
    ] = None,
    calibration: Calibration = None,
) -> None:
    """Find the carrier of the camera and write its mask.

    The carrier is whoever or whatever holds the camera and stays in the same place of every image.
    """
    from gsba.frames.scan import scan
    from gsba.masks.carrier import find_carrier, write_carrier

    found_frames = scan(frames, masks=masks, order_suffices=True, calibration=calibration)
    carrier = find_carrier(found_frames)
    written = write_carrier(carrier, found_frames, out)
    result = carrier.reason or f"the carrier covers {100 * carrier.share:.1f}% of the image"
    if carrier.turns.any():
        result += " and rotates in it: each frame has its own mask"
    typer.echo(f"{result}: {written[0]}" + (f", {out / 'merged'}" if len(written) > 2 else ""))


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
    int,
    typer.Option(
        min=256, max=4096, help="Width in pixels of the panoramas that odometry uses; even."
    ),
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
    width: Width = 800,
    fps: Annotated[float | None, typer.Option(help="Frame rate of a folder without times.")] = None,
    timestamps: Annotated[
        Path | None, typer.Option(help="File with the times of a folder's frames.", metavar="FILE")
    ] = None,
    calibration: Calibration = None,
) -> None:
    """Estimate a pose for every frame by visual odometry."""
    from gsba import odometry
    from gsba.odometry.walk import write_odometry
    from gsba.video import is_video

    if out.is_dir():
        raise GsbaError(f"{out}: is a folder; --out names the trajectory file to write")
    if width % 2:
        raise GsbaError(f"--width {width}: use an even number")
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
