"""Commands that refine: `refine`, `demo`, `show-config`."""

import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsba.cli.app import command, loading
from gsba.log import GsbaError

if TYPE_CHECKING:
    from gsba.config import RefineSettings
    from gsba.demo.two_lenses import TwoLenses
    from gsba.pipeline import RunResult

PARTIAL = 3  # exit code of a run that is exported with less than nine tenths of its frames

Config = Annotated[Path | None, typer.Option(help="TOML file of settings.", metavar="FILE")]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", help="Override a setting; repeatable.", metavar="STAGE.KEY=VALUE"),
]
Factors = Annotated[
    str | None,
    typer.Option(
        help="Families, commas between: bearing, reprojection, gps, photometric, splat, and those "
        "that packages provide, as NAME or NAME:ARGUMENT; list names all that are installed."
    ),
]
Weights = Annotated[
    list[Path] | None,
    typer.Option(
        help="Weights of a learned extractor or matcher: a file, or a folder that holds them under "
        "their official names; repeatable.",
        metavar="PATH",
    ),
]
Consent = Annotated[
    bool,
    typer.Option(
        "--accept-noncommercial", help="Use weights whose licence forbids commercial use."
    ),
]
Download = Annotated[
    bool, typer.Option("--download", help="Fetch missing weights from their authors.")
]

Frames = Annotated[
    Path,
    typer.Argument(
        help="Folder of 2:1 panoramas, raw fisheyes, .360 tracks or cube faces, or a video."
    ),
]
Trajectories = Annotated[
    list[Path] | None,
    typer.Argument(
        help="TUM, KITTI or stella_vslam map.msg; several are pieces of one run; without one "
        "a video is followed by our own odometry, and stills start from pairs of images."
    ),
]
Out = Annotated[
    Path | None,
    typer.Option(
        help="Folder of the run; default: the name of the video, or FRAMES-run.", metavar="RUN"
    ),
]
NoTrajectory = Annotated[
    bool,
    typer.Option(
        "--no-trajectory",
        help="Start from pairs of images; of a video, without its own odometry.",
    ),
]
Times = Annotated[Path | None, typer.Option(help="Times of the frames.", metavar="FILE")]
Fps = Annotated[
    float | None,
    typer.Option(
        help="Frames per second, from time 0; of a video: frames kept per second, in place of "
        "frames chosen by what they show."
    ),
]
Keyframes = Annotated[
    Path | None, typer.Option(help="Keyframe trajectory of the same run.", metavar="FILE")
]
Masks = Annotated[
    list[Path] | None,
    typer.Option(
        help="One mask for all frames, or a folder; white = use. auto: find what carries the "
        "camera (the default; carrier: or refuse); distractors: find what moves; none. Repeatable.",
        metavar="PATH",
    ),
]
Camera = Annotated[
    str | None,
    typer.Option(help="Its name, for what is said of it: insta360-x5, ...", metavar="NAME"),
]
Calibration = Annotated[
    Path | None, typer.Option(help="Of the lenses of raw fisheyes.", metavar="FILE")
]
Circle = Annotated[
    list[str] | None,
    typer.Option(
        help="Image circle of raw fisheyes where none is found: centre and radius, pixels of one "
        "lens's picture. Repeatable: front, then back; one value is for both.",
        metavar="X,Y,R",
    ),
]
Imu = Annotated[
    Path | None,
    typer.Option(
        help="Gyro and accelerometer that rode along: t, gyro x y z [rad/s], accelerometer x y z "
        "[m/s^2]; or a maker's recording.",
        metavar="FILE",
    ),
]
Gps = Annotated[
    str | None,
    typer.Option(
        help="GPS positions as factors against drift: CSV, GPX, a video, or exif (of the frames).",
        metavar="FILE",
    ),
]
Cluster = Annotated[
    str | None,
    typer.Option(
        help="Dask scheduler whose workers do what can be shared out: tcp://HOST:PORT, its "
        "FILE.json, local:N, slurm:N, ...",
        metavar="ADDRESS",
    ),
]
AllowPartial = Annotated[
    bool,
    typer.Option(
        "--allow-partial",
        help="Exit with 0 also where less than nine tenths of the frames are in one map.",
    ),
]
Segment = Annotated[
    str | None,
    typer.Option(help="Your own masks of faces: called with IMAGES MASKS.", metavar="COMMAND"),
]


