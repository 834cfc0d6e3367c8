"""COLMAP models (4.x) with rigs and frames; images.bin also serves readers without these.

* `colmap`: PINHOLE faces in one rig, `images/front/NAME.jpg`, `masks/front/NAME.jpg.png`,
  `sparse/0`, and `rig_config.json` for COLMAP's own tools.
* `colmap-flat`: `images/00012_NAME_front.jpg` in the order of `gsba.export.split`, for trainers
  that resolve images by their base name. `sparse/0/points3D.ply` is INRIA's start cloud.
* raw fisheyes (`--images fisheye`): two OPENCV_FISHEYE cameras; masks leave out pixels beyond the
  image circles; the rolling shutter is not corrected.
* `colmap-erp`: one EQUIRECTANGULAR camera and the panoramas, of two lenses stitched for the middle.

A pose is rig_from_world, where COLMAP's rig frame is that of the first camera. Point j + 1 is point
j. Frames of several cameras have a rig for each of these.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsba.camera.fisheye import lens_names
from gsba.camera.one_centre import seen_from_the_middle
from gsba.camera.views import View, seen_from_lenses, shown_in_pictures
from gsba.export.dataset import Dataset, ExportFormat
from gsba.export.depths import write_depths
from gsba.export.images import has_masks, panorama_writers, view_writers, views_of_cameras
from gsba.export.names import base_names, padded_names
from gsba.export.pictures import Files, FrameWriter
from gsba.export.ply import write_cloud
from gsba.export.raw import RawPictures
from gsba.export.sensors import RigSensor, pinholes, project_in_rigs, raw_sensors
from gsba.export.split import split_of
from gsba.geometry import inverse, quaternion_from_rotation
from gsba.log import GsbaError
from gsba.types import FrameSet, Reconstruction

_BY_VIEW, _FLAT = "{view}/{name}{suffix}", "{name}_{view}{suffix}"  # names of images
_FLAT_MASK = "{name}_{view}.png"  # others keep the image's suffix before .png, as COLMAP does


def write_colmap(data: Dataset) -> list[FrameWriter]:
    """Write faces or raw fisheyes in the rig layout or the flat one, without images; returns their
    writer."""
    frames, cameras, folder = data.frames, data.cameras, data.folder
    raw, flat = data.images == "fisheye", data.to == ExportFormat.COLMAP_FLAT
    views: list[tuple[View, ...]] = []
    if raw:
        own = zip(frames.formats, cameras.lenses, strict=True)
        rigs = [raw_sensors(kind, lenses) for kind, lenses in own]
        names = [lens_names(len(sensors)) for sensors in rigs]
        seen = shown_in_pictures(data.reconstruction, cameras)
    else:
        views = views_of_cameras(frames, data.options.face_size, cameras)
        rigs = pinholes(views)
        names = [[view.name for view in own] for own in views]
        seen = seen_from_lenses(data.reconstruction, cameras)
    masked = raw or has_masks(frames)
    files = [_files(data, _FLAT if flat else _BY_VIEW, own, masked) for own in names]
    if flat:
        num_views = [len(rigs[rig]) for rig in frames.cameras.tolist()]
        num_photos = len(data.options.photos.photos)
        split = split_of(seen, num_views, num_photos) if data.split else None
        if split is not None:
            files = [split.files(own, frames) for own in files]
        in_model, model = _names(files, frames), folder / "sparse" / "0"
        order = None if split is None else split.numbers
        write_model(model, seen, rigs, in_model, frames.cameras, order)
        write_cloud(model / "points3D.ply", seen)  # INRIA's
        if split is not None:
            split.write_lists(folder, in_model)
    else:
        write_model(folder / "sparse" / "0", seen, rigs, _names(files, frames), frames.cameras)
        if len(rigs) == 1:
            configs = [_rig_config(rigs[0], files[0].views, "")]
        else:
            numbers = {
                name: int(frames.cameras[rows[0]]) for name, rows in frames.recordings.items()
            }
            configs = [
                _rig_config(rigs[number], files[number].views, f"{recording}/")
                for recording, number in numbers.items()
            ]
        (folder / "rig_config.json").write_text(json.dumps(configs, indent=1) + "\n")
    if data.options.depths:
        write_depths(data, seen, files, views)
    if raw:
        return [RawPictures(own, data.options.link) for own in files]
    return view_writers(data, files, views)


def write_colmap_erp(data: Dataset) -> list[FrameWriter]:
    """Write the equirectangular layout, without images; returns their writer. Raises GsbaError: the
    frames are cube faces."""
    frames, cameras = data.frames, data.cameras
    if not all(kind.panoramic for kind in frames.formats):
        raise GsbaError("colmap-erp needs panoramas, these frames are cube faces: use colmap")
    sizes = [(kind.width, kind.height) for kind in frames.formats]
    rigs = [
        [RigSensor("EQUIRECTANGULAR", *size, (float(size[0]), float(size[1])), np.eye(4))]
        for size in sizes
    ]
    files = _files(data, "{name}{suffix}", ("",), has_masks(frames))
    seen = seen_from_the_middle(data.reconstruction) if cameras else data.reconstruction
    names = _names([files] * len(rigs), frames)
    write_model(data.folder / "sparse" / "0", seen, rigs, names, frames.cameras)
    return panorama_writers(data, files)


def write_model(
    folder: Path,
    reconstruction: Reconstruction,
    rigs: Sequence[Sequence[RigSensor]],
    names: list[list[str]],
    rig_of_frame: np.ndarray,
    order: Sequence[Sequence[int]] | None = None,
) -> None:
    """Write rigs, cameras, frames, images and points3D in binary.

    Args:
        names: image names, by frame and sensor.
        rig_of_frame: (F,) int, rig of each frame.
        order: numbers of the images from 0, by frame and sensor, -1 = left out of the model; None =
            frame after frame.
    """
    import pycolmap

    model = pycolmap.Reconstruction()
    ids = _add_rigs(model, rigs)
    firsts = np.concatenate([[0], np.cumsum([len(own) for own in names])])  # (F + 1,) image of each
    # frame, frame after frame
    numbers = np.arange(firsts[-1]) if order is None else np.concatenate(list(map(list, order)))
    which, pixels = project_in_rigs(reconstruction, rigs, rig_of_frame)
    images = numbers[firsts[reconstruction.observation_frames] + np.maximum(which, 0)]
    images[which < 0] = -1
    by_image = np.argsort(images, kind="stable")
    starts = np.searchsorted(images[by_image], np.arange(max(numbers, default=-1) + 2))
    rows = np.empty(len(images), np.int64)  # row of each observation in its image
    rows[by_image] = np.arange(len(images)) - starts[np.maximum(images[by_image], 0)]

    rigs_T_world = inverse(reconstruction.world_T_rigs)
    for f, (of_frame, rig) in enumerate(zip(names, rig_of_frame.tolist(), strict=True)):
        frame = pycolmap.Frame(frame_id=f + 1, rig_id=rig + 1)
        rig_T_ref = rigs[rig][0].rig_T_sensor
        frame.rig_from_world = rigid(inverse(rig_T_ref) @ rigs_T_world[f])
        own = zip(ids[rig], of_frame, numbers[firsts[f] : firsts[f + 1]].tolist(), strict=True)
        kept = [(sensor_id, name, number) for sensor_id, name, number in own if number >= 0]
        for sensor_id, _, number in kept:
            frame.add_data_id(pycolmap.data_t(sensor_id, number + 1))
        model.add_frame(frame)
        for sensor_id, name, number in kept:
            seen = by_image[starts[number] : starts[number + 1]]
            image = pycolmap.Image(
                name=name, keypoints=pixels[seen], camera_id=sensor_id.id, image_id=number + 1
            )
            image.frame_id = f + 1
            model.add_image(image)
        model.register_frame(f + 1)
    _add_points(model, reconstruction, images, rows)
    write_in_order(model, folder)


def write_in_order(model, folder: Path) -> None:
    """Write a pycolmap model in binary, with images in the order of their numbers, as some readers
    count them: pycolmap writes frame after frame."""
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(str(folder))
    content = (folder / "images.bin").read_bytes()
    view, records, start = memoryview(content), list[memoryview](), 8
    while start < len(content):
        name_end = content.index(b"\0", start + 64)  # behind number, pose and camera
        num_points = int.from_bytes(view[name_end + 1 : name_end + 9], "little")
        end = name_end + 9 + 24 * num_points
        records.append(view[start:end])
        start = end
    records.sort(key=lambda record: int.from_bytes(record[:4], "little"))
    with (folder / "images.bin").open("wb") as file:
        file.write(view[:8])
        file.writelines(records)


def _add_rigs(model, rigs: Sequence[Sequence[RigSensor]]) -> list[list]:
    """Add all rigs and their cameras to the model; returns the sensor ids, by rig."""
    import pycolmap

    ids = list[list]()
    for number, sensors in enumerate(rigs):
        first = sum(map(len, ids)) + 1
        cameras = [
            pycolmap.Camera(
                model=sensor.model,
                width=sensor.width,
                height=sensor.height,
                params=sensor.params,
                camera_id=first + c,
            )
            for c, sensor in enumerate(sensors)
        ]
        for camera in cameras:
            model.add_camera(camera)
        ids.append([camera.sensor_id for camera in cameras])
        rig = pycolmap.Rig(rig_id=number + 1)
        rig.add_ref_sensor(ids[-1][0])
        rig_T_ref = sensors[0].rig_T_sensor
        for c in range(1, len(sensors)):
            rig.add_sensor(ids[-1][c], rigid(inverse(sensors[c].rig_T_sensor) @ rig_T_ref))
        model.add_rig(rig)
    return ids


def rigid(a_T_b: np.ndarray):
    """Pose (4, 4) as pycolmap has it."""
    import pycolmap

    return pycolmap.Rigid3d(pycolmap.Rotation3d(a_T_b[:3, :3]), a_T_b[:3, 3])


def _add_points(
    model, reconstruction: Reconstruction, images: np.ndarray, rows: np.ndarray
) -> None:
    """Add all points with their tracks; COLMAP computes their errors, mean pixels."""
    import pycolmap

    points = reconstruction.points_world
    ends = np.searchsorted(reconstruction.observation_points, np.arange(len(points) + 1))
    for j, (xyz, color) in enumerate(zip(points, reconstruction.point_colors, strict=True)):
        of_point = np.arange(ends[j], ends[j + 1])
        of_point = of_point[images[of_point] >= 0]
        image_ids, indices = (images[of_point] + 1).tolist(), rows[of_point].tolist()
        track = pycolmap.Track(list(map(pycolmap.TrackElement, image_ids, indices)))
        model.add_point3D_with_id(j + 1, pycolmap.Point3D(xyz=xyz, color=color, track=track))
    model.update_point_3d_errors()


def _rig_config(sensors: Sequence[RigSensor], names: Sequence[str], folder: str) -> dict:
    """Rig in the format of `colmap rig_configurator`; rotations are cam_from_rig, wxyz."""
    configs = []
    for sensor, name in zip(sensors, names, strict=True):
        config: dict[str, object] = {"image_prefix": f"{name}/{folder}"}
        if not configs:
            config["ref_sensor"] = True
        else:
            cam_T_ref = inverse(sensor.rig_T_sensor) @ sensors[0].rig_T_sensor
            config["cam_from_rig_rotation"] = quaternion_from_rotation(cam_T_ref[:3, :3]).tolist()
            config["cam_from_rig_translation"] = cam_T_ref[:3, 3].tolist()
        config |= {"camera_model_name": sensor.model, "camera_params": sensor.params}
        configs.append(config)
    return {"cameras": configs}


def _files(data: Dataset, name: str, views: Sequence[str], masked: bool) -> Files:
    """Files of images and masks by the pattern of their names."""
    mask = _FLAT_MASK if name == _FLAT else f"{name}.png"
    names = padded_names(data.frames.names)
    names = base_names(names) if name == _FLAT else names
    mask = f"masks/{mask}" if masked else ""
    return Files(data.folder, views, f"images/{name}", mask, data.options.masks, names)


def _names(files: Sequence[Files], frames: FrameSet) -> list[list[str]]:
    """Image names, by frame and view, from the files of each camera's frames."""
    every = [files[c].images(frames, f) for f, c in enumerate(frames.cameras.tolist())]
    return [[path.removeprefix("images/") for path in of_frame] for of_frame in every]
