"""Depths of pinhole faces at the points that they show, from the map, with standard deviations.

`sparse_depths/NAME.npz` (docs/exports.md), and `depths/NAME.tiff`, maps that nerfstudio 1.1.5 reads
by `depth_file_path`: float32, thousandths of the unit in the pixels of points, 0 elsewhere, without
points of large standard deviations, for which they have no place.
"""

import logging
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from gsba.bundle.point_covariances import depth_variances
from gsba.camera.views import View
from gsba.disk import write_bytes
from gsba.export.dataset import Dataset
from gsba.export.pictures import Files
from gsba.export.sensors import pinholes, project_in_rigs
from gsba.export.split import LEFT_OUT
from gsba.types import Reconstruction

logger = logging.getLogger(__name__)

_MAX_SIGMA = 0.1  # of a depth in a map, relative: beyond, errors of depths lean (by the square of
# this, 1 %) and have long tails, while losses take all depths for equally good


def map_path(image: str) -> str:
    """Path of the depth map of an image, both within the dataset."""
    return str(Path("depths", Path(image).relative_to("images")).with_suffix(".tiff"))


def write_depths(
    data: Dataset,
    seen: Reconstruction,
    files: Sequence[Files],
    views: Sequence[tuple[View, ...]],
    maps: bool = False,
) -> None:
    """Write the depths of all images of a dataset.

    Args:
        seen: its map as seen from its cameras, see `seen_from_lenses`.
        files: (C,) files of the images of each camera's frames.
        views: (C,) of each camera.
        maps: with the maps that nerfstudio reads.

    Raises:
        GsbaError: the disk cannot be written.
    """
    partial, frames = data.folder, data.frames
    which, pixels = project_in_rigs(seen, pinholes(views), frames.cameras)
    # Depths (O,) of observed points from the views that show them, and their standard deviations
    poses, of_frame = seen.world_T_rigs, seen.observation_frames
    axes, depths = np.empty((len(which), 3)), np.empty(len(which))
    for camera, own in enumerate(views):
        taken = frames.cameras[of_frame] == camera
        for number, view in enumerate(own):
            rows = np.flatnonzero(taken & (which == number))
            world_T_view = poses[of_frame[rows]] @ view.rig_T_view
            axes[rows] = world_T_view[:, :3, 2]
            reaches = seen.points_world[seen.observation_points[rows]] - world_T_view[:, :3, 3]
            depths[rows] = np.sum(reaches * axes[rows], axis=1)
    sigmas = np.sqrt(depth_variances(data.reconstruction, axes))
    observed, num_shown, num_mapped = seen.observations_by_frame(), 0, 0
    for f, camera in enumerate(frames.cameras.tolist()):
        images = zip(views[camera], files[camera].images(frames, f), strict=True)
        for number, (view, image) in enumerate(images):
            if image.startswith(f"{LEFT_OUT}/"):
                continue
            own = observed[f][which[observed[f]] == number]
            uv, depth, sigma = (all_[own].astype(np.float32) for all_ in (pixels, depths, sigmas))
            points = seen.observation_points[own]
            name = Path("sparse_depths", Path(image).relative_to("images")).with_suffix(".npz")
            (partial / name).parent.mkdir(parents=True, exist_ok=True)
            np.savez(partial / name, uv=uv, depth=depth, sigma=sigma, point=points)
            num_shown += len(own)
            if maps:
                # Well-known depths; where two share a pixel, the better one
                order = np.argsort(-sigma)
                order = order[sigma[order] <= _MAX_SIGMA * depth[order]]
                columns, rows = np.floor(uv[order]).astype(int).T
                inside = (columns >= 0) & (columns < view.width)
                inside &= (rows >= 0) & (rows < view.height)
                image_of_depths = np.zeros((view.height, view.width), np.float32)
                image_of_depths[rows[inside], columns[inside]] = 1000.0 * depth[order][inside]
                write_map(partial / map_path(image), image_of_depths)
                num_mapped += np.count_nonzero(image_of_depths)
    more = f", {num_mapped} of them in maps" if maps else ""
    logger.info("depths of %d points in %d frames%s", num_shown, len(frames), more)


def write_map(path: Path, image: np.ndarray) -> None:
    """Write a map (h, w) float32 of depths, 0 = unknown."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # 1.3 ms and 64 KB for a face of 960; Adobe's deflate takes 37 ms for 27 KB.
    flags = [cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_PACKBITS]
    write_bytes(path, cv2.imencode(".tiff", image, flags)[1].tobytes())
