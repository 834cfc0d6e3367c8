"""Commands on finished runs: `export`, `evaluate`."""

import json
import logging
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from gsba.cli.app import command, loading
from gsba.cli.splat import evaluate_splat, splat_settings
from gsba.log import GsbaError

if TYPE_CHECKING:
    from gsba.camera.cameras import Cameras
    from gsba.config import GpsSettings
    from gsba.evaluate.consistency import Consistency
    from gsba.export import Shutter
    from gsba.types import FrameSet, Reconstruction, Trajectory

logger = logging.getLogger(__name__)


@command
def export(
    run: Path,
    to: str,
    out: Path | None = None,
    face_size: int | None = None,
    images: str = "auto",
    up: str = "none",
    scale: str | None = None,
    baseline: float | None = None,
    between: tuple[str, str] | None = None,
    gps: str | None = None,
    gps_sigma: float | None = None,
    gps_offset: float | None = None,
    align: str | None = None,
    align_scan: str | None = None,
    pairs: str | None = None,
    link: bool = False,
    map_number: int = 1,
    without: list[str] | None = None,
    photos: Path | None = None,
    exposure_ms: float | None = None,
    split: bool | None = None,
    masks: str = "files",
    depths: bool = False,
    exposures: bool = False,
    cluster: str | None = None,
) -> None:
    """Write a finished run as a dataset for another program."""
    with loading():
        from gsba.export import ExportOptions, export_all
    from gsba.config_file import validated
    from gsba.export.photos import read_photos
    from gsba.export.trainers import format_of, how_to_start, options_for
    from gsba.inspection.changed_frames import refuse_changed_frames
    from gsba.placement.placement import place
    from gsba.store.cluster import connected, hired
    from gsba.store.finished import load_run, map_digest
    from gsba.store.folder import claim
    from gsba.store.store import load_stage
    from gsba.types import FrameSet

    if baseline is not None and scale != "lens":
        raise GsbaError("--baseline is for --scale lens: give that as well")
    if gps is None and (gps_sigma, gps_offset) != (None, None):
        raise GsbaError("--gps-sigma and --gps-offset are of positions: give --gps FILE as well")
    name, to = to, format_of(to)
    options = options_for(name, ExportOptions(face_size, link=link, images=images), masks)
    world = {"up": up, "length": _length(scale), "between": between, "gps": gps, "align": align}
    world |= {"scan": align_scan, "pairs": pairs}
    dataset = {"face_size": face_size, "images": images, "formats": [to]}
    settings = validated({"placement": world, "export": dataset}).placement
    reconstruction, frames, *_ = load_run(run, map_number)
    if to.value not in ("ply", "tum", "gltf") or images == "panorama":
        refuse_changed_frames(run, reconstruction, frames)
    lenses = cameras_of(run, reconstruction, frames, images, map_number)
    folder = out or run / (name if map_number == 1 else f"{name}-map{map_number}")
    known = _baseline(run, baseline) if (scale, gps) != (None, None) else None
    noise = _gps_settings(run, gps_sigma, gps_offset) if gps is not None else None
    whole = None if gps is None else load_stage(run, "frames", FrameSet)
    placed = place(reconstruction, frames, settings, known, noise, whole)
    placed = replace(placed, map_number=map_number)
    options = replace(
        options,
        placement=placed,
        lenses=lenses,
        without=_left_out(run, frames, without or ()),
        photos=read_photos(photos, run, map_digest(reconstruction, frames)),
        shutter=shutter_of(run, exposure_ms),
        split=split,
        depths=depths,
        exposures=exposures,
    )
    with connected(cluster) as client, hired(client, folder, frames) as workers:
        export_all(reconstruction, frames, {to: folder}, options, workers)
    claim(run, folder)
    typer.echo("\n".join([f"{to}: {folder}", *how_to_start(name, folder, masks)]))
    if placed.origin is not None:
        latitude, longitude, _ = placed.origin
        typer.echo(
            f"placed by {gps} at latitude {latitude:.5f}, longitude {longitude:.5f}, with "
            f"{placed.similarity.scale:.4g} m to a map unit: if that is elsewhere, latitude and "
            "longitude may be swapped in the file, and the scale is wrong"
        )


def shutter_of(run: Path, exposure_ms: float | None = None) -> "Shutter":
    """Times of a picture's exposure: the readout that the run found, and the exposure as given."""
    from gsba.export import Shutter
    from gsba.store.finished import reported

    if exposure_ms is not None and not 0 < exposure_ms < 1000:
        raise GsbaError(f"--exposure-ms {exposure_ms:g}: give the milliseconds that a row is lit")
    given = (reported(run, "camera", "readout", "ms"), exposure_ms)
    return Shutter(*(None if value is None else float(value) / 1e3 for value in given))


