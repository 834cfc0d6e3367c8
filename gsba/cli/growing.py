"""Commands on finished runs: `add`, `merge`, `remove`, `localize`."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

import typer

from gsba.cli.app import command, loading
from gsba.cli.recordings import circle_of, recordings_of
from gsba.cli.refining import PARTIAL, conclude
from gsba.log import GsbaError


@command
def add(
    run: Path,
    new: list[Path] | None = None,
    out: Path | None = None,
    fixed: bool = False,
    recording: list[str] | None = None,
    no_trajectory: bool = False,
    masks: list[Path] | None = None,
    segment: str | None = None,
    calibration: Path | None = None,
    circle: list[str] | None = None,
    fps: float | None = None,
    cluster: str | None = None,
    allow_partial: bool = False,
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
    shared["circles"] = [circle_of(text) for text in circle or ()]
    recordings = recordings_of(new or (), recording or (), shared)
    _refuse_changed([run])
    with connected(cluster) as client:
        given: dict[str, Any] = {"fixed": fixed, "segment": segment, "client": client}
        result = pipeline.add_recordings(run, recordings, out, **given)
    conclude([result], allow_partial)


def _refuse_changed(runs: list[Path], without: Collection[str] = ()) -> None:
    """Refuse runs whose frames, but those of some recordings, are no longer those that they were
    made of."""
    from gsba.inspection.changed_frames import refuse_changed_frames
    from gsba.store.finished import load_run

    for run in runs:
        refuse_changed_frames(run, *load_run(run), without)


@command
def merge(
    runs: list[Path],
    out: Path,
    rigid: bool = False,
    cluster: str | None = None,
    allow_partial: bool = False,
) -> None:
    """Merge finished runs of one place into one.

    Their maps are joined where they meet, and solved together.

    World, scale and settings are those of the first run. The runs are only read.
    """
    with loading():
        from gsba import pipeline
        from gsba.store.cluster import connected
    _refuse_changed(runs)
    with connected(cluster) as client:
        result = pipeline.merge_runs(runs, out, rigid=rigid, client=client)
    conclude([result], allow_partial)


@command
def remove(
    run: Path, names: list[str], out: Path | None = None, allow_partial: bool = False
) -> None:
    """Take recordings out of a finished run.

    The rest is solved again from where it was.
    """
    with loading():
        from gsba import pipeline
    _refuse_changed([run], names)
    conclude([pipeline.remove_recordings(run, names, out)], allow_partial)


@command
def localize(
    run: Path,
    images: list[Path],
    out: Path | None = None,
    map_number: int = 1,
    camera_of: str | None = None,
    fast: bool = False,
    allow_partial: bool = False,
) -> None:
    """Find the poses of new pictures in a finished run.

    The run stays as it is.

    The index of the run's places is kept beside it, in RUN-index.
    """
    with loading():
        from gsba.disk import with_own_name
        from gsba.localization import Localizer, find_pictures, localize_all, write_localized

    first = with_own_name(images[0])
    out = out or first.with_name(f"{first.stem}-localized")
    if out.resolve() == run.resolve() or run.resolve() in out.resolve().parents:
        raise GsbaError(f"--out {out} is in the run's folder, which stays as it is: choose another")
    localizer = Localizer(run, map_number, not fast, camera_of)
    pictures = find_pictures(images, localizer.cameras, out)
    found = localize_all(localizer, pictures)
    for frame in found.frames:
        if not frame.found:
            typer.echo(f"{frame.name}: not localised: {frame.reason}", err=True)
    write_localized(out, localizer.map, found, pictures)
    num = sum(frame.found for frame in found.frames)
    typer.echo(f"{num} of {len(pictures)} pictures localised: {out}")
    if num < 0.9 * len(pictures) and not allow_partial:
        raise typer.Exit(PARTIAL)
