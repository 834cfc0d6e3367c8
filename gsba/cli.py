"""The command line. Commands parse, call and print; heavy imports stay in their bodies."""

import json
import logging
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn, ParamSpec

import typer

from gsba import __version__
from gsba.log import GsbaError, show_log

if TYPE_CHECKING:
    from gsba.config import RefineSettings

P = ParamSpec("P")

app = typer.Typer(
    help="Pixel-true camera poses for 360-degree video, from frames and a SLAM trajectory.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

Config = Annotated[Path | None, typer.Option(help="TOML file of settings.", metavar="FILE")]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", help="Override a setting; repeatable.", metavar="STAGE.KEY=VALUE"),
]
Factors = Annotated[
    str | None,
    typer.Option(help="Factor families: bearing, reprojection, or both with a comma between."),
]


@contextmanager
def _expected_failures() -> Iterator[None]:
    """One line on stderr and an exit code for whatever is no bug of ours."""
    try:
        yield
    except GsbaError as error:
        _fail(str(error))
    except KeyboardInterrupt:
        _fail("interrupted; run again to resume", code=130)
    except BrokenPipeError:  # `gsba ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(1) from None
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _fail(f"{where}{error.strerror or error}")
    except MemoryError:
        _fail("out of memory: lower cubemap.max_face_size or features.max_per_face")


def _fail(message: str, code: int = 1) -> NoReturn:
    typer.echo(f"error: {message}", err=True)
    raise typer.Exit(code)


def _command(function: Callable[P, None]) -> Callable[P, None]:
    """Register a command whose expected failures end in one line."""

    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        with _expected_failures():
            function(*args, **kwargs)

    name = function.__name__.replace("_", "-")
    return app.command(name)(run)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"gsba {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show warnings only.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Show every detail.")] = False,
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    show_log(logging.WARNING if quiet else logging.DEBUG if verbose else logging.INFO)


@_command
def refine(
    frames: Annotated[Path, typer.Argument(help="Folder of 2:1 panoramas or of cube faces.")],
    trajectory: Annotated[Path, typer.Argument(help="TUM, KITTI or stella_vslam map.msg.")],
    out: Annotated[Path, typer.Option(help="Folder of the run.", metavar="RUN")],
    config: Config = None,
    overrides: Overrides = None,
    masks: Annotated[
        Path | None, typer.Option(help="One mask for all frames, or a folder; white = use.")
    ] = None,
    factors: Factors = None,
    timestamps: Annotated[
        Path | None, typer.Option(help="Times of the frames.", metavar="FILE")
    ] = None,
    fps: Annotated[float | None, typer.Option(help="Frames per second, from time 0.")] = None,
    fresh: Annotated[bool, typer.Option("--fresh", help="Replace an earlier run.")] = False,
) -> None:
    """Refine the pose of every frame; the same call again resumes."""
    settings = _settings(config, overrides, factors)
    from gsba import pipeline

    pipeline.refine(
        frames,
        trajectory,
        out,
        settings,
        masks=masks,
        timestamps=timestamps,
        fps=fps,
        fresh=fresh,
    )
    summary = json.loads((out / "report.json").read_text())["summary"]
    typer.echo(
        f"{summary['refined']} of {summary['frames']} frames refined, {summary['points']} points, "
        f"median residual {summary['median_residual_deg']:.4f} deg: {out}"
    )


