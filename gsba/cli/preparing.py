"""Commands on footage: `extract`, `mask`, `track`."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from gsba.cli.app import command
from gsba.cli.recordings import circle_of
from gsba.log import GsbaError

if TYPE_CHECKING:
    from gsba.config import VideoSettings


@command
def extract(
    video: Path,
    out: Path,
    fps: float | None = None,
    every: str | None = None,
    frames: int | None = None,
    at: Path | None = None,
    sharpest: bool = False,
    from_s: float | None = None,
    to_s: float | None = None,
    width: int | None = None,
    keep_standing: bool = False,
    fresh: bool = False,
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
    if every == "auto" and sharpest:
        raise GsbaError("--every auto keeps sharp frames already: leave out --sharpest")
    options = {"fps": fps, "every": None if every == "auto" else every, "width": width}
    options |= {"at": None if at is None else str(at), "from_s": from_s, "to_s": to_s}
    chosen = {key: value for key, value in options.items() if value is not None}
    chosen |= {"sharpest": sharpest} | ({"standing_deg": 0.0} if keep_standing else {})
    settings = validated({"video": chosen}).video
    if every == "auto":
        path = _chosen_by_odometry(video, out, frames, fresh, settings)
        settings = settings.model_copy(update={"at": str(path)})
    counts = write(video, out, settings, fresh)
    why = ", ".join(f"{n} {reason}" for reason, n in counts.dropped.items() if n)
    typer.echo(f"{counts.kept} of {counts.received} frames kept{f' ({why})' if why else ''}: {out}")


def _chosen_by_odometry(
    video: Path, out: Path, frames: int | None, fresh: bool, video_settings: "VideoSettings"
) -> Path:
    """Trajectory file beside the folder of frames, with the poses of frames that odometry chose."""
    from gsba import odometry
    from gsba.config_file import validated
    from gsba.disk import with_own_name
    from gsba.frames.files import EXTRACTED
    from gsba.odometry.walk import is_chosen, write_chosen
    from gsba.trajectory.files import read_trajectory
    from gsba.video import check_video

    named = with_own_name(out)
    path = named.with_name(f"{named.name}.tum")
    if path.exists() and not is_chosen(path):
        raise GsbaError(
            f"{path}: the poses of the frames that odometry chooses go there, and it is another "
            "file: move it, or choose another --out"
        )
    if path.is_file() and (out / EXTRACTED).is_file() and not fresh:  # chosen before
        if frames is not None and len(read_trajectory(path).timestamps) > frames:
            raise GsbaError(
                f"{out} holds more than {frames} frames, chosen before: choose another --out, or "
                "--fresh to replace it"
            )
        return path
    settings = validated({"odometry": {} if frames is None else {"max_frames": frames}}).odometry
    check_video(video, video_settings)
    begin, end = video_settings.from_s, video_settings.to_s
    panoramas = odometry.without_carrier(odometry.of_video(video, from_s=begin, to_s=end))
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
    frames: Path,
    out: Path,
    masks: Path | None = None,
    calibration: Path | None = None,
    circle: list[str] | None = None,
) -> None:
    """Find the carrier of the camera and write its mask.

    The carrier is whoever or whatever holds the camera and stays in the same place of every image.
    """
    from gsba.frames.image_circles import given_circles
    from gsba.frames.scan import scan
    from gsba.masks.carrier import find_carrier, write_carrier

    if out.resolve() == frames.resolve():
        raise GsbaError(f"--out {out} is the folder of the frames: choose another for masks")
    circles = given_circles([circle_of(text) for text in circle or ()], calibration)
    found_frames = scan(frames, None, None, masks, True, calibration, circles)
    carrier = find_carrier(found_frames)
    written = write_carrier(carrier, found_frames, out)
    result = carrier.reason or f"the carrier covers {100 * carrier.share:.1f}% of the image"
    if carrier.turns.any():
        result += " and rotates in it: each frame has its own mask"
    typer.echo(f"{result}: {written[0]}" + (f", {out / 'merged'}" if len(written) > 2 else ""))


@command
def track(
    frames: Path,
    out: Path,
    keyframes: Path | None = None,
    poses: Path | None = None,
    report: Path | None = None,
    masks: str = "auto",
    width: int = 800,
    fps: float | None = None,
    timestamps: Path | None = None,
    calibration: Path | None = None,
    circle: list[str] | None = None,
) -> None:
    """Estimate a pose for every frame by visual odometry."""
    from gsba import odometry
    from gsba.frames.image_circles import given_circles
    from gsba.odometry.walk import write_odometry
    from gsba.video import is_video

    if out.is_dir():
        raise GsbaError(f"{out}: is a folder; --out names the trajectory file to write")
    if width % 2:
        raise GsbaError(f"--width {width}: use an even number")
    mask = None if masks in ("auto", "none") else Path(masks)
    circles = given_circles([circle_of(text) for text in circle or ()], calibration)
    if is_video(frames):
        if fps is not None or timestamps is not None:
            raise GsbaError(
                "a video holds the times of its frames: leave out --fps and --timestamps"
            )
        panoramas = odometry.of_video(frames, width, calibration, circles=circles)
    else:
        from gsba.frames.scan import scan

        found = scan(frames, timestamps, fps, None, True, calibration, circles)
        panoramas = odometry.of_frames(found, frames, width)
    if mask is not None:
        panoramas = odometry.masked(panoramas, mask)
    elif masks == "auto":
        panoramas = odometry.without_carrier(panoramas)
    unfinished = out.with_name(f"{out.stem}-unfinished.npz")
    walk = odometry.track_panoramas(panoramas, checkpoint=unfinished)
    if walk.posed().sum() < 2:
        raise GsbaError(
            f"{frames}: odometry finds poses for fewer than two of {len(walk)} frames: gsba refine "
            "--no-trajectory matches them as stills"
        )
    write_odometry(
        walk,
        out,
        keyframes or out.with_name(f"{out.stem}-keyframes{out.suffix}"),
        poses or out.with_name(f"{out.stem}-poses.csv"),
        report or out.with_name(f"{out.stem}-report.json"),
    )
    typer.echo(f"{walk.summary()}: {out}")
