"""Commands that refine: `refine`, `demo`, `show-config`."""

import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from gsba.cli.app import command, loading
from gsba.cli.recordings import circle_of, grouped, recordings_of
from gsba.log import GsbaError, held_until_computing

if TYPE_CHECKING:
    from gsba.config import RefineSettings
    from gsba.demo.two_lenses import TwoLenses
    from gsba.pipeline import RunResult

PARTIAL = 3  # exit code of a run whose exported map has less than nine tenths of its frames, or is
# not good to train on


@command
def refine(
    frames: Path | None = None,
    trajectory: list[Path] | None = None,
    out: Path | None = None,
    recording: list[str] | None = None,
    keyframes: Path | None = None,
    trajectory_format: str | None = None,
    no_trajectory: bool = False,
    config: Path | None = None,
    overrides: list[str] | None = None,
    masks: list[Path] | None = None,
    segment: str | None = None,
    factors: str | None = None,
    timestamps: Path | None = None,
    camera: str | None = None,
    calibration: Path | None = None,
    circle: list[str] | None = None,
    imu: Path | None = None,
    gps: str | None = None,
    fps: float | None = None,
    weights: list[Path] | None = None,
    accept_noncommercial: bool = False,
    download: bool = False,
    cluster: str | None = None,
    allow_partial: bool = False,
    fresh: bool = False,
) -> None:
    """Refine the pose of every frame; the same call again resumes.

    The last line is the verdict on the map. The exit code is 3 if it is not to train, or if less
    than nine tenths of the frames are in the exported map.
    """
    if frames is None and not recording:
        raise GsbaError("give the FRAMES to refine: a folder or a video")
    with loading():
        from gsba import pipeline
        from gsba.store.cluster import connected
    given = [] if frames is None else [frames, *(trajectory or ())]
    several = bool(recording) or len(grouped(given)) > 1
    if trajectory and no_trajectory and not several:
        raise GsbaError("a TRAJECTORY and --no-trajectory exclude each other: leave one out")
    if keyframes is not None and not (trajectory or several):
        raise GsbaError("--keyframes needs the TRAJECTORY of the same SLAM run: pass that, too")
    overrides = [*_networks(weights, accept_noncommercial, download), *(overrides or ())]
    if trajectory_format is not None:
        overrides = [*overrides, f"read.trajectory_format={json.dumps(trajectory_format)}"]
    if camera is not None:
        overrides = [*overrides, f'camera.name="{camera}"']
    if gps is not None:
        overrides, families = [*overrides, f"gps.file={json.dumps(gps)}"], factors or "bearing"
        named = [family.strip() for family in families.split(",")]
        factors = families if "gps" in named else f"{families},gps"
    settings = settings_of(config, overrides, factors)
    shared: dict[str, Any] = {"odometry": False if no_trajectory else None, "fps": fps}
    shared |= {"masks": masks or "auto", "calibration": calibration}
    shared["circles"] = [circle_of(text) for text in circle or ()]
    own: dict[str, Any] = {"keyframes": keyframes, "timestamps": timestamps, "imu": imu}
    with held_until_computing(), connected(cluster) as client:
        run: dict[str, Any] = {"segment": segment, "fresh": fresh, "client": client}
        if several:
            recordings = recordings_of(given, recording or (), shared)
            for name, path in own.items():
                if path is not None:
                    raise GsbaError(
                        f"--{name} {path}: is of one recording, and {len(recordings)} are given: "
                        f"pass --recording PATH,{name}={path}"
                    )
            if out is None:
                raise GsbaError("several recordings need a name for their run: pass --out RUN")
            result = pipeline.refine_recordings(recordings, out, settings, **run)
        else:
            out = out or run_folder(given[0])
            result = pipeline.refine(given[0], trajectory, out, settings, **run, **shared, **own)
    conclude([result], allow_partial)


def run_folder(frames: Path) -> Path:
    """Folder of a run, in the working folder, named after its frames or its video."""
    name = frames.resolve().stem if frames.is_file() else f"{frames.resolve().name}-run"
    from gsba.store.folder import is_run_folder

    folder = Path(name)
    others = folder.is_dir() and any(folder.iterdir()) and not is_run_folder(folder)
    if folder.resolve() == frames.resolve() or folder.is_file() or others:
        folder = Path(f"{name}-run")
    logging.getLogger(__name__).info("results go to %s", folder)
    return folder


