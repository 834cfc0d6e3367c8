"""nerfstudio datasets: pinhole faces in transforms.json and panoramas in transforms_erp.json (for
models of equirectangular rays); or, by `export.images`, panoramas or raw fisheyes alone.

nerfstudio's cameras have OpenGL axes and its world has z up: world and cloud are rotated by
NERFSTUDIO_R_WORLD, which `applied_transform` states. Base names are unique, as nerfstudio looks for
down-scaled images by them. It applies top-level intrinsics to all frames: those that differ are in
each frame's entry.

Raw fisheyes are OPENCV_FISHEYE with masks. With a known motion during the readout, a frame has
`transform_matrix_start` and `_end`, poses of the top and the bottom edge in the format of
instant-ngp, and `rolling_shutter` is [0, 0, 1, 0]; that is gsplat's ROLLING_TOP_TO_BOTTOM with the
inverses as `viewmats` and `viewmats_rs`, and k1 to k4 as `radial_coeffs`. instant-ngp reads
`is_fisheye` and k1 to k4 in each frame's entry, and the size of its box from `aabb_scale`; of a
folder it loads all JSON files with frames, panoramas as pinholes.
"""

import json
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from gsba.camera.fisheye import lens_names, rotation_of
from gsba.camera.views import View, seen_from_lenses
from gsba.export import motion
from gsba.export.dataset import Dataset
from gsba.export.depths import map_path, write_depths
from gsba.export.images import has_masks, panorama_writers, view_writers, views_of_cameras
from gsba.export.names import base_names, padded_names
from gsba.export.pictures import Files, FrameWriter
from gsba.export.ply import write_splat_points
from gsba.export.raw import RawPictures, raw_lenses
from gsba.export.split import held_out_frames
from gsba.geometry import CV_R_GL, pose
from gsba.types import Fisheye, FrameSet, Reconstruction

NERFSTUDIO_R_WORLD = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
_CLOUD = "points3D.ply"


def write_nerfstudio(data: Dataset) -> list[list[FrameWriter]]:
    """Write cloud and transforms.json of raw fisheyes, of panoramas, or of faces and beside these
    transforms_erp.json of panoramas, without images; returns their writers."""
    out_R_world = z_up_R_world(data.placement.up)
    points = data.reconstruction.points_world @ out_R_world.T
    write_splat_points(data.folder / _CLOUD, points, data.reconstruction.point_colors)
    if data.images == "fisheye":
        return [_write_raw(data, out_R_world)]
    if data.images == "panorama":
        return [_write_panoramas(data, out_R_world, "")]
    writers = [_write_faces(data, out_R_world)]
    if data.options.panoramas and all(kind.panoramic for kind in data.frames.formats):
        writers.append(_write_panoramas(data, out_R_world, "_erp"))
    return writers


