"""Agisoft Metashape's cameras.xml, with images and the cloud.

`--images panorama`, and `auto` where frames are panoramas, give one spherical sensor, which has no
calibration: the panorama's middle column looks along z. Other images give frame sensors (pinhole
faces), one where all faces are alike. A camera's transform is its pose in the chunk, row by row,
with axes x right, y down, z forward, which are ours; `cx` and `cy` are offsets from the middle of
the image. The one component has no transform of its own, so that the chunk is the exported world.
`gsba.trajectory.metashape` reads the file back.
"""

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsba.camera.lens import ONE_CENTRE, Lenses
from gsba.camera.views import View, scenes_of, seen_from_lenses, views_for
from gsba.export.images import face_size_for, has_masks, panorama_writer, view_writer
from gsba.export.pictures import Files, FrameWriter
from gsba.export.ply import write_splat_points
from gsba.types import FrameSet, Reconstruction

_CAMERAS = "cameras.xml"


def write_metashape_panoramas(
    partial: Path,
    reconstruction: Reconstruction,
    frames: FrameSet,
    link: bool = False,
    lenses: Lenses = ONE_CENTRE,
) -> FrameWriter:
    """Write cloud and cameras.xml of panoramas into `partial`, without images; returns their
    writer."""
    mask = "masks/{name}.png" if has_masks(frames) else ""
    files = Files(partial, ("",), "images/{name}{suffix}", mask)
    sensor = _sensor(0, "panorama", "spherical", frames.width, frames.height)
    poses = reconstruction.world_T_rigs[:, None]
    _write(partial, reconstruction, [sensor], files, frames, poses, [0])
    return panorama_writer(files, frames, link, lenses, scenes_of(reconstruction))


def write_metashape_faces(
    partial: Path,
    reconstruction: Reconstruction,
    frames: FrameSet,
    face_size: int | None,
    link: bool = False,
    lenses: Lenses = ONE_CENTRE,
) -> FrameWriter:
    """Write cloud and cameras.xml of pinhole faces into `partial`, without images; returns their
    writer."""
    views = views_for(frames, face_size_for(frames, face_size), lenses)
    mask = "masks/{name}_{view}.png" if has_masks(frames) else ""
    names = [view.name for view in views]
    files = Files(partial, names, "images/{name}_{view}{suffix}", mask)
    alike = len({(view.width, view.height, view.focal, view.principal) for view in views}) == 1
    kinds = [0] * len(views) if alike else list(range(len(views)))
    sensors = [_pinhole(number, views[kinds.index(number)]) for number in sorted(set(kinds))]
    seen = seen_from_lenses(reconstruction, lenses)
    poses = seen.world_T_rigs[:, None] @ np.stack([view.rig_T_view for view in views])
    _write(partial, reconstruction, sensors, files, frames, poses, kinds)
    return view_writer(files, frames, views, lenses, link, scenes_of(reconstruction))


def _pinhole(number: int, view: View) -> ET.Element:
    sensor = _sensor(number, view.name, "frame", view.width, view.height)
    calibration = ET.SubElement(sensor, "calibration", {"type": "frame", "class": "adjusted"})
    _resolution(calibration, view.width, view.height)
    offsets = view.principal[0] - view.width / 2, view.principal[1] - view.height / 2
    for name, value in zip(("f", "cx", "cy"), (view.focal, *offsets), strict=True):
        ET.SubElement(calibration, name).text = repr(float(value))
    return sensor


def _sensor(number: int, label: str, kind: str, width: int, height: int) -> ET.Element:
    sensor = ET.Element("sensor", {"id": str(number), "label": label, "type": kind})
    _resolution(sensor, width, height)
    for name in ("layer_index", "fixed"):
        value = "0" if name == "layer_index" else "1"  # calibrations are not to be estimated
        ET.SubElement(sensor, "property", {"name": name, "value": value})
    return sensor


def _resolution(parent: ET.Element, width: int, height: int) -> None:
    ET.SubElement(parent, "resolution", {"width": str(width), "height": str(height)})


def _write(
    partial: Path,
    reconstruction: Reconstruction,
    sensors: Sequence[ET.Element],
    files: Files,
    frames: FrameSet,
    poses: np.ndarray,
    kinds: Sequence[int],
) -> None:
    """Write cameras.xml and the cloud.

    Args:
        poses: (F, C, 4, 4) float64, world_T_camera of each frame's images.
        kinds: number of the sensor of each of a frame's C images.
    """
    write_splat_points(
        partial / "points3D.ply", reconstruction.points_world, reconstruction.point_colors
    )
    document = ET.Element("document", {"version": "1.5.0"})
    chunk = ET.SubElement(document, "chunk", {"label": "gsba", "enabled": "true"})
    ET.SubElement(chunk, "sensors", {"next_id": str(len(sensors))}).extend(sensors)
    components = ET.SubElement(chunk, "components", {"next_id": "1", "active_id": "0"})
    component = {"id": "0", "label": "Component 1", "active": "true"}
    transform = ET.SubElement(ET.SubElement(components, "component", component), "transform")
    ET.SubElement(transform, "rotation").text = "1 0 0 0 1 0 0 0 1"
    ET.SubElement(transform, "translation").text = "0 0 0"
    ET.SubElement(transform, "scale").text = "1"
    cameras = ET.SubElement(chunk, "cameras", {"next_id": str(poses.shape[0] * poses.shape[1])})
    for f, of_frame in enumerate(poses):
        paths = files.images(frames, f)
        for c, (path, world_T_camera) in enumerate(zip(paths, of_frame, strict=True)):
            camera = {"id": str(f * len(of_frame) + c), "sensor_id": str(kinds[c])}
            camera |= {"component_id": "0", "label": Path(path).stem, "enabled": "true"}
            entry = ET.SubElement(cameras, "camera", camera)
            numbers = map(repr, map(float, world_T_camera.ravel()))
            ET.SubElement(entry, "transform").text = " ".join(numbers)
    ET.indent(document)
    tree = ET.ElementTree(document)
    tree.write(partial / _CAMERAS, encoding="UTF-8", xml_declaration=True)
