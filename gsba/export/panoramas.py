"""Trajectory file and folder of panoramas, for programs without a format of their own.

`gsba refine OUT/images OUT/trajectory.tum` reads them back, or those of one of several recordings
from OUT/images/RECORDING.
"""

import csv

from gsba.camera.views import scenes_of
from gsba.export.dataset import Dataset
from gsba.export.images import has_masks, panorama_writer
from gsba.export.pictures import Files, FrameWriter
from gsba.trajectory.files import write_tum
from gsba.types import Trajectory


def write_poses(data: Dataset) -> list[FrameWriter]:
    """Write `trajectory.tum` and, if panoramas are wanted, `images/timestamps.csv`, one for each
    recording; returns the writer of images and masks."""
    frames = data.frames
    trajectory = Trajectory(frames.timestamps, data.reconstruction.world_T_rigs)
    write_tum(data.folder / "trajectory.tum", trajectory)
    if data.images != "panorama":
        return []
    for recording, rows in (frames.recordings or {"": range(len(frames))}).items():
        images = data.folder / "images" / recording
        images.mkdir(parents=True, exist_ok=True)
        with (images / "timestamps.csv").open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["name", "timestamp"])
            names = (frames.names[f].rpartition("/")[2] for f in rows)
            writer.writerows(zip(names, map(float, frames.timestamps[rows]), strict=True))
    mask = "masks/{name}.png" if has_masks(frames) else ""
    files = Files(data.folder, ("",), "images/{name}{suffix}", mask, data.options.masks)
    given = files, frames, data.cameras, data.options.link, scenes_of(data.reconstruction)
    return [panorama_writer(*given)]
