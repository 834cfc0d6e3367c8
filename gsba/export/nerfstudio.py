"""nerfstudio datasets: pinhole faces in transforms.json, panoramas in transforms_erp.json.

nerfstudio's cameras have OpenGL axes (y up, z backward) and its world has z up, so the world
is turned by NERFSTUDIO_R_WORLD, which `applied_transform` states and the cloud shares. Base names
are unique, because nerfstudio looks for down-scaled images by base name. Every eighth panorama is
held out with all its faces: a face left in for training would give its siblings away. Splat
trainers need the faces; the panoramas are for models that take equirectangular rays:
`ns-train nerfacto --data OUT/transforms_erp.json`.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from gsba.camera.rig import RIG_R_FACE
from gsba.export.images import face_size_for, has_masks, suffix_of, write_faces, write_panoramas
from gsba.export.ply import write_splat_points
from gsba.types import FACES, FrameSet, Reconstruction

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
) -> None:
    """Write faces, cloud and transforms.json into `partial`; for panoramas the ERP variant too.

    A world whose z points up already is not turned.
    """
    out_R_world = np.eye(3) if z_up else NERFSTUDIO_R_WORLD
    points = reconstruction.points_world @ out_R_world.T
    write_splat_points(partial / _CLOUD, points, reconstruction.point_colors)
    size = face_size_for(frames, face_size)
    _write_face_dataset(partial, reconstruction, frames, size, out_R_world, link)
    if frames.panoramic:
        _write_erp_dataset(partial, reconstruction, frames, out_R_world, link)


def _write_face_dataset(
    partial: Path,
    reconstruction: Reconstruction,
    frames: FrameSet,
    size: int,
    out_R_world: np.ndarray,
    link: bool,
) -> None:
    def image(f: int, face: str) -> str:
        return f"images/{frames.names[f]}_{face}{suffix_of(frames, f)}"

    def mask(f: int, face: str) -> str:
        return f"masks/{frames.names[f]}_{face}.png"

    half = size / 2
    # OPENCV without distortion is a pinhole, under the one name that all readers know.
    camera = {"camera_model": "OPENCV", "fl_x": half, "fl_y": half, "cx": half, "cy": half}
    camera |= {"w": size, "h": size, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    entries = []
    for f, world_T_rig in enumerate(reconstruction.world_T_rigs):
        for face in frames.faces or FACES:
            entry = _entry(image(f, face), out_R_world, world_T_rig, RIG_R_FACE[FACES.index(face)])
            if has_masks(frames):
                entry["mask_path"] = mask(f, face)
            entries.append(entry)
    _write_transforms(partial / "transforms.json", camera, entries, len(frames), out_R_world)
    write_faces(
        frames,
        size,
        lambda f, face: partial / image(f, face),
        lambda f, face: partial / mask(f, face),
        link,
    )


def _write_erp_dataset(
    partial: Path,
    reconstruction: Reconstruction,
    frames: FrameSet,
    out_R_world: np.ndarray,
    link: bool,
) -> None:
    def image(f: int) -> str:
        return f"images_erp/{frames.names[f]}{frames.paths[f][0].suffix}"

    def mask(f: int) -> str:
        return f"masks_erp/{frames.names[f]}.png"

    width, height = frames.width, frames.height
    camera = {"camera_model": "EQUIRECTANGULAR", "fl_x": width / 2, "fl_y": float(height)}
    camera |= {"cx": width / 2, "cy": height / 2, "w": width, "h": height}
    entries = []
    for f, world_T_rig in enumerate(reconstruction.world_T_rigs):
        entry = _entry(image(f), out_R_world, world_T_rig, np.eye(3))
        if has_masks(frames):
            entry["mask_path"] = mask(f)
        entries.append(entry)
    _write_transforms(partial / "transforms_erp.json", camera, entries, len(entries), out_R_world)
    write_panoramas(frames, lambda f: partial / image(f), lambda f: partial / mask(f), link)


def _entry(
    file_path: str, out_R_world: np.ndarray, world_T_rig: np.ndarray, rig_R_camera: np.ndarray
) -> dict[str, Any]:
    """A frame of transforms.json; its matrix maps OpenGL camera axes to nerfstudio's world."""
    matrix = np.eye(4)
    matrix[:3, :3] = out_R_world @ world_T_rig[:3, :3] @ rig_R_camera @ _CV_R_GL
    matrix[:3, 3] = out_R_world @ world_T_rig[:3, 3]
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