def _write_raw(data: Dataset, out_R_world: np.ndarray) -> list[FrameWriter]:
    frames, cameras, shutter = data.frames, data.cameras, data.options.shutter
    rigs = [raw_lenses(kind) for kind in frames.formats]
    moving = [  # (C,) True where the motion during the readout is known
        lenses.readout_motion is not None and lenses.row_directions is not None
        for lenses in cameras.lenses
    ]
    files = [_files(data, lens_names(len(rig)), True) for rig in rigs]
    velocities = motion.rig_velocities(data.reconstruction, frames, cameras, shutter)
    entries = list[list[dict[str, Any]]]()
    for f, (world_T_rig, c) in enumerate(_posed(data.reconstruction, frames)):
        images, masks = files[c].images(frames, f), _mask_paths(files[c], frames, f)
        lenses = cameras.lenses[c]
        swept = lenses.swept(f) if moving[c] else None
        ways = lenses.rows_down() if moving[c] else (1.0,) * len(rigs[c])
        entries.append([])
        for number, (lens, centre) in enumerate(zip(rigs[c], lenses.centres, strict=True)):
            rig_T_lens = pose(rotation_of(lens), centre)
            entry = _entry(images[number], out_R_world, world_T_rig @ rig_T_lens)
            if swept is not None:
                for name, rig_T_rig in zip(("start", "end"), swept[number], strict=True):
                    matrix = _matrix(out_R_world, world_T_rig @ rig_T_rig @ rig_T_lens)
                    entry[f"transform_matrix_{name}"] = matrix
            if velocities is not None:  # rows are read from the top, at these velocities
                entry |= motion.velocity_keys(ways[number] * velocities[f], rig_T_lens)
            radial = dict(zip(("k1", "k2", "k3", "k4"), lens.radial, strict=True))
            entry |= {**_intrinsics(lens), **radial, "is_fisheye": True}
            if masks:
                entry["mask_path"] = masks[number]
            entries[-1].append(entry)
    camera: dict[str, Any] = {"camera_model": "OPENCV_FISHEYE", "is_fisheye": True}
    if any(moving):
        camera["rolling_shutter"] = [0, 0, 1, 0]
    if velocities is not None:
        camera |= motion.shutter_keys(shutter, rolling=any(moving))
    _write_transforms(data, "transforms.json", camera, entries, out_R_world)
    return [RawPictures(one, data.options.link) for one in files]


def z_up_R_world(up: str | None) -> np.ndarray:
    """Rotation (3, 3) of a world to one whose z points up, taken for y down if unknown."""
    return {"z": np.eye(3), "y": NERFSTUDIO_R_WORLD.T}.get(up or "-y", NERFSTUDIO_R_WORLD)


def _posed(reconstruction: Reconstruction, frames: FrameSet) -> Iterator[tuple[np.ndarray, int]]:
    """Pose (4, 4) and camera of each frame."""
    return zip(reconstruction.world_T_rigs, frames.cameras.tolist(), strict=True)