@command
def refine(
    frames: Frames,
    trajectory: Trajectories = None,
    out: Out = None,
    keyframes: Keyframes = None,
    no_trajectory: NoTrajectory = False,
    config: Config = None,
    overrides: Overrides = None,
    masks: Masks = None,
    segment: Segment = None,
    factors: Factors = None,
    timestamps: Times = None,
    camera: Camera = None,
    calibration: Calibration = None,
    circle: Circle = None,
    imu: Imu = None,
    gps: Gps = None,
    fps: Fps = None,
    weights: Weights = None,
    accept_noncommercial: Consent = False,
    download: Download = False,
    cluster: Cluster = None,
    allow_partial: AllowPartial = False,
    fresh: Annotated[bool, typer.Option("--fresh", help="Replace an earlier run.")] = False,
) -> None:
    """Refine the pose of every frame; the same call again resumes.

    The exit code is 3 where less than nine tenths of the frames are in the map that is exported.
    """
    if trajectory and no_trajectory:
        raise GsbaError("a TRAJECTORY and --no-trajectory exclude each other: leave one out")
    if keyframes is not None and not trajectory:
        raise GsbaError("--keyframes go with the TRAJECTORY of the same run")
    out = out or _run_folder(frames)
    overrides = [*_networks(weights, accept_noncommercial, download), *(overrides or ())]
    if camera is not None:
        overrides = [*overrides, f'camera.name="{camera}"']
    if gps is not None:
        overrides = [*overrides, f"gps.file={json.dumps(gps)}"]
        factors = _with_gps(factors)
    settings = _settings(config, overrides, factors)
    with loading():
        from gsba import pipeline
        from gsba.store.cluster import connected
    given: dict[str, Any] = {"odometry": False if no_trajectory else None}
    given |= {"keyframes": keyframes, "segment": segment, "timestamps": timestamps, "fps": fps}
    given |= {"masks": masks or "auto", "calibration": calibration, "imu": imu, "fresh": fresh}
    given["circles"] = [_circle(text) for text in circle or ()]
    with connected(cluster) as client:
        result = pipeline.refine(frames, trajectory, out, settings, client=client, **given)
    _conclude([result], allow_partial)


def _run_folder(frames: Path) -> Path:
    """Folder of a run, in the working folder, named after its frames or its video."""
    name = frames.resolve().stem if frames.is_file() else f"{frames.resolve().name}-run"
    folder = Path(name)
    if folder.resolve() == frames.resolve() or folder.is_file():
        folder = Path(f"{name}-run")
    logging.getLogger(__name__).info("results go to %s", folder)
    return folder


def _conclude(results: "Sequence[RunResult]", allow_partial: bool) -> None:
    """Print what finished runs come down to; exit with PARTIAL where one of them is partial."""
    from gsba.report.maps import MIN_SHARE_IN_ONE_MAP, format_outcome

    for result in results:
        typer.echo(format_outcome(result.report, result.out))
    if allow_partial or not any(result.partial for result in results):
        return
    typer.echo(
        f"less than {MIN_SHARE_IN_ONE_MAP:.0%} of the frames are in the map that was exported: "
        f"exit code {PARTIAL}, or 0 with --allow-partial",
        err=True,
    )
    raise typer.Exit(PARTIAL)


