"""Commands that refine: `refine`, `demo`, `show-config`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gsba.cli.app import command
from gsba.log import GsbaError

if TYPE_CHECKING:
    from gsba.config import RefineSettings

Config = Annotated[Path | None, typer.Option(help="TOML file of settings.", metavar="FILE")]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", help="Override a setting; repeatable.", metavar="STAGE.KEY=VALUE"),
]
Factors = Annotated[
    str | None,
    typer.Option(help="Factor families, commas between: bearing, reprojection, photometric."),
]

Masks = Annotated[
    list[Path] | None,
    typer.Option(
        help="One mask for all frames, or a folder; white = use. carrier (or auto), "
        "distractors: find them. Repeatable."
    ),
]
Segment = Annotated[
    str | None,
    typer.Option(help="Your own masks of faces: called with IMAGES MASKS.", metavar="COMMAND"),
]


@command
def refine(
    frames: Annotated[
        Path, typer.Argument(help="Folder of 2:1 panoramas or of cube faces, or a 2:1 video.")
    ],
    out: Annotated[Path, typer.Option(help="Folder of the run.", metavar="RUN")],
    trajectory: Annotated[
        Path | None, typer.Argument(help="TUM, KITTI or stella_vslam map.msg.")
    ] = None,
    keyframes: Annotated[
        Path | None, typer.Option(help="Keyframe trajectory of the same run.", metavar="FILE")
    ] = None,
    no_trajectory: Annotated[
        bool, typer.Option("--no-trajectory", help="Start from the images alone.")
    ] = False,
    config: Config = None,
    overrides: Overrides = None,
    masks: Masks = None,
    segment: Segment = None,
    factors: Factors = None,
    timestamps: Annotated[
        Path | None, typer.Option(help="Times of the frames.", metavar="FILE")
    ] = None,
    fps: Annotated[
        float | None,
        typer.Option(help="Frames per second, from time 0; of a video: frames kept per second."),
    ] = None,
    fresh: Annotated[bool, typer.Option("--fresh", help="Replace an earlier run.")] = False,
) -> None:
    """Refine the pose of every frame; the same call again resumes."""
    if (trajectory is None) != no_trajectory:
        raise GsbaError("give either a TRAJECTORY or --no-trajectory")
    if keyframes is not None and no_trajectory:
        raise GsbaError("--keyframes go with the TRAJECTORY of the same run")
    settings = _settings(config, overrides, factors)
    from gsba import pipeline

    pipeline.refine(
        frames,
        trajectory,
        out,
        settings,
        keyframes=keyframes,
        masks=masks,
        segment=segment,
        timestamps=timestamps,
        fps=fps,
        fresh=fresh,
    )
    summary = json.loads((out / "report.json").read_text())["summary"]
    typer.echo(
        f"{summary['refined']} of {summary['frames']} frames refined, {summary['points']} points, "
        f"median residual {summary['median_residual_deg']:.4f} deg: {out}"
    )


@command
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


@command
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
