"""COLMAP models (4.x): rigs and frames, with images.bin consistent for readers that know neither.

Three layouts:

* `colmap`: six PINHOLE faces in one rig, `images/front/NAME.jpg`, `masks/front/NAME.jpg.png`,
  `sparse/0`, and `rig_config.json` for COLMAP's own tools.
* `colmap-flat`: the same cameras, `images/NAME_front.jpg`. For trainers that resolve images by
  their base name. `sparse/0/points3D.ply` is INRIA's start cloud, and `sparse/0/test.txt` lists all
  faces of every eighth frame: holding out single faces would leave their siblings in the training.
* `colmap-erp`: one EQUIRECTANGULAR camera and the panoramas themselves.

A frame's pose is stored as rig_from_world, where COLMAP's rig frame is that of the first camera.
Image f * C + c + 1 is face c of frame f, point j + 1 is point j.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsba.camera.rig import RIG_R_FACE
from gsba.camera.sphere import erp_from_bearings
from gsba.export.images import face_size_for, suffix_of, write_faces, write_panoramas
from gsba.export.ply import write_splat_points
from gsba.geometry import inverse, quaternion_from_rotation
from gsba.log import GsbaError
from gsba.types import FACES, FrameSet, Reconstruction

TEST_EVERY = 8  # frames, as the trainers' own hold-out


@dataclass(frozen=True, slots=True)
class Sensors:
    """Concentric, equal cameras of one rig."""

    model: str  # COLMAP's name
    width: int  # pixels
    height: int  # pixels
    params: tuple[float, ...]  # as the model wants them, corner origin
    rig_R_sensors: np.ndarray  # (C, 3, 3) float64


def write_colmap(
    partial: Path,
    reconstruction: Reconstruction,
    frames: FrameSet,
    face_size: int | None,
    link: bool = False,
) -> None:
    """Write the rig layout into `partial`."""
    size, faces = face_size_for(frames, face_size), frames.faces or FACES
    names = [[f"{face}/{_file(frames, f)}" for face in faces] for f in range(len(frames))]
    sensors = _pinholes(faces, size)
    write_model(partial / "sparse" / "0", reconstruction, sensors, names)
    text = json.dumps(_rig_config(sensors, faces), indent=1) + "\n"
    (partial / "rig_config.json").write_text(text)
    _write_named_faces(partial, frames, size, names, link)


def write_colmap_flat(
    partial: Path,
    reconstruction: Reconstruction,
    frames: FrameSet,
    face_size: int | None,
    link: bool = False,
) -> None:
    """Write the layout with unique base names into `partial`."""
    size, faces = face_size_for(frames, face_size), frames.faces or FACES
    names = [
        [f"{name}_{face}{suffix_of(frames, f)}" for face in faces]
        for f, name in enumerate(frames.names)
    ]
    model = partial / "sparse" / "0"
    write_model(model, reconstruction, _pinholes(faces, size), names)
    write_splat_points(
        model / "points3D.ply", reconstruction.points_world, reconstruction.point_colors
    )
    held_out = [name for of_frame in names[::TEST_EVERY] for name in of_frame]
    (model / "test.txt").write_text("\n".join(held_out) + "\n")
    _write_named_faces(partial, frames, size, names, link)


def write_colmap_erp(
    partial: Path, reconstruction: Reconstruction, frames: FrameSet, link: bool = False
) -> None:
    """Write the equirectangular layout into `partial`."""
    if not frames.panoramic:
        raise GsbaError("colmap-erp needs panoramas, these frames are cube faces: use colmap")
    size = (frames.width, frames.height)
    sensors = Sensors("EQUIRECTANGULAR", *size, (float(size[0]), float(size[1])), np.eye(3)[None])
    names = [_file(frames, f) for f in range(len(frames))]
    write_model(partial / "sparse" / "0", reconstruction, sensors, [[name] for name in names])
    write_panoramas(
        frames,
        lambda f: partial / "images" / names[f],
        lambda f: partial / "masks" / f"{names[f]}.png",
        link,
    )


def write_model(
    folder: Path, reconstruction: Reconstruction, sensors: Sensors, names: list[list[str]]
) -> None:
    """Write rigs, cameras, frames, images and points3D in binary.

    Args:
        folder: made, with its parents.
        reconstruction: poses, points and observations.
        sensors: the cameras each frame is seen through.
        names: image names, by frame and sensor.
    """
    import pycolmap

    num_sensors = len(sensors.rig_R_sensors)
    model = pycolmap.Reconstruction()
    ids = [_add_camera(model, sensors, c + 1) for c in range(num_sensors)]
    rig = pycolmap.Rig(rig_id=1)
    rig.add_ref_sensor(ids[0])
    ref_R_rig = sensors.rig_R_sensors[0].T
    for c in range(1, num_sensors):
        sensor_R_ref = sensors.rig_R_sensors[c].T @ ref_R_rig.T
        rig.add_sensor(ids[c], pycolmap.Rigid3d(pycolmap.Rotation3d(sensor_R_ref), np.zeros(3)))
    model.add_rig(rig)

    which, pixels = _project(sensors, reconstruction.observation_bearings)
    images = reconstruction.observation_frames * np.int64(num_sensors) + which
    order = np.argsort(images, kind="stable")
    starts = np.searchsorted(images[order], np.arange(len(names) * num_sensors + 1))
    rows = np.empty(len(images), np.int64)  # row of each observation in its image
    rows[order] = np.arange(len(images)) - starts[images[order]]

    rigs_T_world = inverse(reconstruction.world_T_rigs)
    for f, of_frame in enumerate(names):
        ref_R_world = ref_R_rig @ rigs_T_world[f, :3, :3]
        ref_from_world = pycolmap.Rigid3d(
            pycolmap.Rotation3d(ref_R_world), ref_R_rig @ rigs_T_world[f, :3, 3]
        )
        frame = pycolmap.Frame(frame_id=f + 1, rig_id=1)
        frame.rig_from_world = ref_from_world
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
    folder.mkdir(parents=True)
    model.write_binary(folder)


def _add_camera(model, sensors: Sensors, camera_id: int):
    """Add one of the equal cameras; returns its sensor id."""
    import pycolmap

    camera = pycolmap.Camera(
        model=sensors.model,
        width=sensors.width,
        height=sensors.height,
        params=sensors.params,
        camera_id=camera_id,
    )
    model.add_camera(camera)
    return camera.sensor_id


def _add_points(
    model, reconstruction: Reconstruction, images: np.ndarray, rows: np.ndarray
) -> None:
    """Add all points with their tracks; errors are COLMAP's own, mean pixels."""
    import pycolmap

    points = reconstruction.points_world
    ends = np.searchsorted(reconstruction.observation_points, np.arange(len(points) + 1))
    for j, (xyz, color) in enumerate(zip(points, reconstruction.point_colors, strict=True)):
        of_point = slice(ends[j], ends[j + 1])
        image_ids, indices = (images[of_point] + 1).tolist(), rows[of_point].tolist()
        track = pycolmap.Track(list(map(pycolmap.TrackElement, image_ids, indices)))
        model.add_point3D_with_id(j + 1, pycolmap.Point3D(xyz=xyz, color=color, track=track))
    model.update_point_3d_errors()