@_command
def export(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run.", metavar="RUN")],
    to: Annotated[
        str,
        typer.Option(
            help="colmap, colmap-flat, colmap-erp, nerfstudio, ply or tum.", metavar="FORMAT"
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder to write; RUN/FORMAT by default.")
    ] = None,
    face_size: Annotated[int | None, typer.Option(help="Pixels of a cube face.")] = None,
) -> None:
    """Write a finished run as a dataset for another program."""
    from gsba.export import ExportFormat
    from gsba.export import export as write
    from gsba.run_folder import claim

    if to not in list(ExportFormat):
        raise GsbaError(f"--to {to} is not known: use one of {', '.join(ExportFormat)}")
    if face_size is not None and face_size < 1:
        raise GsbaError(f"--face-size {face_size} is out of range: use 1 or more pixels")
    from gsba.pipeline import load_run

    reconstruction, frames, *_ = load_run(run)
    folder = out or run / to
    write(reconstruction, frames, folder, ExportFormat(to), face_size)
    if folder.resolve().is_relative_to(run.resolve()):
        claim(run.resolve(), folder.resolve())
    typer.echo(f"{to}: {folder}")


@_command
def evaluate(
    estimate: Annotated[Path, typer.Argument(help="A run, or a trajectory file.", metavar="RUN")],
    truth: Annotated[Path, typer.Option(help="True trajectory (TUM).")],
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Write the numbers here too.", metavar="FILE")
    ] = None,
) -> None:
    """Compare a run or a trajectory with the truth."""
    from gsba.evaluate import evaluate as compare
    from gsba.evaluate import format_table
    from gsba.read import read_trajectory
    from gsba.records import atomic_write

    path = estimate / "trajectory.tum" if estimate.is_dir() else estimate
    errors = compare(read_trajectory(path), read_trajectory(truth))
    if json_file is not None:
        text = json.dumps(errors.to_json(), indent=1) + "\n"
        atomic_write(json_file, lambda temporary: temporary.write_text(text))
    typer.echo(format_table({estimate.name: errors}))


@_command
def demo(
    path: Annotated[str, typer.Option(help="rectangle, oval or open.")] = "rectangle",
    heading: Annotated[str, typer.Option(help="locked or forward.")] = "locked",
    out: Annotated[Path, typer.Option(help="Folder for the walk and its run.")] = Path("gsba-demo"),
    frames: Annotated[int, typer.Option(help="Frames of the walk.")] = 40,
    width: Annotated[int, typer.Option(help="Pixels across a panorama.")] = 1024,
    seed: Annotated[int, typer.Option(help="Of the walk's wobble, noise and drift.")] = 0,
) -> None:
    """Render a walk with exact truth, spoil its trajectory as SLAM would, refine and compare."""
    from gsba.config import RefineSettings
    from gsba.demo import make_walk
    from gsba.evaluate import evaluate as compare
    from gsba.evaluate import format_table
    from gsba.read import read_trajectory

    walk = make_walk(out / "walk", path, heading, frames, width, seed)  # type: ignore[arg-type]
    run = out / "run"
    from gsba import pipeline

    pipeline.refine(walk.frames_dir, walk.slam_path, run, RefineSettings(), fresh=True)
    truth = read_trajectory(walk.truth_path)
    rows = {
        "before": compare(read_trajectory(walk.slam_path), truth),
        "after": compare(read_trajectory(run / "trajectory.tum"), truth),
    }
    summary = json.loads((run / "report.json").read_text())["summary"]
    residuals = (summary["median_residual_deg_coarse"], summary["median_residual_deg"])
    pixels = [f"{degrees * width / 360:.3f}" for degrees in residuals]
    typer.echo(format_table(rows, extra={"reproj. px": pixels}))
    typer.echo(
        f"Frames, trajectories and truth in {out / 'walk'}, the run with its model in {run}."
    )


@_command
def show_config(
    config: Config = None, overrides: Overrides = None, factors: Factors = None
) -> None:
    """Print all settings as TOML, with what is allowed."""
    from gsba.config_file import to_toml

    typer.echo(to_toml(_settings(config, overrides, factors)), nl=False)


def _settings(
    config: Path | None, overrides: list[str] | None, factors: str | None
) -> "RefineSettings":
    from gsba.config_file import load_config

    changes = list(overrides or ())
    if factors is not None:
        families = [family.strip() for family in factors.split(",")]
        changes.append(f"factors={json.dumps(families)}")
    return load_config(config, changes)


def main() -> None:
    """Entry point of the `gsba` script."""
    app()
