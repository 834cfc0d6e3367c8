"""OpenSfM projects of panoramas: poses, cloud, tracks, camera models, images and masks.

As OpenSfM's `io.py` and `tracks_manager.cc` read them (023d057): `rotation` (a rotation vector) and
`translation` take the world to a camera with our axes; `tracks.csv` (v2) holds shot, track,
feature, x and y from the picture's middle in its widths, scale (here the standard deviation),
colour, segmentation and instance (-1 = none). z points up; placed by GPS, the world lies around
`reference_lla.json`. Shots go by their file names, all in one folder.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from gsba.camera.one_centre import seen_from_the_middle
from gsba.camera.sphere import erp_from_bearings
from gsba.export.dataset import Dataset
from gsba.export.images import has_masks, panorama_writers
from gsba.export.names import base_names
from gsba.export.pictures import Files, FrameWriter
from gsba.geometry import inverse
from gsba.log import GsbaError
from gsba.types import FrameSet, Reconstruction


def write_opensfm(data: Dataset) -> list[FrameWriter]:
    """Write a project, in a world whose z points up, without images; returns their writer. Raises
    GsbaError: the frames are cube faces, or two of them get one file name."""
    from scipy.spatial.transform import Rotation

    frames, partial, placement = data.frames, data.folder, data.placement
    if not all(kind.panoramic for kind in frames.formats):
        raise GsbaError("opensfm needs panoramas, these frames are cube faces: use colmap")
    mask = "masks/{name}{suffix}.png" if has_masks(frames) else ""
    names = base_names(frames.names)  # OpenSfM looks into no subfolder
    files = Files(partial, ("",), "images/{name}{suffix}", mask, data.options.masks, names)
    shots = [files.images(frames, f)[0].removeprefix("images/") for f in range(len(frames))]
    models = {
        _camera_name(kind.width, kind.height): {
            "projection_type": "spherical",
            "width": kind.width,
            "height": kind.height,
        }
        for kind in frames.formats
    }
    seen = seen_from_the_middle(data.reconstruction) if data.cameras else data.reconstruction
    cameras_T_world = inverse(seen.world_T_rigs)
    rotations = Rotation.from_matrix(cameras_T_world[:, :3, :3]).as_rotvec()
    document: dict[str, Any] = {
        "cameras": models,
        "shots": {
            name: {
                "camera": _camera_name(frames.format_of(f).width, frames.format_of(f).height),
                "rotation": rotations[f].tolist(),
                "translation": cameras_T_world[f, :3, 3].tolist(),
                "orientation": 1,
                **({"capture_time": float(frames.timestamps[f])} if frames.timed_frames[f] else {}),
            }
            for f, name in enumerate(shots)
        },
    }
    document["points"] = {
        str(j): {"coordinates": xyz, "color": color}
        for j, (xyz, color) in enumerate(
            zip(seen.points_world.tolist(), seen.point_colors.tolist(), strict=True)
        )
    }
    if placement.origin is not None and not placement.offset.any():
        keys = ("latitude", "longitude", "altitude")
        document["reference_lla"] = dict(zip(keys, placement.origin, strict=True))
        _write_json(partial / "reference_lla.json", document["reference_lla"])
    _write_json(partial / "reconstruction.json", [document])
    _write_json(partial / "camera_models.json", models)
    with (partial / "tracks.csv").open("w", encoding="utf-8") as file:
        file.write("OPENSFM_TRACKS_VERSION_v2\n")
        file.writelines(_tracks(seen, frames, shots))
    return panorama_writers(data, files)


def _camera_name(width: int, height: int) -> str:
    return f"v2 gsba panorama {width} {height} spherical 0"


def _tracks(reconstruction: Reconstruction, frames: FrameSet, names: list[str]) -> Iterator[str]:
    """Lines of tracks.csv, shot after shot."""
    observed = reconstruction.observations_by_frame()
    for f, (name, rows) in enumerate(zip(names, observed, strict=True)):
        points = reconstruction.observation_points[rows]
        kind = frames.format_of(f)
        pixels = erp_from_bearings(
            reconstruction.observation_bearings[rows], kind.width, kind.height
        )
        xy = (pixels - np.array([kind.width, kind.height]) / 2) / kind.width
        scales = reconstruction.observation_sigmas[rows] / (2 * np.pi)
        colors = reconstruction.point_colors[points]
        columns = zip(points.tolist(), xy.tolist(), scales.tolist(), colors.tolist(), strict=True)
        for feature, (point, (x, y), scale, (red, green, blue)) in enumerate(columns):
            yield (
                f"{name}\t{point}\t{feature}\t{x:.9g}\t{y:.9g}\t{scale:.6g}\t{red}\t{green}\t{blue}"
                "\t-1\t-1\n"
            )


def _write_json(path: Path, content: object) -> None:
    path.write_text(json.dumps(content) + "\n", encoding="utf-8")
