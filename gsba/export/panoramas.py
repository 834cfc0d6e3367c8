"""Trajectory file and folder of panoramas, for programs without a format of their own; `gsba refine
OUT/images OUT/trajectory.tum` reads them back."""

from gsba.disk import write_csv
from gsba.export.dataset import Dataset
from gsba.export.images import has_masks, panorama_writers
from gsba.export.pictures import Files, FrameWriter
from gsba.trajectory.files import write_tum
from gsba.types import Trajectory


def write_poses(data: Dataset) -> list[list[FrameWriter]]:
    """Write `trajectory.tum` and, if panoramas are wanted, `images/timestamps.csv`, one for each
    recording; returns the writer of images and masks."""
    frames = data.frames
    trajectory = Trajectory(frames.timestamps, data.reconstruction.world_T_rigs)
    write_tum(data.folder / "trajectory.tum", trajectory)
    if data.images != "panorama":
        return []
    for recording, rows in (frames.recordings or {"": range(len(frames))}).items():
        names = (frames.names[f].rpartition("/")[2] for f in rows)
        table = zip(names, map(float, frames.timestamps[rows]), strict=True)
        path = data.folder / "images" / recording / "timestamps.csv"
        write_csv(path, ["name", "timestamp"], table)
    mask = "masks/{name}.png" if has_masks(frames) else ""
    files = Files(data.folder, ("",), "images/{name}{suffix}", mask, data.options.masks)
    return [panorama_writers(data, files)]