def conclude(results: "Sequence[RunResult]", allow_partial: bool) -> None:
    """Print the outcome of finished runs; exit with PARTIAL if one of them failed."""
    from gsba.report.maps import MIN_SHARE_IN_ONE_MAP, format_outcome

    for result in results:
        typer.echo(format_outcome(result.report, result.out))
    if allow_partial or not any(result.failed for result in results):
        return
    why = "the map is not good to train on"
    if any(result.partial for result in results):
        why = f"less than {MIN_SHARE_IN_ONE_MAP:.0%} of the frames are in the exported map"
    typer.echo(f"{why}: exit code {PARTIAL}; --allow-partial makes it 0", err=True)
    raise typer.Exit(PARTIAL)


@command
def demo(
    path: str = "rectangle",
    heading: str = "locked",
    out: Path = Path("gsba-demo"),
    frames: int | None = None,
    width: int | None = None,
    seed: int = 0,
    camera: str = "ideal",
    mesh: Path | None = None,
    video: bool = False,
    allow_partial: bool = False,
) -> None:
    """Render a walk with exact truth, refine it and compare.

    The trajectory to refine has the noise and drift of SLAM.
    """
    if video:
        if mesh is not None:
            raise GsbaError("--video renders the gallery, not a mesh: leave out --mesh")
        options = {"num_frames": frames, "width": width}
        options = {name: value for name, value in options.items() if value is not None}
        _demo_of_video(
            out, allow_partial, path=path, heading=heading, seed=seed, camera=camera, **options
        )
    else:
        frames, width = 40 if frames is None else frames, 1024 if width is None else width
        from gsba.config import CameraSettings, RefineSettings
        from gsba.demo import make_mesh_walk, make_walk
        from gsba.evaluate.trajectory import evaluate as compare
        from gsba.evaluate.trajectory import format_table
        from gsba.trajectory.files import read_trajectory

        if mesh is not None:
            if (heading, camera) != ("locked", "ideal"):
                raise GsbaError("--mesh needs an ideal camera: leave out --heading and --camera")
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
            where += f", the run with one centre in {central}"
        typer.echo(f"Frames, trajectories and truth in {out / 'walk'}, {where}.")
        conclude(results, allow_partial)


def _demo_of_video(out: Path, allow_partial: bool, **options: Any) -> None:
    """Film a walk, refine the video, and print the errors of odometry and of the refined poses."""
    from gsba.demo import make_film
    from gsba.evaluate.trajectory import evaluate as compare
    from gsba.evaluate.trajectory import format_table
    from gsba.trajectory.association import nearest
    from gsba.trajectory.files import read_trajectory
    from gsba.types import Trajectory

    film, run = make_film(out / "walk", **options), out / "run"
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
    conclude([result], allow_partial)


def _found_lenses(found: dict[str, Any], scale: float, lenses: "TwoLenses") -> str:
    """Line with the estimated baseline and readout (`camera` of report.json) beside true values;
    `scale` is metres per map unit."""
    if not found["taken"]:
        return f"Two lenses were not found: {found['reason']}."
    apart, sigma = (1e3 * scale * found[key] for key in ("baseline", "baseline_sigma"))
    line = f"Found: lenses {apart:.2f} mm apart (sigma {sigma:.2f}; true {1e3 * lenses.baseline:g})"
    readout = found["readout"]
    if not readout["taken"]:
        return f"{line}, no rolling shutter: {readout['reason']}."
    return (
        f"{line}, rows read in {readout['ms']:.2f} ms (sigma {readout['ms_sigma']:.2f}; "
        f"true {1e3 * lenses.readout_s:g})."
    )


@command
def show_config(
    config: Path | None = None, overrides: list[str] | None = None, factors: str | None = None
) -> None:
    """Print all settings as TOML, with their allowed values."""
    from gsba.config_file import to_toml

    typer.echo(to_toml(settings_of(config, overrides, factors)), nl=False)


def _networks(weights: list[Path] | None, accept_noncommercial: bool, download: bool) -> list[str]:
    """Overrides of settings from the options of learned networks.

    A folder is for both the extractor and the matcher. A file has precedence over a folder; it is
    for the matcher if its name holds "glue" (LightGlue, LighterGlue, SuperGlue), else for the
    extractor.
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


def settings_of(
    config: Path | None, overrides: list[str] | None, factors: str | None
) -> "RefineSettings":
    """Settings of a run from the options of the command line."""
    from gsba.config_file import load_config

    changes = list(overrides or ())
    if factors is not None:
        families = [family.strip() for family in factors.split(",")]
        changes.append(f"factors={json.dumps(families)}")
    return load_config(config, changes)
