"""Comparison of poses by splats that are trained on them and measured on held-out panoramas, on the
same frames with the same settings and seed. All poses are aligned to the run's world first:
Gaussians start along its axes, and walls along these gain some 0.2 dB."""

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gsba.camera.views import ONE_EYE, Optics
from gsba.disk import write_image, write_text
from gsba.evaluate import charts
from gsba.evaluate.trajectory import TOLERANCE_S, aligned_rows
from gsba.log import GsbaError
from gsba.similarity import NoSimilarityError, pose_similarity
from gsba.splat.backend import Backend
from gsba.splat.gaussians import Gaussians, write_ply
from gsba.splat.options import TrainingOptions
from gsba.splat.pictures import render_views
from gsba.splat.scene import load_faces, make_views, split_frames, start_cloud
from gsba.splat.scores import Distance, Score, mean_score, measure
from gsba.splat.train import Images, Views, near_of, train
from gsba.store.shards import content_digest
from gsba.store.store import digest, fingerprint
from gsba.trajectory.association import matched_in_time, refuse_untimed
from gsba.types import FrameSet, PoseStatus, Reconstruction, Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

logger = logging.getLogger(__name__)

NO_LPIPS = "not computed: no weights"


@dataclass(frozen=True, slots=True)
class SourceResult:
    """Scores of the splat of one source of poses."""

    frames: Mapping[str, Score]  # of the held-out frames, by name
    mean: Score  # over held-out frames
    curve: Mapping[int, Score]  # training steps -> mean over held-out frames
    num_gaussians: int


def poses_for(frames: FrameSet, trajectory: Trajectory) -> np.ndarray:
    """Pose (F, 4, 4) of each frame by time; NaN where the trajectory has none. Raises GsbaError: no
    pose is within the tolerance of a frame's time, or frames have none."""
    refuse_untimed(frames, trajectory)
    expected = Trajectory(frames.timestamps, np.tile(np.eye(4), (len(frames), 1, 1)))
    rows, which = matched_in_time(trajectory, expected, TOLERANCE_S)
    if len(which) == 0:
        raise GsbaError(
            f"no pose of the trajectory is within {TOLERANCE_S:g} s of a frame: "
            "check that both use one clock"
        )
    poses = np.full((len(frames), 4, 4), np.nan)
    poses[which] = trajectory.world_T_rigs[rows]
    return poses


def compare(
    reconstruction: Reconstruction,
    frames: FrameSet,
    sources: Mapping[str, np.ndarray],
    settings: TrainingOptions,
    backend: Backend,
    out: Path,
    lpips: Distance | None = None,
    optics: Optics = ONE_EYE,
) -> dict[str, SourceResult]:
    """Train and measure a splat for each source of poses; finished trainings are not repeated.

    Writes `out`/SOURCE/point_cloud.ply and checkpoint.npz, results.json, table.txt, curves.png and
    .svg, and pictures/FRAME.jpg: the captured faces, and below them the faces of each source.

    Args:
        reconstruction, frames: result of a finished run; its tracks make the start clouds.
        sources: name -> world_T_rigs (F, 4, 4), each in any world and scale, NaN = no pose.
        lpips: perceptual distance for the last measurement; None = do not compute it.
        optics: optics of the frames, in the run's unit; of two lenses each face is of one lens.

    Raises:
        GsbaError: too few frames have a pose in every source, or a training fails.
    """
    usable = reconstruction.pose_statuses == PoseStatus.REFINED
    for poses in sources.values():
        usable = usable & np.isfinite(poses).all(axis=(1, 2))
    split = split_frames(usable)
    own = reconstruction.world_T_rigs[usable]
    sources = {name: _beside(poses, usable, own) for name, poses in sources.items()}
    size = settings.face_size
    training = load_faces(frames, split.training, size, optics)
    held_out = load_faces(frames, split.held_out, size, optics)
    files = fingerprint(path for group in (*frames.paths, frames.mask_paths) for path in group)
    results, splats = {}, {}
    for name, poses in sources.items():
        logger.info("splat on %s poses, %d frames", name, len(split.training))
        views = [
            make_views(faces, poses[rows])
            for faces, rows in ((training, split.training), (held_out, split.held_out))
        ]
        start = start_cloud(reconstruction, poses, split.training, settings.sh_degree)
        known = content_digest(frames.formats, split.training, split.held_out, poses, start)
        key = digest(files, known, settings, backend.name, *_key_of(optics))
        near = near_of(poses[split.training])
        splats[name], scores, curve = _train_and_measure(
            start, views, settings, near, backend, out / name, key, lpips
        )
        by_frame = {frames.names[split.held_out[i]]: score for i, score in scores.items()}
        mean = mean_score(scores.values())
        results[name] = SourceResult(by_frame, mean, curve, len(splats[name]))
    _write(out, results, settings, lpips is not None)
    # Write an image of each held-out frame: a row of captured faces, then a row per source
    folder = out / "pictures"
    each = len(held_out.views)
    for i, f in enumerate(split.held_out):
        rows = [_side_by_side(held_out.images[each * i : each * (i + 1)])]
        for name, poses in sources.items():
            near = near_of(poses[split.training])
            rig = held_out.poses(poses[split.held_out])[i]
            views = render_views(splats[name], rig, held_out.views, near, backend)
            rows.append(_side_by_side(views))
        write_image(folder / f"{frames.names[f]}.jpg", np.concatenate(rows))
    return results


