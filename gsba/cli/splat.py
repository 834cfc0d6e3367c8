"""Commands on splats: `train`, `render`; and the splat side of `evaluate`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from gsba.cli.app import command
from gsba.log import GsbaError

if TYPE_CHECKING:
    from gsba.splat.options import TrainingOptions


@command
def train(
    run: Path,
    iterations: int | None = None,
    face_size: int | None = None,
    max_gaussians: int | None = None,
    backend: str = "auto",
    lpips: list[Path] | None = None,
) -> None:
    """Train a splat on a run's refined poses.

    The same call again resumes.
    """
    train_on(run, splat_settings(iterations, face_size, backend, max_gaussians), lpips or [])


def train_on(run: Path, settings: "TrainingOptions", lpips: Sequence[Path] = ()) -> None:
    """Train a splat on a run's refined poses, and print how good it is and where it lies."""
    results = _compare(run, {}, settings, run / "splat", lpips)
    mean = results["refined"].mean
    typer.echo(
        f"{results['refined'].num_gaussians} Gaussians, PSNR {mean.psnr:.2f} dB, SSIM "
        f"{mean.ssim:.4f} on held-out frames: {run / 'splat' / 'refined' / 'point_cloud.ply'}"
    )


@command
def render(
    splat: Path,
    run: Path,
    frame: str,
    out: Path | None = None,
    face_size: int | None = None,
    backend: str = "auto",
) -> None:
    """Render a splat at the refined pose of a frame.

    It writes the faces that `train` compares with, and a panorama of one centre.
    """
    import numpy as np

    from gsba.camera.views import Optics
    from gsba.disk import write_image
    from gsba.splat import read_ply
    from gsba.splat.backend import choose_backend
    from gsba.splat.pictures import render_panorama, render_views
    from gsba.splat.train import near_of
    from gsba.store.finished import load_cameras, load_run
    from gsba.store.folder import claim

    settings = splat_settings(None, face_size, backend)
    reconstruction, frames = load_run(run)
    if frame not in frames.names:
        raise GsbaError(f"{run} has no frame {frame!r}: its first is {frames.names[0]!r}")
    f, folder = frames.names.index(frame), out or run / "renderings"
    if folder.resolve() in {path.resolve().parent for path in frames.paths[f]}:
        raise GsbaError(f"--out {out} is the folder of the frames: choose another for renderings")
    gaussians, renderer = read_ply(splat), choose_backend(settings.backend)
    near = near_of(reconstruction.world_T_rigs)
    optics = Optics.of(load_cameras(run, reconstruction, frames), reconstruction)
    pose, views = reconstruction.world_T_rigs[f], optics.views(settings.face_size)
    (rig,) = optics.own(pose[None], np.array([f]))
    faces = render_views(gaussians, rig, views, near, renderer)
    panorama = render_panorama(gaussians, pose, 4 * settings.face_size, near, renderer)
    for name, image in [*zip([v.name for v in views], faces, strict=True), ("erp", panorama)]:
        write_image(folder / f"{frame}_{name}.png", image)
    claim(run, folder)
    typer.echo(f"{frame}: {folder}")


def evaluate_splat(
    run: Path, against: Sequence[Path], settings: "TrainingOptions", lpips: Sequence[Path]
) -> dict[str, object]:
    """Train splats on the run's poses and on others, and compare their held-out frames; gives what
    is measured, by the name of each source, as plain values."""
    from gsba.evaluate.splats import format_table, to_json
    from gsba.trajectory.files import read_trajectory

    out = run / "splat-evaluation"
    others = {}
    for path in against:
        taken = path.stem in ("refined", *others)
        name = f"{path.parent.name}-{path.stem}" if taken else path.stem
        if name in ("refined", *others):
            raise GsbaError(f"--against {path}: another file goes by {name}, too: rename one")
        others[name] = read_trajectory(path)
    results = _compare(run, others, settings, out, lpips)
    typer.echo(format_table(results))
    typer.echo(f"Splats, images, curves and numbers are in {out}.")
    return to_json(results)


def _compare(
    run: Path, others, settings: "TrainingOptions", out: Path, lpips_weights: Sequence[Path]
):
    """Results of splats on the run's poses ("refined") and on others, by name."""
    from gsba.camera.views import Optics
    from gsba.evaluate.splats import compare, poses_for
    from gsba.inspection.changed_frames import refuse_changed_frames
    from gsba.report.html import add_splats
    from gsba.splat.backend import choose_backend
    from gsba.splat.scores import Lpips
    from gsba.store.finished import load_cameras, load_run
    from gsba.store.folder import claim

    lpips = Lpips(lpips_weights) if lpips_weights else None
    reconstruction, frames = load_run(run)
    refuse_changed_frames(run, reconstruction, frames)
    sources = {"refined": reconstruction.world_T_rigs}
    sources |= {name: poses_for(frames, trajectory) for name, trajectory in others.items()}
    renderer = choose_backend(settings.backend)
    optics = Optics.of(load_cameras(run, reconstruction, frames), reconstruction)
    results = compare(reconstruction, frames, sources, settings, renderer, out, lpips, optics)
    held_out = list(results["refined"].frames)
    picture = out / "pictures" / f"{held_out[len(held_out) // 2]}.jpg"
    add_splats(run / "report.html", picture, list(results))
    claim(run, out)
    return results


def splat_settings(
    iterations: int | None, face_size: int | None, backend: str, max_gaussians: int | None = None
) -> "TrainingOptions":
    """Settings with the options of the command line. Raises GsbaError: a value out of range."""
    from pydantic import ValidationError

    from gsba.splat.options import TrainingOptions

    options = {"iterations": iterations, "face_size": face_size, "backend": backend}
    options["max_gaussians"] = max_gaussians
    try:
        return TrainingOptions.model_validate({k: v for k, v in options.items() if v is not None})
    except ValidationError as error:
        first = error.errors()[0]
        option = str(first["loc"][0]).replace("_", "-")
        raise GsbaError(f"--{option} {first['input']}: {first['msg']}") from None
