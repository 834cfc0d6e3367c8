"""The result of a finished run, read back."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from gsba.camera.lens import ONE_CENTRE, Lenses
from gsba.log import GsbaError
from gsba.store.store import load_stage
from gsba.types import FrameSet, Reconstruction


def load_run(out: Path) -> tuple[Reconstruction, FrameSet]:
    """Result of a finished run and the frames it was made from: the largest of its maps.

    Raises:
        GsbaError: `out` is no finished run, or was edited.
    """
    reconstruction = load_stage(out, "reconstruction", Reconstruction)
    frames = load_stage(out, "frames", FrameSet)
    if not _fit_together(reconstruction, frames):
        raise GsbaError(f"{out}: its results do not fit together: refine again with --fresh")
    fisheyes = reconstruction.fisheyes or frames.fisheyes
    frames = replace(frames, correction=reconstruction.correction, fisheyes=fisheyes)
    main, shown = (
        reconstruction.taken(reconstruction.largest_map()),
        frames.taken(reconstruction.largest_map()),
    )
    if not (np.isfinite(main.world_T_rigs).all() and np.isfinite(main.points_world).all()):
        raise GsbaError(f"{out}: its poses or points are no numbers: refine again with --fresh")
    if not (np.isfinite(shown.timestamps).all() and (np.diff(shown.timestamps) > 0).all()):
        raise GsbaError(f"{out}: its frames are in no order of time: refine again with --fresh")
    return main, shown


def load_lenses(out: Path, main: Reconstruction) -> Lenses:
    """What the frames of a finished run's largest map are stitched from, in that map's unit.

    Raises:
        GsbaError: the run found two lenses, and does not hold them.
    """
    if main.lens_baseline is None:
        return ONE_CENTRE
    lenses = load_stage(out, "lenses", Lenses)
    return lenses.taken(load_stage(out, "reconstruction", Reconstruction).largest_map())


def _fit_together(reconstruction: Reconstruction, frames: FrameSet) -> bool:
    """Whether arrays have the lengths that others speak of."""
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
        and (result.components is None or result.components.shape == (num,))
        and all(i.size == 0 or (i.min() >= 0 and i.max() < most) for i, most in indices)
    )