@command
def demo(
    path: Annotated[
        str, typer.Option(help="rectangle, oval or open; with --mesh: a TUM file of poses.")
    ] = "rectangle",
    heading: Annotated[str, typer.Option(help="locked or forward.")] = "locked",
    out: Annotated[Path, typer.Option(help="Folder for the walk and its run.")] = Path("gsba-demo"),
    frames: Annotated[
        int | None, typer.Option(help="Frames of the walk; 40 if unsaid, of a video 240.")
    ] = None,
    width: Annotated[
        int | None, typer.Option(help="Pixels across a panorama; 1024 if unsaid, of a video 720.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the walk's wobble, noise and drift.")] = 0,
    camera: Annotated[
        str, typer.Option(help="ideal, or two-lens: as those on sale, rows read one after another.")
    ] = "ideal",
    mesh: Annotated[
        Path | None,
        typer.Option(help="Walk through this instead: OBJ, GLB or PLY with colours."),
    ] = None,
    video: Annotated[
        bool,
        typer.Option(
            "--video",
            help="Film the walk, and refine the video without any trajectory; eight frames a "
            "second, fewer --frames end on the way.",
        ),
    ] = False,
    allow_partial: AllowPartial = False,
) -> None:
    """Render a walk with exact truth, spoil its trajectory as SLAM would, refine and compare."""
    if video:
        if mesh is not None:
            raise GsbaError("--video films the gallery: leave out --mesh")
        asked = {"num_frames": frames, "width": width}
        asked = {name: value for name, value in asked.items() if value is not None}
        _demo_of_video(
            out, allow_partial, path=path, heading=heading, seed=seed, camera=camera, **asked
        )
    else:
        frames, width = 40 if frames is None else frames, 1024 if width is None else width
        _demo_of_frames(out, allow_partial, path, heading, frames, width, seed, camera, mesh)


def _demo_of_video(out: Path, allow_partial: bool, **asked: Any) -> None:
    """Film a walk, refine the video without a trajectory, and print the errors of both poses.

    Args:
        out: folder for the walk and its run.
        asked: arguments of `gsba.demo.make_film`.
    """
    from gsba.demo import make_film
    from gsba.evaluate.trajectory import evaluate as compare
    from gsba.evaluate.trajectory import format_table
    from gsba.trajectory.association import nearest
    from gsba.trajectory.files import read_trajectory
    from gsba.types import Trajectory

    film, run = make_film(out / "walk", **asked), out / "run"
    from gsba import pipeline

    result = pipeline.refine(film.video_path, None, run, fresh=True)
    truth = read_trajectory(film.truth_path)
    rows, followed = {}, run / "odometry/walk.tum"
    if followed.is_file():
        rows["odometry"] = compare(read_trajectory(followed), truth)
    at = nearest(truth.timestamps, result.frames.timestamps)
    chosen = Trajectory(truth.timestamps[at], truth.world_T_rigs[at])
    rows["refined"] = compare(read_trajectory(run / "trajectory.tum"), chosen)
    typer.echo(format_table(rows))
    if film.lenses is not None:
        typer.echo(_found_lenses(result.report["camera"], rows["refined"].scale, film.lenses))
    typer.echo(
        f"{len(result.frames)} of {len(truth.timestamps)} frames of the video were refined, "
        f"without a trajectory. Video and truth in {out / 'walk'}, the run in {run}."
    )
    _conclude([result] if len(result.maps) > 1 or result.partial else [], allow_partial)


