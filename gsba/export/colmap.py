"""COLMAP models (4.x) with rigs and frames; images.bin also serves readers without these.

Layouts:

* `colmap`: PINHOLE faces in one rig, `images/front/NAME.jpg`, `masks/front/NAME.jpg.png`,
  `sparse/0`, and `rig_config.json` for COLMAP's own tools: six of one centre, or the ten of
  `gsba.camera.views` where two lenses are known.
* `colmap-flat`: the cameras of `colmap`, `images/NAME_front.jpg`. For trainers that resolve images
  by their base name. `sparse/0/points3D.ply` is INRIA's start cloud, and `sparse/0/test.txt` lists
  all faces of every eighth frame: if single faces were held out, training would show the other
  faces of the same panorama.
* `colmap` and `colmap-flat` of raw fisheyes (`--images fisheye`): two OPENCV_FISHEYE cameras and
  `images/front`, `images/back`; masks leave out pixels beyond the image circles; the rolling
  shutter is not corrected.
* `colmap-erp`: one EQUIRECTANGULAR camera and the panoramas; panoramas of two lenses are stitched
  for one centre in the middle (`gsba.camera.one_centre`).

A frame's pose is stored as rig_from_world, where COLMAP's rig frame is that of the first camera.
Image f * C + c + 1 is face c of frame f, point j + 1 is point j.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsba.camera.fisheye import Rig, facing, lens_names, optical_axes, project, rotation_of
from gsba.camera.lens import ONE_CENTRE, Lenses
from gsba.camera.one_centre import seen_from_the_middle
from gsba.camera.sphere import erp_from_bearings
from gsba.camera.views import View, scenes_of, seen_from_lenses, shown_in_pictures, views_for
from gsba.export.images import face_size_for, has_masks, panorama_writer, view_writer
from gsba.export.pictures import Files, FrameWriter
from gsba.export.ply import write_splat_points
from gsba.export.raw import RawPictures, raw_lenses
from gsba.geometry import inverse, pose, quaternion_from_rotation
from gsba.log import GsbaError
from gsba.types import Fisheye, FrameSet, Reconstruction

TEST_EVERY = 8  # one frame of so many is held out, which is the trainers' own interval
_BY_VIEW, _FLAT = "{view}/{name}{suffix}", "{name}_{view}{suffix}"  # names of images


@dataclass(frozen=True, slots=True)
class Sensor:
    """A camera of the rig."""

    model: str  # COLMAP's name
    width: int  # pixels
    height: int  # pixels
    params: tuple[float, ...]  # parameters of COLMAP's model, corner origin
    rig_T_sensor: np.ndarray  # (4, 4) float64
    fisheye: Fisheye | None = None  # lens of an OPENCV_FISHEYE camera


def write_colmap(
    partial: Path,
    reconstruction: Reconstruction,
    frames: FrameSet,
    face_size: int | None,
    link: bool = False,
    lenses: Lenses = ONE_CENTRE,
) -> FrameWriter:
    """Write the rig layout into `partial`, without images; returns their writer."""
    views = views_for(frames, face_size_for(frames, face_size), lenses)
    files = _files(partial, _BY_VIEW, [view.name for view in views], has_masks(frames))
    seen, sensors = seen_from_lenses(reconstruction, lenses), list(map(_pinhole, views))
    write_model(partial / "sparse" / "0", seen, sensors, _names(files, frames))
    text = json.dumps(_rig_config(sensors, files.views), indent=1) + "\n"
    (partial / "rig_config.json").write_text(text)
    return view_writer(files, frames, views, lenses, link, scenes_of(reconstruction))


def write_colmap_flat(
    partial: Path,
    reconstruction: Reconstruction,
    frames: FrameSet,
    face_size: int | None,
    link: bool = False,
    lenses: Lenses = ONE_CENTRE,
) -> FrameWriter:
    """Write the layout with unique base names into `partial`, without images; returns their
    writer."""
    views = views_for(frames, face_size_for(frames, face_size), lenses)
    files = _files(partial, _FLAT, [view.name for view in views], has_masks(frames))
    names, model = _names(files, frames), partial / "sparse" / "0"
    seen = seen_from_lenses(reconstruction, lenses)
    write_model(model, seen, list(map(_pinhole, views)), names)
    write_splat_points(
        model / "points3D.ply", reconstruction.points_world, reconstruction.point_colors
    )
    held_out = [name for of_frame in names[::TEST_EVERY] for name in of_frame]
    (model / "test.txt").write_text("\n".join(held_out) + "\n")
    return view_writer(files, frames, views, lenses, link, scenes_of(reconstruction))


def write_colmap_raw(
    partial: Path,
    reconstruction: Reconstruction,
    frames: FrameSet,
    lenses: Lenses,
    flat: bool,
    link: bool = False,
) -> FrameWriter:
    """Write the rig or the flat layout of raw fisheyes into `partial`, without images; returns
    their writer."""
    sensors = _raw_sensors(frames, lenses)
    of_lenses = lens_names(len(sensors))
    files = _files(partial, _FLAT if flat else _BY_VIEW, of_lenses, masked=True)
    names, model = _names(files, frames), partial / "sparse" / "0"
    write_model(model, shown_in_pictures(reconstruction, lenses), sensors, names)
    if flat:
        held_out = [name for of_frame in names[::TEST_EVERY] for name in of_frame]
        (model / "test.txt").write_text("\n".join(held_out) + "\n")
        write_splat_points(
            model / "points3D.ply", reconstruction.points_world, reconstruction.point_colors
        )
    else:
        text = json.dumps(_rig_config(sensors, of_lenses), indent=1) + "\n"
        (partial / "rig_config.json").write_text(text)
    return RawPictures(files, link)


def write_colmap_erp(
    partial: Path,
    reconstruction: Reconstruction,
    frames: FrameSet,
    link: bool = False,
    lenses: Lenses = ONE_CENTRE,
) -> FrameWriter:
    """Write the equirectangular layout into `partial`, without images; returns their writer.

    Raises:
        GsbaError: the frames are cube faces.
    """
    if not frames.panoramic:
        raise GsbaError("colmap-erp needs panoramas, these frames are cube faces: use colmap")
    size = (frames.width, frames.height)
    sensor = Sensor("EQUIRECTANGULAR", *size, (float(size[0]), float(size[1])), np.eye(4))
    files = _files(partial, "{name}{suffix}", ("",), has_masks(frames))
    seen = seen_from_the_middle(reconstruction) if lenses else reconstruction
    write_model(partial / "sparse" / "0", seen, [sensor], _names(files, frames))
    return panorama_writer(files, frames, link, lenses, scenes_of(reconstruction))


def write_model(
    folder: Path, reconstruction: Reconstruction, sensors: Sequence[Sensor], names: list[list[str]]
) -> None:
    """Write rigs, cameras, frames, images and points3D in binary.

    Args:
        folder: made, with its parents.
        reconstruction: poses, points and observations.
        sensors: the cameras of the rig.
        names: image names, by frame and sensor.
    """
    import pycolmap

    num_sensors = len(sensors)
    model = pycolmap.Reconstruction()
    ids = [_add_camera(model, sensor, c + 1) for c, sensor in enumerate(sensors)]
    rig = pycolmap.Rig(rig_id=1)
    rig.add_ref_sensor(ids[0])
    rig_T_ref = sensors[0].rig_T_sensor
    for c in range(1, num_sensors):
        rig.add_sensor(ids[c], _rigid(inverse(sensors[c].rig_T_sensor) @ rig_T_ref))
    model.add_rig(rig)

    which, pixels = _project(
        sensors, reconstruction.observation_bearings, reconstruction.observation_origins
    )
    images = reconstruction.observation_frames * np.int64(num_sensors) + which
    order = np.argsort(images, kind="stable")
    starts = np.searchsorted(images[order], np.arange(len(names) * num_sensors + 1))
    rows = np.empty(len(images), np.int64)  # row of each observation in its image
    rows[order] = np.arange(len(images)) - starts[images[order]]

    rigs_T_world = inverse(reconstruction.world_T_rigs)
    for f, of_frame in enumerate(names):
        frame = pycolmap.Frame(frame_id=f + 1, rig_id=1)
        frame.rig_from_world = _rigid(inverse(rig_T_ref) @ rigs_T_world[f])
        first = f * num_sensors
        for c in range(num_sensors):
            frame.add_data_id(pycolmap.data_t(ids[c], first + c + 1))
        model.add_frame(frame)
        for c, name in enumerate(of_frame):
            seen = order[starts[first + c] : starts[first + c + 1]]
            image = pycolmap.Image(
                name=name, keypoints=pixels[seen], camera_id=c + 1, image_id=first + c + 1
            )
            image.frame_id = f + 1
            model.add_image(image)
        model.register_frame(f + 1)
    _add_points(model, reconstruction, images, rows)
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)


def _rigid(a_T_b: np.ndarray):
    import pycolmap

    return pycolmap.Rigid3d(pycolmap.Rotation3d(a_T_b[:3, :3]), a_T_b[:3, 3])


def _add_camera(model, sensor: Sensor, camera_id: int):
    """Add a camera to the model; returns its sensor id."""
    import pycolmap

    camera = pycolmap.Camera(
        model=sensor.model,
        width=sensor.width,
        height=sensor.height,
        params=sensor.params,
        camera_id=camera_id,
    )
    model.add_camera(camera)
    return camera.sensor_id


def _add_points(
    model, reconstruction: Reconstruction, images: np.ndarray, rows: np.ndarray
) -> None:
    """Add all points with their tracks; COLMAP computes their errors, mean pixels."""
    import pycolmap

    points = reconstruction.points_world
    ends = np.searchsorted(reconstruction.observation_points, np.arange(len(points) + 1))
    for j, (xyz, color) in enumerate(zip(points, reconstruction.point_colors, strict=True)):
        of_point = slice(ends[j], ends[j + 1])
        image_ids, indices = (images[of_point] + 1).tolist(), rows[of_point].tolist()
        track = pycolmap.Track(list(map(pycolmap.TrackElement, image_ids, indices)))
        model.add_point3D_with_id(j + 1, pycolmap.Point3D(xyz=xyz, color=color, track=track))
    model.update_point_3d_errors()


def _project(
    sensors: Sequence[Sensor], bearings: np.ndarray, origins: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Sensor (O,) that sees each bearing (O, 3) from its origin, and its pixel (O, 2) there.

    Among the sensors of the origin's lens it is the one with the pixel furthest from the border.
    """
    if sensors[0].fisheye is not None:
        return _project_raw(sensors, bearings, origins)
    if sensors[0].model == "EQUIRECTANGULAR":
        pixels = erp_from_bearings(bearings, sensors[0].width, sensors[0].height)
        return np.zeros(len(bearings), np.int64), pixels
    found, off = np.empty((len(sensors), len(bearings), 2)), np.empty((len(sensors), len(bearings)))
    for c, sensor in enumerate(sensors):
        local = bearings @ sensor.rig_T_sensor[:3, :3]
        depths = np.where(local[:, 2:] > 0, local[:, 2:], np.nan)
        found[c] = sensor.params[:2] * local[:, :2] / depths + sensor.params[2:]
        half = np.array([sensor.width, sensor.height]) / 2
        off[c] = np.abs(found[c] / half - 1).max(axis=1)
        if origins is not None:
            off[c, origins[:, 2] * sensor.rig_T_sensor[2, 3] < 0] = np.nan  # the other lens
    which = np.argmin(np.where(np.isnan(off), np.inf, off), axis=0)
    return which, found[which, np.arange(len(bearings))]


