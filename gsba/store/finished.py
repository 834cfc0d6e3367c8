"""Reading of a finished run's result."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from gsba.camera.cameras import Cameras
from gsba.camera.lens import ONE_CENTRE
from gsba.log import GsbaError
from gsba.store.shards import content_digest
from gsba.store.store import load_stage
from gsba.types import FrameSet, Reconstruction


def load_run(out: Path | str, map_number: int = 1) -> tuple[Reconstruction, FrameSet]:
    """One map of a finished run, 1 = the largest, and its frames; GsbaError if `out` is no finished
    run, was edited, or has no such map."""
    out = Path(out)
    reconstruction = load_stage(out, "reconstruction", Reconstruction)
    frames = load_stage(out, "frames", FrameSet)
    if not _fit_together(reconstruction, frames):
        raise GsbaError(f"{out}: its results do not fit together: refine again with --fresh")
    frames = frames.with_formats(reconstruction.formats or frames.formats)
    main, shown = one_map(reconstruction, frames, map_number, str(out))
    if not (np.isfinite(main.world_T_rigs).all() and np.isfinite(main.points_world).all()):
        raise GsbaError(f"{out}: its poses or points are not finite: refine again with --fresh")
    if not (np.isfinite(shown.timestamps).all() and (np.diff(shown.timestamps) > 0).all()):
        raise GsbaError(f"{out}: its timestamps do not increase: refine again with --fresh")
    return main, shown


def reported(out: Path, *keys: str) -> Any:
    """Value under nested keys of a run's report.json; None = it has none, or there is no report."""
    try:
        found = json.loads((out / "report.json").read_text(encoding="utf-8"))
        for key in keys:
            found = found[key]
        return found
    except (OSError, ValueError, KeyError, TypeError):
        return None


def map_digest(main: Reconstruction, frames: FrameSet) -> str:
    """SHA-256 of the names and poses of a map's frames: it differs for other maps, and after the
    run was refined anew or has grown."""
    return content_digest(frames.names, main.world_T_rigs)


def one_map(
    reconstruction: Reconstruction, frames: FrameSet, map_number: int, name: str
) -> tuple[Reconstruction, FrameSet]:
    """Map of a reconstruction, 1 = the largest, and its frames; GsbaError if there is none."""
    num = reconstruction.num_maps
    if not 1 <= map_number <= num:
        raise GsbaError(
            f"{name} has no map {map_number}: it has {num}, numbered from 1, the largest"
        )
    return reconstruction.of_map(map_number), frames.taken(reconstruction.frames_of_map(map_number))


def load_cameras(out: Path, main: Reconstruction, frames: FrameSet, map_number: int = 1) -> Cameras:
    """Cameras of a finished run's map, in that map's unit; one centre each if none has two
    lenses."""
    if main.lens_baseline is None:
        return Cameras.of(ONE_CENTRE, frames)
    whole = load_stage(out, "reconstruction", Reconstruction)
    return cameras_of_map(load_stage(out, "lenses", Cameras), whole, map_number)


def cameras_of_map(cameras: Cameras, whole: Reconstruction, map_number: int) -> Cameras:
    """Cameras of one map's frames in its unit, from those of all frames in the largest map's."""
    return cameras.taken(whole.frames_of_map(map_number)).scaled(whole.map_scale(map_number))


def _fit_together(reconstruction: Reconstruction, frames: FrameSet) -> bool:
    """True if the lengths of arrays match, and indices are within these."""
    result, num = reconstruction, len(frames.names)
    points, seen = (sum(a.shape[:1]) for a in (result.points_world, result.observation_points))
    shapes = (
        (result.world_T_rigs, (num, 4, 4)),
        (result.pose_covariances, (num, 6, 6)),
        (result.pose_statuses, (num,)),
        (result.points_world, (points, 3)),
        (result.point_colors, (points, 3)),
        (result.point_errors, (points,)),
        (result.observation_points, (seen,)),
        (result.observation_frames, (seen,)),
        (result.observation_bearings, (seen, 3)),
        (result.observation_sigmas, (seen,)),
        (frames.timestamps, (num,)),
    )
    if (joint := result.joint_errors) is not None:
        drawn = (*joint.draws.shape[:1], num, 6)
        shapes += ((joint.neighbours, (num - 1, 6, 6)), (joint.draws, drawn))
    indices = ((result.observation_points, points), (result.observation_frames, num))
    return (
        all(array.shape == shape for array, shape in shapes)
        and len(frames.paths) == len(frames.mask_paths) == num > 0
        and len(frames.camera_of_frame) in (0, num)
        and set(frames.cameras.tolist()) == set(range(len(frames.formats)))
        and len(reconstruction.formats) in (0, len(frames.formats))
        and _numbered(result.components, result.map_scales, num)
        and all(i.size == 0 or (i.min() >= 0 and i.max() < most) for i, most in indices)
    )


def _numbered(components: np.ndarray | None, scales: np.ndarray | None, num: int) -> bool:
    """True if each of `num` frames has a component, counted from 0, and each of these a scale."""
    if components is None:
        return scales is None
    numbers = np.unique(components)
    if components.shape != (num,) or not np.array_equal(numbers, np.arange(len(numbers))):
        return False
    if scales is None:
        return True
    return scales.shape == numbers.shape and bool((scales > 0).all() and np.isfinite(scales).all())