def _demo_of_frames(
    out: Path,
    allow_partial: bool,
    path: str,
    heading: str,
    frames: int,
    width: int,
    seed: int,
    camera: str,
    mesh: Path | None,
) -> None:
    """Render a walk, refine it from a spoiled trajectory, and print errors before and after."""
    from gsba.config import CameraSettings, RefineSettings
    from gsba.demo import make_mesh_walk, make_walk
    from gsba.evaluate.trajectory import evaluate as compare
    from gsba.evaluate.trajectory import format_table
    from gsba.trajectory.files import read_trajectory

    if mesh is not None:
        if (heading, camera) != ("locked", "ideal"):
            raise GsbaError("--mesh is walked by an ideal camera: leave out --heading and --camera")
        given = None if path == "rectangle" else Path(path)
        walk = make_mesh_walk(out / "walk", mesh, given, frames, width, seed)
    else:
        walk = make_walk(out / "walk", path, heading, frames, width, seed, camera=camera)  # type: ignore[arg-type]
    run, central = out / "run", out / "run-central"
    from gsba import pipeline

    runs = {"after": (run, RefineSettings())}
    if walk.lenses is not None:
        one = RefineSettings(camera=CameraSettings(model="central"))
        runs = {"one centre": (central, one), "two lenses": (run, RefineSettings())}
    truth = read_trajectory(walk.truth_path)
    rows = {"before": compare(read_trajectory(walk.slam_path), truth)}
    residuals, report, results = [], {}, []
    for name, (folder, settings) in runs.items():
        result = pipeline.refine(walk.frames_dir, walk.slam_path, folder, settings, fresh=True)
        rows[name] = compare(read_trajectory(folder / "trajectory.tum"), truth)
        report = result.report
        residuals.append(report["summary"]["median_residual_deg"])
        results.append(result)
    residuals.insert(0, report["summary"]["median_residual_deg_coarse"])
    pixels = [f"{degrees * width / 360:.3f}" for degrees in residuals]
    typer.echo(format_table(rows, extra={"reproj. px": pixels}))
    where = f"the run with its model in {run}"
    if walk.lenses is not None:
        typer.echo(_found_lenses(report["camera"], rows["two lenses"].scale, walk.lenses))
        where += f", as seen from one centre in {central}"
    typer.echo(f"Frames, trajectories and truth in {out / 'walk'}, {where}.")
    _conclude(
        [result for result in results if len(result.maps) > 1 or result.partial], allow_partial
    )


def _found_lenses(found: dict[str, Any], scale: float, lenses: "TwoLenses") -> str:
    """One line on what a run found of its camera, beside what that is.

    Args:
        found: `camera` of report.json.
        scale: units of the truth, metres, per map unit.
    """
    if not found["taken"]:
        return f"Two lenses were not found: {found['reason']}."
    apart, sigma = (1e3 * scale * found[key] for key in ("baseline", "baseline_sigma"))
    line = f"Found: lenses {apart:.2f} mm apart (sigma {sigma:.2f}; true {1e3 * lenses.baseline:g})"
    readout = found["readout"]
    if not readout["taken"]:
        return f"{line}, no rows read one after another: {readout['reason']}."
    return (
        f"{line}, rows read in {readout['ms']:.2f} ms (sigma {readout['ms_sigma']:.2f}; "
        f"true {1e3 * lenses.readout_s:g})."
    )


@command
def show_config(
    config: Config = None, overrides: Overrides = None, factors: Factors = None
) -> None:
    """Print all settings as TOML, with what is allowed."""
    from gsba.config_file import to_toml

    typer.echo(to_toml(_settings(config, overrides, factors)), nl=False)


def _with_gps(factors: str | None) -> str:
    """Families with that of GPS, which --gps asks for."""
    families = factors or "bearing"
    named = [family.strip() for family in families.split(",")]
    return families if "gps" in named else f"{families},gps"


def _circle(text: str) -> tuple[float, float, float]:
    """Centre and radius of `--circle X,Y,R`."""
    try:
        x, y, radius = (float(part) for part in text.split(","))
    except ValueError:
        raise GsbaError(
            f"--circle {text}: give X,Y,R: a centre and a radius, three numbers with commas between"
        ) from None
    return x, y, radius


def _networks(weights: list[Path] | None, accept_noncommercial: bool, download: bool) -> list[str]:
    """Overrides for what the options on learned networks say.

    A folder is for both the extractor and the matcher; a file goes before it, and is for the
    matcher if its name says so (LightGlue, LighterGlue, SuperGlue), else for the extractor.
    """
    changes = []
    for path in sorted(weights or (), key=Path.is_file):
        stages = ["matching"] if "glue" in path.name.lower() else ["features"]
        if path.is_dir():
            stages = ["features", "matching"]
        changes += [f"{stage}.weights={json.dumps(str(path))}" for stage in stages]
    if accept_noncommercial:
        changes.append("features.accept_noncommercial=true")
    if download:
        changes.append("features.download=true")
    return changes


def _settings(
    config: Path | None, overrides: list[str] | None, factors: str | None
) -> "RefineSettings":
    from gsba.config_file import load_config

    changes = list(overrides or ())
    if factors is not None:
        families = [family.strip() for family in factors.split(",")]
        changes.append(f"factors={json.dumps(families)}")
    return load_config(config, changes)