def cameras_of(
    run: Path, reconstruction: "Reconstruction", frames: "FrameSet", images: str, map_number: int
) -> "Cameras":
    """Cameras that exported images are rendered from: one centre each, or the run's two lenses."""
    from gsba.camera.cameras import Cameras
    from gsba.camera.lens import ONE_CENTRE
    from gsba.export import of_one_lens, seen_by
    from gsba.store.finished import load_cameras

    if not any(of_one_lens(images, kind) for kind in frames.formats):
        return Cameras.of(ONE_CENTRE, frames)
    cameras = load_cameras(run, reconstruction, frames, map_number)
    if not cameras and images in ("lenses", "fisheye"):
        raise GsbaError(f"{run}: the run has one centre: export it without --images {images}")
    return seen_by(images, frames, cameras)


def _left_out(run: Path, frames: "FrameSet", names: Sequence[str]) -> tuple[str, ...]:
    """Names of frames to leave out, with those that the verdict says to leave out for `doubted`."""
    out = [name for name in names if name != "doubted"]
    if "doubted" in names:
        try:
            report = json.loads((run / "report.json").read_text(encoding="utf-8"))
            reasons = report["verdict"]["reasons"]
            doubted = {name for one in reasons if one["leave_out"] for name in one["frames"]}
        except (OSError, ValueError, KeyError, TypeError):
            raise GsbaError(
                f"{run}: its report names no frames to leave out: name them with --without NAME"
            ) from None
        out += [name for name in frames.names if name in doubted]
    return tuple(out)


def _baseline(run: Path, millimetres: float | None) -> tuple[float, float] | None:
    """Baseline of the lenses and its standard deviation, metres: `millimetres`, or the run's."""
    from gsba.config_file import load_config, validated

    if millimetres is None:
        return load_config(run / "config.toml").camera.baseline()
    return validated({"camera": {"baseline_mm": millimetres}}).camera.baseline()


def _gps_settings(run: Path, sigma: float | None, offset_s: float | None) -> "GpsSettings":
    """GPS settings of the run; `sigma` (metres) scales their horizontal and vertical noise."""
    from gsba.config_file import load_config, validated

    known = load_config(run / "config.toml").gps
    changed = known.model_dump(exclude_none=True, exclude={"file"})
    if sigma is not None:
        changed |= {"sigma_m": sigma, "sigma_up_m": sigma * known.sigma_up_m / known.sigma_m}
    if offset_s is not None:
        changed["offset_s"] = offset_s
    return validated({"gps": changed}).gps


def _length(text: str | None) -> float | str | None:
    """Length as a number where it is one; settings refuse other texts."""
    try:
        return None if text is None else float(text)
    except ValueError:
        return text


