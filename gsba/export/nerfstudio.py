"""nerfstudio datasets: pinhole faces in transforms.json, panoramas in transforms_erp.json.

nerfstudio's cameras have OpenGL axes (y up, z backward) and its world has z up, so the world
is turned by NERFSTUDIO_R_WORLD, which `applied_transform` states and the cloud shares. Base names
are unique, because nerfstudio looks for down-scaled images by base name. Every eighth panorama is
held out with all its faces: a face left in for training would give its siblings away. Splat
trainers need the faces; the panoramas are for models that take equirectangular rays:
`ns-train nerfacto --data OUT/transforms_erp.json`.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gsba.camera.lens import ONE_CENTRE, Lenses
from gsba.camera.views import View, scenes_of, seen_from_lenses, views_for
from gsba.export.images import face_size_for, has_masks, suffix_of, write_panoramas, write_views
from gsba.export.ply import write_splat_points
from gsba.types import FrameSet, Reconstruction

NERFSTUDIO_R_WORLD = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
_CV_R_GL = np.diag([1.0, -1, -1])  # OpenGL camera axes in our camera axes
_CLOUD = "points3D.ply"
_HOLD_OUT_EVERY = 8  # panoramas, as in the benchmarks of splat trainers


def write_nerfstudio(
    partial: Path,
    reconstruction: Reconstruction,
    frames: FrameSet,
    face_size: int | None,
    z_up: bool = False,
    link: bool = False,
    lenses: Lenses = ONE_CENTRE,
) -> None:
    """Write faces, cloud and transforms.json into `partial`; for panoramas the ERP variant too.

    A world whose z points up already is not turned.
    """
    out_R_world = np.eye(3) if z_up else NERFSTUDIO_R_WORLD
    points = reconstruction.points_world @ out_R_world.T
    write_splat_points(partial / _CLOUD, points, reconstruction.point_colors)
    views = views_for(frames, face_size_for(frames, face_size), lenses)
    seen = seen_from_lenses(reconstruction, lenses)
    scenes = scenes_of(reconstruction)
    _write_face_dataset(partial, seen, frames, views, out_R_world, link, lenses, scenes)
    if frames.panoramic:
        _write_erp_dataset(partial, reconstruction, frames, out_R_world, link)


def _write_face_dataset(
    partial: Path,
    reconstruction: Reconstruction,
    frames: FrameSet,
    views: tuple[View, ...],
    out_R_world: np.ndarray,
    link: bool,
    lenses: Lenses,
    scenes: Callable[[int], np.ndarray],
) -> None:
    def image(f: int, face: str) -> str:
        return f"images/{frames.names[f]}_{face}{suffix_of(frames, f)}"

    def mask(f: int, face: str) -> str:
        return f"masks/{frames.names[f]}_{face}.png"

    # OPENCV without distortion is a pinhole, under the one name that all readers know.
    camera = {"camera_model": "OPENCV", **_intrinsics(views[0])}
    camera |= {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    entries = []
    for f, world_T_rig in enumerate(reconstruction.world_T_rigs):
        for view in views:
            world_T_view = world_T_rig @ view.rig_T_view
            entry = _entry(image(f, view.name), out_R_world, world_T_view)
            if lenses:  # views differ
                entry |= _intrinsics(view)
            if has_masks(frames):
                entry["mask_path"] = mask(f, view.name)
            entries.append(entry)
    _write_transforms(partial / "transforms.json", camera, entries, len(frames), out_R_world)
    write_views(
        frames,
        views,
        lenses,
        lambda f, face: partial / image(f, face),
        lambda f, face: partial / mask(f, face),
        link,
        scenes,
    )


def _write_erp_dataset(
    partial: Path,
    reconstruction: Reconstruction,
    frames: FrameSet,
    out_R_world: np.ndarray,
    link: bool,
) -> None:
    def image(f: int) -> str:
        return f"images_erp/{frames.names[f]}{suffix_of(frames, f)}"

    def mask(f: int) -> str:
        return f"masks_erp/{frames.names[f]}.png"

    width, height = frames.width, frames.height
    camera = {"camera_model": "EQUIRECTANGULAR", "fl_x": width / 2, "fl_y": float(height)}
    camera |= {"cx": width / 2, "cy": height / 2, "w": width, "h": height}
    entries = []
    for f, world_T_rig in enumerate(reconstruction.world_T_rigs):
        entry = _entry(image(f), out_R_world, world_T_rig)
        if has_masks(frames):
            entry["mask_path"] = mask(f)
        entries.append(entry)
    _write_transforms(partial / "transforms_erp.json", camera, entries, len(entries), out_R_world)
    write_panoramas(frames, lambda f: partial / image(f), lambda f: partial / mask(f), link)


def _intrinsics(view: View) -> dict[str, Any]:
    cx, cy = view.principal
    lengths = {"fl_x": view.focal, "fl_y": view.focal, "cx": cx, "cy": cy}
    return {**lengths, "w": view.width, "h": view.height}


def _entry(file_path: str, out_R_world: np.ndarray, world_T_camera: np.ndarray) -> dict[str, Any]:
    """A frame of transforms.json; its matrix maps OpenGL camera axes to nerfstudio's world."""
    matrix = np.eye(4)
    matrix[:3, :3] = out_R_world @ world_T_camera[:3, :3] @ _CV_R_GL
    matrix[:3, 3] = out_R_world @ world_T_camera[:3, 3]
    return {"file_path": file_path, "transform_matrix": matrix.tolist()}


def _write_transforms(
    path: Path,
    camera: dict[str, Any],
    entries: list[dict[str, Any]],
    num_frames: int,
    out_R_world: np.ndarray,
) -> None:
    names = [str(entry["file_path"]) for entry in entries]  # frame by frame
    per_frame = len(names) // num_frames
    evaluated = [n for i, n in enumerate(names) if i // per_frame % _HOLD_OUT_EVERY == 0]
    trained = [n for i, n in enumerate(names) if i // per_frame % _HOLD_OUT_EVERY != 0]
    applied = np.column_stack([out_R_world, np.zeros(3)])
    document = {
        **camera,
        "applied_transform": applied.tolist(),
        "ply_file_path": _CLOUD,
        "train_filenames": trained,
        "val_filenames": evaluated,
        "test_filenames": evaluated,
        "frames": entries,
    }
    path.write_text(json.dumps(document, indent=1) + "\n")
