"""Localised photos in datasets, as cameras of their own beside the faces of panoramas.

COLMAP's `RADIAL` camera is the one of photos: focal length, principal point, two radial terms.
Photos are `images/photos/NAME`, in flat layouts and nerfstudio's `images/photo_NAME`; they have
poses but no observations of points. All are for training: none is held out.
"""

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsba.disk import disk_errors, write_image
from gsba.export.depths import map_path, write_empty_map
from gsba.frames.files import decode, goes_out_as_it_is, image_size
from gsba.geometry import CV_R_GL, inverse
from gsba.log import GsbaError
from gsba.placement.placement import Placement
from gsba.store.records import RecordError, typed

LIST = "localized.json"  # of `gsba localize`, in its folder
FITTING = ("colmap", "colmap-flat", "nerfstudio")  # formats of faces, that hold photos and depths
_INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2")


@dataclass(frozen=True, slots=True)
class PhotoCamera:
    """A camera that photos share: r = focal (t + k1 t^3 + k2 t^5), t = tan of the angle."""

    width: int  # pixels
    height: int  # pixels
    focal: float  # pixels
    principal: tuple[float, float]  # pixels, corner origin
    radial: tuple[float, float]  # k1, k2


@dataclass(frozen=True, slots=True)
class PlacedPhoto:
    """A photo with a pose in the run's world."""

    name: str
    path: Path
    world_T_camera: np.ndarray  # (4, 4) float64, x right, y down, z forward
    camera: int  # number of its camera


@dataclass(frozen=True, slots=True)
class Photos:
    """Photos of a run's place, and their cameras."""

    photos: tuple[PlacedPhoto, ...] = ()
    cameras: tuple[PhotoCamera, ...] = ()


def read_photos(folder: Path | None, run: Path) -> Photos:
    """The photos that `gsba localize` found in a run.

    Args:
        folder: that `gsba localize` wrote; None = no photos.
        run: folder of the run.

    Raises:
        GsbaError: the folder holds no list of localised photos, or one of another run; a photo is
            gone.
    """
    if folder is None:
        return Photos()
    path = folder / LIST
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        cameras = tuple(_camera(entry) for entry in content["cameras"])
        photos = tuple(
            _photo(entry)
            for entry in content["pictures"]
            if entry["camera"] is not None and not entry["reason"]
        )
        own = Path(content["run"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecordError) as error:
        raise GsbaError(f"{path} is no list of gsba localize ({error}): localise again") from None
    if own.resolve() != run.resolve():
        raise GsbaError(f"{folder}: its photos are localised in {own}, not in {run}")
    if not photos:
        raise GsbaError(f"{folder} holds no localised photo")
    for photo in photos:
        if not photo.path.is_file():
            raise GsbaError(f"{photo.path}: this photo is gone; localise again")
        if not 0 <= photo.camera < len(cameras):
            raise GsbaError(f"{path}: photo '{photo.name}' has no camera; localise again")
    return Photos(photos, cameras)


def _camera(entry: dict[str, Any]) -> PhotoCamera:
    fields = ("width", "height", "focal", "principal", "radial")
    return typed({name: entry[name] for name in fields}, PhotoCamera)


def _photo(entry: dict[str, Any]) -> PlacedPhoto:
    pose = np.array(entry["world_T_picture"], np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError("a pose is damaged")
    name, camera = typed(entry["name"], str), typed(entry["camera"], int)
    return PlacedPhoto(name, Path(typed(entry["file"], str)), pose, camera)


def add_photos(partial: Path, to: str, photos: Photos, placement: Placement) -> None:
    """Add photos to a dataset that is being written.

    Args:
        partial: its folder, with the model of the faces.
        to: its format, one of FITTING.
        photos: in the run's world.
        placement: of the exported world.
    """
    move = placement.similarity
    poses = move.poses(np.array([photo.world_T_camera for photo in photos.photos]))
    if to == "nerfstudio":
        names = _copied(partial, photos.photos, "images/photo_{name}{suffix}")
        _add_to_nerfstudio(partial / "transforms.json", photos, poses, names)
        return
    flat = to == "colmap-flat"
    pattern = "images/photo_{name}{suffix}" if flat else "images/photos/{name}{suffix}"
    names = _copied(partial, photos.photos, pattern)
    shown = [name.removeprefix("images/") for name in names]
    _add_to_colmap(partial / "sparse" / "0", photos, poses, shown)


def _copied(partial: Path, photos: Sequence[PlacedPhoto], pattern: str) -> list[str]:
    """Write the photos, upright and in eight bits; their paths within the dataset."""
    names = []
    for photo in photos:
        suffix = ".png" if photo.path.suffix.lower() == ".png" else ".jpg"
        name = pattern.format(name=photo.name, suffix=suffix)
        target = partial / name
        with disk_errors(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            if goes_out_as_it_is(photo.path, target):
                shutil.copyfile(photo.path, target)
            else:
                write_image(target, decode(photo.path, image_size(photo.path)))
        names.append(name)
    return names


def _add_to_colmap(folder: Path, photos: Photos, poses: np.ndarray, names: Sequence[str]) -> None:
    import pycolmap

    model = pycolmap.Reconstruction(str(folder))
    first = max(model.cameras, default=0) + 1
    for c, camera in enumerate(photos.cameras):
        params = (camera.focal, *camera.principal, *camera.radial)
        size = {"width": camera.width, "height": camera.height}
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(model="RADIAL", params=params, camera_id=first + c, **size)
        )
    number = max(model.images, default=0) + 1
    for n, (photo, pose, name) in enumerate(zip(photos.photos, poses, names, strict=True)):
        camera_T_world = inverse(pose)
        rotation = pycolmap.Rotation3d(camera_T_world[:3, :3])
        image = pycolmap.Image(name=name, camera_id=first + photo.camera, image_id=number + n)
        rigid = pycolmap.Rigid3d(rotation, camera_T_world[:3, 3])
        model.add_image_with_trivial_frame(image, rigid)
    model.write_binary(str(folder))


def _add_to_nerfstudio(path: Path, photos: Photos, poses: np.ndarray, names: Sequence[str]) -> None:
    document = json.loads(path.read_text(encoding="utf-8"))
    with_depths = any("depth_file_path" in entry for entry in document["frames"])
    # Readers apply intrinsics above the frames to all frames: each gets its own.
    common = {key: document.pop(key) for key in _INTRINSICS if key in document}
    frames = [common | entry for entry in document["frames"]]
    world = np.eye(4)
    world[:3] = document["applied_transform"]
    for photo, pose, name in zip(photos.photos, poses, names, strict=True):
        camera = photos.cameras[photo.camera]
        (cx, cy), (k1, k2) = camera.principal, camera.radial
        matrix = world @ pose
        matrix[:3, :3] = matrix[:3, :3] @ CV_R_GL
        frames.append(
            {
                "file_path": name,
                "transform_matrix": matrix.tolist(),
                **{"fl_x": camera.focal, "fl_y": camera.focal, "cx": cx, "cy": cy},
                **{"w": camera.width, "h": camera.height},
                **{"k1": k1, "k2": k2, "p1": 0.0, "p2": 0.0},
            }
        )
        if with_depths:  # readers want them of all images or of none
            frames[-1]["depth_file_path"] = map_path(name)
            write_empty_map(path.parent / map_path(name), camera.width, camera.height)
    document["train_filenames"] = [*document["train_filenames"], *names]
    path.write_text(json.dumps(document | {"frames": frames}, indent=1) + "\n", encoding="utf-8")