@command
def evaluate(
    estimate: Path,
    truth: Path | None = None,
    depth: Path | None = None,
    json_file: Path | None = None,
    scan: Path | None = None,
    pairs: Path | None = None,
    gps: str | None = None,
    up: str | None = None,
    splat: bool = False,
    against: list[Path] | None = None,
    iterations: int | None = None,
    face_size: int | None = None,
    max_gaussians: int | None = None,
    backend: str = "auto",
    lpips: list[Path] | None = None,
) -> None:
    """Compare a run or a trajectory with true poses or a scan.

    With --splat it compares poses by the splats that are trained on them.
    """
    from gsba.disk import write_json, write_text

    of_splats = dict[str, Any]()
    if splat:
        settings = splat_settings(iterations, face_size, backend, max_gaussians)
        of_splats["splat"] = evaluate_splat(estimate, against or [], settings, lpips or [])
    elif against or lpips or backend != "auto" or any((iterations, face_size, max_gaussians)):
        raise GsbaError(
            "--against, --iterations, --face-size, --max-gaussians, --backend and --lpips are of "
            "splats: give --splat as well"
        )
    if depth is not None and truth is None:
        raise GsbaError("--depth measures errors of poses: give --truth FILE as well")
    known = {name: str(x) for name, x in (("pairs", pairs), ("gps", gps), ("up", up)) if x}
    on_scan = dict[str, Any]()
    if scan is not None:
        on_scan = _against_scan(estimate, scan, known)
    elif known:
        raise GsbaError("--pairs, --gps and --up start the alignment to a scan: give --scan FILE")
    if truth is None:
        if not splat and scan is None:
            raise GsbaError("nothing to compare with: give --truth FILE, --scan FILE, or --splat")
        if json_file is not None:
            write_json(json_file, on_scan | of_splats)
        return
    # Compare a run or a trajectory with a true one: pose errors and induced pixel errors.
    from gsba.evaluate.pixels import depth_maps, induced_errors
    from gsba.evaluate.trajectory import evaluate as compare
    from gsba.evaluate.trajectory import format_table
    from gsba.evaluate.truth_check import fault_of_truth
    from gsba.store.folder import refuse_foreign
    from gsba.trajectory.files import read_trajectory

    path = estimate
    if estimate.is_dir():
        refuse_foreign(estimate)
        path = estimate / "trajectory.tum"
    found, true = read_trajectory(path), read_trajectory(truth)
    errors, induced = compare(found, true), None
    if depth is not None:
        ranges = depth_maps(depth, len(true.timestamps))
        induced = induced_errors(found, true, ranges, 4 * ranges(0).shape[1])
    claims, judged = None, ""
    if estimate.is_dir():
        claims, judged = _consistency(estimate, true)
    if json_file is not None:
        content = errors.to_json() | of_splats | ({"scan": on_scan} if on_scan else {})
        content |= {"induced": asdict(induced)} if induced else {}
        content |= {"consistency": claims.to_json()} if claims else {}
        write_text(json_file, json.dumps(content, indent=1) + "\n")
    typer.echo(format_table({estimate.name: errors}))
    if fault := fault_of_truth(found, true):
        logger.warning("--truth %s: %s", truth, fault)
    if induced is not None:
        typer.echo(
            "induced error, in pixels of a panorama four times as wide as the depth maps: median "
            f"{induced.median_px:.4f}, 95th percentile {induced.percentile95_px:.4f}"
        )
    if judged:
        typer.echo(judged)


def _against_scan(run: Path, path: Path, known: dict[str, str]) -> dict[str, Any]:
    """Measure a run's points against a scan: a table, RUN/scan.json, a coloured RUN/scan.ply. What
    is measured, as plain values."""
    from gsba.config_file import validated
    from gsba.disk import write_json
    from gsba.evaluate.scans import format_scan, scan_errors
    from gsba.export.ply import write_splat_points
    from gsba.placement import check, guess_in_scan
    from gsba.report.html import add_scan
    from gsba.scans import in_file, read_scan
    from gsba.store.finished import load_run
    from gsba.store.store import load_stage
    from gsba.trajectory.files import read_trajectory
    from gsba.types import FrameSet

    reconstruction, frames = load_run(run)
    settings = validated({"placement": {"scan": str(path), **known}}).placement
    check(settings, frames)
    before = run / "coarse.tum"
    coarse = read_trajectory(before).world_T_rigs if before.exists() else None
    if coarse is not None and len(coarse) != len(frames):
        raise GsbaError(
            f"{before} has {len(coarse)} poses, the run {len(frames)} frames: refine again"
        )
    surfaces = read_scan(path)
    noise = _gps_settings(run, None, None)
    whole = load_stage(run, "frames", FrameSet)
    guess, _ = guess_in_scan(reconstruction, frames, settings, surfaces, noise, whole)
    with in_file(path):
        errors = scan_errors(reconstruction, surfaces, coarse, guess)
    content = {"scan": str(path), "offset": surfaces.offset.tolist(), **errors.to_json()}
    points = {"of": len(reconstruction.points_world), "furthest": errors.furthest}
    points |= {"rows": errors.rows.tolist(), "distances": errors.after.values.round(6).tolist()}
    write_json(run / "scan.json", content | {"points": points})
    add_scan(run / "report.html", content)
    write_splat_points(run / "scan.ply", errors.cloud, errors.colors())
    typer.echo(format_scan(errors))
    typer.echo(f"{run / 'scan.json'} holds the histograms, {run / 'scan.ply'} the coloured cloud.")
    return content


def _consistency(run: Path, truth: "Trajectory") -> "tuple[Consistency | None, str]":
    """Consistency of a run's covariances with its errors, and a text; None where unknown."""
    from gsba.evaluate.consistency import consistency_of, format_consistency
    from gsba.store.finished import load_run
    from gsba.trajectory.association import refuse_untimed

    cannot = "covariances cannot be checked"
    try:
        reconstruction, frames = load_run(run)
    except GsbaError as error:
        return None, f"{cannot}: {error}"
    refuse_untimed(frames, truth)
    try:
        found = consistency_of(reconstruction, frames.timestamps, truth)
    except GsbaError as error:
        return None, f"{cannot}: {error}"
    return found, "\ncovariances\n" + format_consistency(found, frames.names.__getitem__)
