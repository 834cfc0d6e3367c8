"""Frames that were replaced by other pictures after a run was made of them."""

from collections.abc import Collection
from pathlib import Path

import numpy as np

from gsba.camera.rig import CubeRig, owner_faces
from gsba.frames import cubemap
from gsba.log import GsbaError
from gsba.types import FrameSet, Reconstruction, rows_across

_FACE_PX = 640
_MIN_POINTS = 50  # of a frame, to be judged
_MIN_CORRELATION = 0.35  # of brightness in frames and of the points there, the median: .61 and more
# in 285 runs, whose least have very uneven exposures; .2 and less in frames of other places


def refuse_changed_frames(
    run: Path, reconstruction: Reconstruction, frames: FrameSet, without: Collection[str] = ()
) -> None:
    """Refuse frames that show other things than the run's points, which have the frames' colours.

    Args:
        run: folder of the run, for the message.
        reconstruction: one map of the run.
        frames: its frames, of which three are read.
        without: recordings whose frames are not read.

    Raises:
        GsbaError: most of these show other things, or one cannot be read.
    """
    observed = np.bincount(reconstruction.observation_frames, minlength=len(frames))
    left_out = [rows for name, rows in frames.recordings.items() if name in without]
    observed[[int(f) for rows in left_out for f in rows]] = 0
    rows = np.flatnonzero(observed >= _MIN_POINTS)
    if not len(rows):
        return
    rows = rows[rows_across(len(rows), 3)].tolist()
    found = [_correlation(reconstruction, frames, f) for f in rows]
    if np.median(found) < _MIN_CORRELATION:
        raise GsbaError(
            f"{frames.paths[rows[0]][0]} and other frames are no longer what {run} was made of: "
            "their colours are not those of its points; restore them, or refine again"
        )


def _correlation(reconstruction: Reconstruction, frames: FrameSet, f: int) -> float:
    """Correlation of a frame's brightness at its points with theirs; 1 if either is constant."""
    images, _ = cubemap.load(frames, f, cubemap.native_rig(frames.format_of(f), _FACE_PX))
    seen = reconstruction.observation_frames == f
    bearings = reconstruction.observation_bearings[seen]
    faces, rig = owner_faces(bearings), CubeRig(images.shape[1], np.pi / 2)
    columns, rows = np.clip(rig.project(bearings, faces).astype(int), 0, rig.size - 1).T
    shown = images[faces, rows, columns].mean(axis=1)
    known = reconstruction.point_colors[reconstruction.observation_points[seen]].mean(axis=1)
    if not (np.ptp(shown) and np.ptp(known)):
        return 1.0
    return float(np.corrcoef(shown, known)[0, 1])