def _project_raw(
    sensors: Sequence[Sensor], bearings: np.ndarray, origins: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Sensor (O,) and pixel (O, 2) of each bearing (O, 3) in the raw lenses."""
    if origins is None:
        which = facing(bearings, optical_axes(_fisheyes(sensors)))
    else:
        centres = np.array([sensor.rig_T_sensor[:3, 3] for sensor in sensors])
        apart = np.linalg.norm(origins[:, None] - centres, axis=2)
        which = np.argmin(apart, axis=1)
    pixels = np.empty((len(bearings), 2))
    for c, sensor in enumerate(sensors):
        assert sensor.fisheye is not None
        pixels[which == c] = project(sensor.fisheye, bearings[which == c])
    return which, pixels


def _raw_sensors(frames: FrameSet, lenses: Lenses) -> list[Sensor]:
    """Raw lenses as cameras of the rig."""
    return [
        Sensor(
            "OPENCV_FISHEYE",
            lens.width,
            lens.height,
            (lens.focal, lens.focal, *lens.principal, *lens.radial),
            pose(rotation_of(lens), centre),
            lens,
        )
        for lens, centre in zip(raw_lenses(frames), lenses.centres, strict=True)
    ]


def _fisheyes(sensors: Sequence[Sensor]) -> Rig:
    return tuple(sensor.fisheye for sensor in sensors if sensor.fisheye is not None)


def _pinhole(view: View) -> Sensor:
    params = (view.focal, view.focal, *view.principal)
    return Sensor("PINHOLE", view.width, view.height, params, view.rig_T_view)


def _rig_config(sensors: Sequence[Sensor], names: Sequence[str]) -> list[dict]:
    """Rig in the format of `colmap rig_configurator`; rotations are cam_from_rig, wxyz."""
    configs = []
    for sensor, name in zip(sensors, names, strict=True):
        config: dict[str, object] = {"image_prefix": f"{name}/"}
        if not configs:
            config["ref_sensor"] = True
        else:
            cam_T_ref = inverse(sensor.rig_T_sensor) @ sensors[0].rig_T_sensor
            config["cam_from_rig_rotation"] = quaternion_from_rotation(cam_T_ref[:3, :3]).tolist()
            config["cam_from_rig_translation"] = cam_T_ref[:3, 3].tolist()
        config |= {"camera_model_name": sensor.model, "camera_params": sensor.params}
        configs.append(config)
    return [{"cameras": configs}]


def _files(partial: Path, name: str, views: Sequence[str], masked: bool) -> Files:
    """Files of images and masks by the pattern of their names."""
    return Files(partial, views, f"images/{name}", f"masks/{name}.png" if masked else "")


def _names(files: Files, frames: FrameSet) -> list[list[str]]:
    """Image names, by frame and view."""
    every = [files.images(frames, f) for f in range(len(frames))]
    return [[path.removeprefix("images/") for path in of_frame] for of_frame in every]