def _write_faces(data: Dataset, out_R_world: np.ndarray) -> list[FrameWriter]:
    frames, cameras, options = data.frames, data.cameras, data.options
    views = views_of_cameras(frames, options.face_size, cameras)
    masked = has_masks(frames)
    files = [_files(data, [view.name for view in own], masked) for own in views]
    seen = seen_from_lenses(data.reconstruction, cameras)
    if options.depths:
        write_depths(data, seen, files, views, maps=True)
    # OPENCV without distortion is a pinhole, by the only name that all readers know.
    camera = {"camera_model": "OPENCV", "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    alike = len({view.intrinsics for own in views for view in own}) == 1
    if alike:
        camera |= _intrinsics(views[0][0])
    velocities = motion.rig_velocities(seen, frames, cameras, options.shutter)
    if velocities is not None:
        camera |= motion.shutter_keys(options.shutter, rolling=False)
    entries = list[list[dict[str, Any]]]()
    for f, (world_T_rig, c) in enumerate(_posed(seen, frames)):
        images, hidden = files[c].images(frames, f), _mask_paths(files[c], frames, f)
        entries.append([])
        for number, view in enumerate(views[c]):
            entry = _entry(images[number], out_R_world, world_T_rig @ view.rig_T_view)
            if not alike:
                entry |= _intrinsics(view)
            if hidden:
                entry["mask_path"] = hidden[number]
            if options.depths:
                entry["depth_file_path"] = map_path(images[number])
            if velocities is not None:
                entry |= motion.velocity_keys(velocities[f], view.rig_T_view)
            entries[-1].append(entry)
    _write_transforms(data, "transforms.json", camera, entries, out_R_world)
    return view_writers(data, files, views)


def _write_panoramas(data: Dataset, out_R_world: np.ndarray, which: str) -> list[FrameWriter]:
    frames = data.frames
    mask = f"masks{which}/{{name}}.png" if has_masks(frames) else ""
    names, pattern = base_names(padded_names(frames.names)), f"images{which}/{{name}}{{suffix}}"
    files = Files(data.folder, ("",), pattern, mask, data.options.masks, names)
    shapes = [
        {"fl_x": kind.width / 2, "fl_y": float(kind.height), "cx": kind.width / 2}
        | {"cy": kind.height / 2, "w": kind.width, "h": kind.height}
        for kind in frames.formats
    ]
    camera: dict[str, Any] = {"camera_model": "EQUIRECTANGULAR"}
    camera |= shapes[0] if len(shapes) == 1 else {}
    entries = list[list[dict[str, Any]]]()
    for f, (world_T_rig, c) in enumerate(_posed(data.reconstruction, frames)):
        (image,), hidden = files.images(frames, f), _mask_paths(files, frames, f)
        entry = _entry(image, out_R_world, world_T_rig)
        if len(shapes) > 1:
            entry |= shapes[c]
        if hidden:
            entry["mask_path"] = hidden[0]
        entries.append([entry])
    _write_transforms(data, f"transforms{which}.json", camera, entries, out_R_world)
    return panorama_writers(data, files)


def _files(data: Dataset, views: Sequence[str], masked: bool) -> Files:
    """Files of images and masks with unique base names."""
    mask, pattern = "masks/{name}_{view}.png" if masked else "", "images/{name}_{view}{suffix}"
    names = base_names(padded_names(data.frames.names))
    return Files(data.folder, views, pattern, mask, data.options.masks, names)


def _mask_paths(files: Files, frames: FrameSet, f: int) -> list[str]:
    """Paths of a frame's masks; [] = there are none with 0 for pixels to ignore."""
    return files.masks(frames, f) if files.style.hidden == 0 else []


def _intrinsics(camera: View | Fisheye) -> dict[str, Any]:
    cx, cy = camera.principal
    lengths = {"fl_x": camera.focal, "fl_y": camera.focal, "cx": cx, "cy": cy}
    return {**lengths, "w": camera.width, "h": camera.height}


def _entry(file_path: str, out_R_world: np.ndarray, world_T_camera: np.ndarray) -> dict[str, Any]:
    """Entry of a frame in transforms.json."""
    return {"file_path": file_path, "transform_matrix": _matrix(out_R_world, world_T_camera)}


def _matrix(out_R_world: np.ndarray, world_T_camera: np.ndarray) -> list[list[float]]:
    """Pose (4, 4) of a camera with OpenGL axes in nerfstudio's world."""
    matrix = np.eye(4)
    matrix[:3, :3] = out_R_world @ world_T_camera[:3, :3] @ CV_R_GL
    matrix[:3, 3] = out_R_world @ world_T_camera[:3, 3]
    return matrix.tolist()


def _write_transforms(
    data: Dataset,
    name: str,
    camera: dict[str, Any],
    entries: Sequence[Sequence[dict[str, Any]]],
    out_R_world: np.ndarray,
) -> None:
    """Write transforms.json with each frame's (F) entries; unsplit, all are for training, too."""
    held_out = held_out_frames(data.reconstruction)
    names = [[str(entry["file_path"]) for entry in of_frame] for of_frame in entries]
    evaluated = [n for held, own in zip(held_out, names, strict=True) if held for n in own]
    apart = held_out & data.split
    trained = [n for held, own in zip(apart, names, strict=True) if not held for n in own]
    every = [entry["transform_matrix"] for of_frame in entries for entry in of_frame]
    applied = np.column_stack([out_R_world, np.zeros(3)])
    # Half the side of the box; a unit of this world is 0.33 of instant-ngp's unit cube
    half = 0.33 * np.abs(np.array(every)[:, :3, 3]).max(initial=0.0)
    document = {
        **camera,
        "applied_transform": applied.tolist(),
        "aabb_scale": int(min(2.0 ** np.ceil(np.log2(max(2 * half, 1.0))), 128)),
        "ply_file_path": _CLOUD,
        "train_filenames": trained,
        "val_filenames": evaluated,
        "test_filenames": evaluated,
        "frames": [entry for of_frame in entries for entry in of_frame],
    }
    (data.folder / name).write_text(json.dumps(document, indent=1) + "\n")
