"""The command `splat`: from a video to a trained splat, or to a trainer's dataset, in one call."""

import logging
from pathlib import Path
from typing import Any

import typer

from gsba.cli.app import command, loading
from gsba.cli.recordings import circle_of
from gsba.cli.refining import conclude, run_folder, settings_of
from gsba.cli.results import cameras_of, shutter_of
from gsba.cli.splat import splat_settings, train_on
from gsba.log import GsbaError, held_until_computing

logger = logging.getLogger(__name__)


@command
def splat(
    frames: Path,
    out: Path | None = None,
    to: str | None = None,
    config: Path | None = None,
    overrides: list[str] | None = None,
    camera: str | None = None,
    calibration: Path | None = None,
    circle: list[str] | None = None,
    face_size: int | None = None,
    iterations: int | None = None,
    backend: str = "auto",
    allow_partial: bool = False,
    fresh: bool = False,
) -> None:
    """Make a splat of a video: refine, then train or export.

    It is `gsba refine`, then `gsba train` or, with --to, `gsba export --up auto`, with their
    defaults and in one run's folder. The same call again resumes.
    """
    from gsba.export.trainers import format_of
    from gsba.splat.backend import choose_backend

    if to is not None and (iterations is not None or backend != "auto"):
        raise GsbaError(f"--to {to} trains nothing here: leave out --iterations and --backend")
    training = splat_settings(iterations, face_size, backend)
    if to is not None:  # both fail before hours of work
        format_of(to)
    elif backend != "auto":
        choose_backend(backend)
    camera_name = [f'camera.name="{camera}"'] if camera is not None else []
    settings = settings_of(config, [*camera_name, *(overrides or ())], None)
    circles = [circle_of(text) for text in circle or ()]
    lenses: dict[str, Any] = {"calibration": calibration, "circles": circles}
    with loading():
        from gsba import pipeline
    with held_until_computing():
        out = out or run_folder(frames)
        result = pipeline.refine(frames, None, out, settings, **lenses, fresh=fresh)
    if to is None:
        train_on(out, training)
        typer.echo(f"walk around in it: gsba view {out}")
    else:
        _write_dataset(out, to, face_size)
    conclude([result], allow_partial)


def _write_dataset(run: Path, to: str, face_size: int | None) -> None:
    """Write the run for a program, upright where that can be told."""
    from gsba.config import PlacementSettings
    from gsba.export import ExportOptions, export_all
    from gsba.export.trainers import format_of, how_to_start, options_for
    from gsba.placement.placement import Placement, place
    from gsba.store.finished import load_run
    from gsba.store.folder import claim

    reconstruction, frames = load_run(run)
    try:
        placement = place(reconstruction, frames, PlacementSettings(up="auto"))
    except GsbaError as error:
        logger.warning("the dataset is not turned upright: %s", error)
        placement = Placement().of_trajectory(reconstruction.origin)
    folder = run / to
    lenses = cameras_of(run, reconstruction, frames, "auto", 1)
    options = ExportOptions(face_size, placement, lenses=lenses, shutter=shutter_of(run))
    export_all(reconstruction, frames, {format_of(to): folder}, options_for(to, options))
    claim(run, folder)
    typer.echo("\n".join([f"{to}: {folder}", *how_to_start(to, folder)]))