def _key_of(optics: Optics) -> list[object]:
    """Values of the optics, which faces depend on."""
    if not optics:
        return []
    values = (getattr(optics.lenses, entry.name) for entry in fields(optics.lenses))
    return [v.tolist() if isinstance(v, np.ndarray) else v for v in values]


def _beside(poses: np.ndarray, usable: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Poses (F, 4, 4) aligned to the run's poses `own` of the `usable` frames."""
    try:
        return pose_similarity(poses[usable], own).poses(poses)
    except NoSimilarityError:
        return poses  # they cannot be aligned, and are measured in their own world


def _write(
    out: Path, results: Mapping[str, SourceResult], settings: TrainingOptions, with_lpips: bool
) -> None:
    """Write table, numbers and curves."""
    lines = format_table(results)
    measured = "computed" if with_lpips else NO_LPIPS
    content = {"lpips": measured, "settings": settings.model_dump(), "sources": to_json(results)}
    write_text(out / "table.txt", lines + "\n")
    write_text(out / "results.json", json.dumps(content, indent=1))
    _write_curves(out, results)


def _train_and_measure(
    start: Gaussians,
    views: Sequence[Views],
    settings: TrainingOptions,
    near: float,
    backend: Backend,
    out: Path,
    key: str,
    lpips: Distance | None,
) -> tuple[Gaussians, dict[int, Score], dict[int, Score]]:
    """A splat trained on the first of two views, its scores by panorama of the second ones, and
    means of those by steps of the training; checkpoints with another `key`, a hash of everything
    that the training depends on, are ignored."""
    training, held_out = views
    curve = _read_curve(out / "curve.json", key)
    every = max(settings.iterations // 10, 1)  # measurements during a training

    def watch(step: int, gaussians: Gaussians) -> None:
        if step // every > max(curve, default=0) // every:
            scores = measure(gaussians, held_out, settings, near, backend)
            curve[step] = mean_score(scores.values())
            content = {"key": key, "curve": {s: asdict(score) for s, score in curve.items()}}
            write_text(out / "curve.json", json.dumps(content))

    splat = train(start, training, settings, backend, out / "checkpoint.npz", key, watch)
    write_ply(out / "point_cloud.ply", splat)
    return splat, measure(splat, held_out, settings, near, backend, lpips), curve


def _read_curve(path: Path, key: str) -> dict[int, Score]:
    try:
        content = json.loads(path.read_text())
        if content["key"] == key:
            return {int(step): Score(**score) for step, score in content["curve"].items()}
    except (OSError, ValueError, KeyError, TypeError):
        pass
    return {}


def to_json(results: Mapping[str, SourceResult]) -> dict[str, object]:
    """Plain dicts for json.dump."""
    return {name: asdict(result) for name, result in results.items()}


def format_table(results: Mapping[str, SourceResult]) -> str:
    """Text table with a line per source; differences are to the first source."""
    rows = [
        ["", "PSNR", "SSIM", "LPIPS", "PSNR exp.", "vs. first", "Gaussians"],
        ["", "dB", "", "", "dB", "dB", ""],
    ]
    first = next(iter(results.values())).mean.psnr
    for name, result in results.items():
        mean = result.mean
        far = "" if mean.lpips is None else f"{mean.lpips:.4f}"
        cells = [name, f"{mean.psnr:.2f}", f"{mean.ssim:.4f}", far, f"{mean.psnr_exposed:.2f}"]
        rows.append([*cells, f"{mean.psnr - first:+.2f}", str(result.num_gaussians)])
    lines = aligned_rows(rows)
    num = len(next(iter(results.values())).frames)
    notes = [
        f"Means over {num} held-out panoramas at each source's own poses. exp.: with the best gain",
        "of each channel. vs. first: PSNR less that of the first source.",
    ]
    if any(result.mean.lpips is None for result in results.values()):
        notes.append(f"LPIPS {NO_LPIPS}.")
    return "\n".join([*lines, *notes])


def _side_by_side(images: Images) -> np.ndarray:
    """Images (h, w, 3) in a row, black below the lower ones."""
    tallest = max(map(len, images))
    padded = [np.pad(image, ((0, tallest - len(image)), (0, 0), (0, 0))) for image in images]
    return np.concatenate(padded, axis=1)


def _write_curves(out: Path, results: Mapping[str, SourceResult]) -> None:
    """Plot PSNR of held-out frames over steps, a line per source, as curves.png and curves.svg."""
    lines = {
        name: np.array([(step, score.psnr) for step, score in sorted(result.curve.items())])
        for name, result in results.items()
        if len(result.curve) > 1
    }
    if not lines:
        return

    def fill(figure: "Figure") -> None:
        axes = figure.subplots()
        for (name, line), color in zip(lines.items(), charts.colors(), strict=False):
            axes.plot(line[:, 0], line[:, 1], color=color, marker=".", label=charts.plain(name))
        axes.set(xlabel="training steps", ylabel="PSNR of held-out frames, dB", xlim=(0, None))
        axes.legend()

    try:
        charts.write([out / f"curves.{kind}" for kind in ("png", "svg")], (6.0, 3.6), fill)
    except charts.NoMatplotlibError as error:
        logger.info("curves are not plotted: %s", error)
