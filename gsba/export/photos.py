"""Localised photos in datasets, as cameras of their own beside the faces of panoramas: COLMAP's
`RADIAL`, or undistorted `PINHOLE`. They have poses but no observations of points, and are for
training, but for those that readers hold out by their order (`gsba.export.split`)."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsba.disk import disk_errors, write_image
from gsba.export.colmap import rigid, write_in_order
from gsba.export.dataset import Dataset, PhotoCamera, Photos, PlacedPhoto
from gsba.export.depths import map_path, write_map
from gsba.export.images import has_masks
from gsba.export.split import TRAIN_LIST, add_images
from gsba.frames.files import decode, goes_out_as_it_is, image_size
from gsba.geometry import CV_R_GL, inverse
from gsba.log import GsbaError
from gsba.store.records import RecordError, typed

LIST = "localized.json"  # of `gsba localize`, in its folder
_INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2")


def read_photos(folder: Path | None, run: Path, digest: str) -> Photos:
    """The photos that `gsba localize` found in a run's map.

    Args:
        folder: that `gsba localize` wrote; None = no photos.
        digest: of the map as it is now, see `gsba.store.finished.map_digest`.

    Raises:
        GsbaError: the folder holds no list of localised photos, or one of another run or map, or of
            the run before it changed; a photo is gone.
    """
    if folder is None:
        return Photos()
    path = folder / LIST
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        fields = ("width", "height", "focal", "principal", "radial")
        cameras = tuple(
            typed({name: entry[name] for name in fields}, PhotoCamera)
            for entry in content["cameras"]
        )
        photos = tuple(
            _photo(entry)
            for entry in content["pictures"]
            if entry["camera"] is not None and not entry["reason"]
        )
        own, known = Path(content["run"]), content["map"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecordError) as error:
        raise GsbaError(f"{path} is no list of gsba localize ({error}): localise again") from None
    if own.resolve() != run.resolve():
        raise GsbaError(f"{folder}: its photos are localised in {own}, not in {run}")
    if known != digest:
        raise GsbaError(
            f"{folder}: its photos are localised in another map of {run}, or before it changed: "
            "localise again"
        )
    if not photos:
        raise GsbaError(f"{folder} holds no localised photo")
    for photo in photos:
        if not photo.path.is_file():
            raise GsbaError(f"{photo.path}: this photo is gone; localise again")
        if not 0 <= photo.camera < len(cameras):
            raise GsbaError(f"{path}: photo '{photo.name}' has no camera; localise again")
    return Photos(photos, cameras)


def _photo(entry: dict[str, Any]) -> PlacedPhoto:
    pose = np.array(entry["world_T_picture"], np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError("a pose is damaged")
    name, camera = typed(entry["name"], str), typed(entry["camera"], int)
    return PlacedPhoto(name, Path(typed(entry["file"], str)), pose, camera)


def add_photos(data: Dataset) -> None:
    """Add its photos to a dataset whose faces are written, of pinhole cameras if its reader knows
    no others. Where frames have masks, photos get some that hide nothing. Raises GsbaError: two
    photos would have one name, or one cannot be read."""
    partial, to, photos, options = data.folder, data.to, data.options.photos, data.options
    undistort = bool(options.cameras) and "RADIAL" not in options.cameras
    masked = has_masks(data.frames) and not options.masks.path
    poses = data.placement.similarity.poses(
        np.array([photo.world_T_camera for photo in photos.photos])
    )
    pattern = "images/photos/{}{}" if to == "colmap" else "images/photo_{}{}"
    suffixes = [{".png": ".png"}.get(p.path.suffix.lower(), ".jpg") for p in photos.photos]
    names = [pattern.format(p.name, end) for p, end in zip(photos.photos, suffixes, strict=True)]
    for n, name in enumerate(names):
        if name in names[:n]:
            first, second = (photos.photos[k].path for k in (names.index(name), n))
            raise GsbaError(
                f"{first} and {second} would both be {name}: rename one, localise again"
            )
    if to == "nerfstudio":
        _write_photos(partial, photos, names, undistort=False)
        masks = _write_masks(partial, photos, names) if masked else ()
        _add_to_nerfstudio(partial / "transforms.json", photos, poses, names, masks)
        return
    import pycolmap

    model = pycolmap.Reconstruction(str(partial / "sparse" / "0"))
    last = max(model.images, default=0)
    numbers = list(range(last, last + len(names)))
    if (partial / TRAIN_LIST).is_file():
        taken = [number - 1 for number in model.images]
        numbered = add_images(partial, taken, [name.removeprefix("images/") for name in names])
        names, numbers = [f"images/{name}" for name in numbered], list(numbered.values())
    _write_photos(partial, photos, names, undistort)
    if masked and to == "colmap-flat":
        _write_masks(partial, photos, names)
    first = max(model.cameras, default=0) + 1
    for c, camera in enumerate(photos.cameras):
        kind, params = "RADIAL", (camera.focal, *camera.principal, *camera.radial)
        if undistort:
            matrix = _pinhole(camera)
            principal = matrix[:2, 2] + 0.5
            kind, params = "PINHOLE", (matrix[0, 0], matrix[1, 1], *principal)
        size = {"width": camera.width, "height": camera.height}
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(model=kind, params=params, camera_id=first + c, **size)
        )
    for photo, pose, name, number in zip(photos.photos, poses, names, numbers, strict=True):
        image = pycolmap.Image(
            name=name.removeprefix("images/"), camera_id=first + photo.camera, image_id=number + 1
        )
        model.add_image_with_trivial_frame(image, rigid(inverse(pose)))
    write_in_order(model, partial / "sparse" / "0")


def _write_photos(partial: Path, photos: Photos, names: Sequence[str], undistort: bool) -> None:
    """Write the photos to paths in the dataset, upright and in eight bits."""
    import cv2

    for photo, name in zip(photos.photos, names, strict=True):
        target, camera = partial / name, photos.cameras[photo.camera]
        with disk_errors(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            if undistort:
                image = decode(photo.path, image_size(photo.path))
                pinhole = _pinhole(camera)
                image = cv2.undistort(image, *_opencv(camera), newCameraMatrix=pinhole)
                write_image(target, image)
            elif goes_out_as_it_is(photo.path, target):
                shutil.copyfile(photo.path, target)
            else:
                write_image(target, decode(photo.path, image_size(photo.path)))


def _write_masks(partial: Path, photos: Photos, names: Sequence[str]) -> list[str]:
    """Write masks that hide nothing; returns their paths in the dataset."""
    masks = [name.replace("images/", "masks/", 1).rpartition(".")[0] + ".png" for name in names]
    for photo, mask in zip(photos.photos, masks, strict=True):
        camera = photos.cameras[photo.camera]
        write_image(partial / mask, np.full((camera.height, camera.width), 255, np.uint8))
    return masks


def _opencv(camera: PhotoCamera) -> tuple[np.ndarray, np.ndarray]:
    """Matrix (3, 3) and distortion (4,) in OpenCV, where centres of pixels are integers."""
    cx, cy = np.array(camera.principal) - 0.5
    matrix = np.array([[camera.focal, 0, cx], [0, camera.focal, cy], [0, 0, 1]])
    return matrix, np.array([*camera.radial, 0.0, 0.0])


def _pinhole(camera: PhotoCamera) -> np.ndarray:
    """Matrix (3, 3) in OpenCV of the pinhole camera whose pixels all lie within the photo."""
    import cv2

    size = camera.width, camera.height
    return cv2.getOptimalNewCameraMatrix(*_opencv(camera), size, alpha=0)[0]


def _add_to_nerfstudio(
    path: Path, photos: Photos, poses: np.ndarray, names: Sequence[str], masks: Sequence[str]
) -> None:
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
            empty = np.zeros((camera.height, camera.width), np.float32)
            write_map(path.parent / map_path(name), empty)
    for entry, mask in zip(frames[len(frames) - len(masks) :], masks, strict=True):
        entry["mask_path"] = mask
    document["train_filenames"] = [*document["train_filenames"], *names]
    path.write_text(json.dumps(document | {"frames": frames}, indent=1) + "\n", encoding="utf-8")