def _project(sensors: Sensors, bearings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sensor (O,) that looks nearest along each bearing (O, 3), and the pixel (O, 2) there."""
    if sensors.model == "EQUIRECTANGULAR":
        pixels = erp_from_bearings(bearings, sensors.width, sensors.height)
        return np.zeros(len(bearings), np.int64), pixels
    which = np.argmax(bearings @ sensors.rig_R_sensors[:, :, 2].T, axis=1)
    local = np.einsum("oji,oj->oi", sensors.rig_R_sensors[which], bearings)
    focal, _, cx, cy = sensors.params
    return which, focal * local[:, :2] / local[:, 2:] + [cx, cy]


def _pinholes(faces: tuple[str, ...], size: int) -> Sensors:
    half = size / 2
    rig_R_faces = RIG_R_FACE[[FACES.index(face) for face in faces]]
    return Sensors("PINHOLE", size, size, (half, half, half, half), rig_R_faces)


def _rig_config(sensors: Sensors, faces: tuple[str, ...]) -> list[dict]:
    """The rig as `colmap rig_configurator` reads it; rotations are cam_from_rig, wxyz."""
    camera = {"camera_model_name": sensors.model, "camera_params": sensors.params}
    configs = [{"image_prefix": f"{faces[0]}/", "ref_sensor": True, **camera}]
    for face, rig_R_face in zip(faces[1:], sensors.rig_R_sensors[1:], strict=True):
        rotation = quaternion_from_rotation(rig_R_face.T @ sensors.rig_R_sensors[0])
        configs.append(
            {
                "image_prefix": f"{face}/",
                "cam_from_rig_rotation": rotation.tolist(),
                "cam_from_rig_translation": [0.0, 0.0, 0.0],
                **camera,
            }
        )
    return [{"cameras": configs}]


def _file(frames: FrameSet, f: int) -> str:
    return f"{frames.names[f]}{suffix_of(frames, f)}"


def _write_named_faces(
    partial: Path, frames: FrameSet, size: int, names: list[list[str]], link: bool
) -> None:
    faces = frames.faces or FACES
    write_faces(
        frames,
        size,
        lambda f, face: partial / "images" / names[f][faces.index(face)],
        lambda f, face: partial / "masks" / f"{names[f][faces.index(face)]}.png",
        link,
    )
