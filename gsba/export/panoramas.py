"""Trajectory file and folder of panoramas, for programs without a format of their own.

`gsba refine OUT/images OUT/trajectory.tum` reads them back, or those of one of several recordings
from OUT/images/RECORDING.
"""

import csv
from pathlib import Path

from gsba.camera.cameras import Cameras
from gsba.camera.views import scenes_of
from gsba.export.images import has_masks, panorama_writer
from gsba.export.masks import MASK_FILES, MaskStyle
from gsba.export.pictures import Files, FrameWriter
from gsba.trajectory.files import write_tum
from gsba.types import FrameSet, Reconstruction, Trajectory


def write_poses(partial: Path, reconstruction: Reconstruction, frames: FrameSet) -> None:
    """Write `trajectory.tum` into `partial`."""
    trajectory = Trajectory(frames.timestamps, reconstruction.world_T_rigs)
    write_tum(partial / "trajectory.tum", trajectory)


def write_with_poses(
    partial: Path,
    reconstruction: Reconstruction,
    frames: FrameSet,
    cameras: Cameras,
    link: bool = False,
    masks: MaskStyle = MASK_FILES,
) -> FrameWriter:
    """Write `trajectory.tum` and `images/timestamps.csv`, one for each recording, into `partial`;
    returns the writer of the images and masks."""
    write_poses(partial, reconstruction, frames)
    for recording, rows in (frames.recordings or {"": range(len(frames))}).items():
        images = partial / "images" / recording
        images.mkdir(parents=True, exist_ok=True)
        with (images / "timestamps.csv").open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["name", "timestamp"])
            names = (frames.names[f].rpartition("/")[2] for f in rows)
            writer.writerows(zip(names, map(float, frames.timestamps[rows]), strict=True))
    mask = "masks/{name}.png" if has_masks(frames) else ""
    files = Files(partial, ("",), "images/{name}{suffix}", mask, masks)
    return panorama_writer(files, frames, cameras, link, scenes_of(reconstruction))
