"""Agisoft Metashape's cameras.xml, with images and the cloud; `gsba.trajectory.metashape` reads it.

Panoramas are one spherical sensor, whose middle column looks along z; faces are frame sensors. A
camera's transform is its pose in the chunk, with our axes; `cx` and `cy` are offsets from the
middle of the image. Labels are names of files without folders, by which Metashape finds images.
"""

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsba.camera.views import View, seen_from_lenses
from gsba.export.dataset import Dataset
from gsba.export.images import has_masks, panorama_writers, view_writers, views_of_cameras
from gsba.export.names import base_names
from gsba.export.pictures import Files, FrameWriter
from gsba.export.ply import write_cloud

_Image = tuple[str, np.ndarray, int]  # path, world_T_camera (4, 4), number of the sensor


def write_metashape(data: Dataset) -> list[FrameWriter]:
    """Write cloud and cameras.xml of panoramas or of pinhole faces, without images; returns their
    writer."""
    frames, cameras, faces = data.frames, data.cameras, data.images != "panorama"
    name = "{name}_{view}" if faces else "{name}"
    mask = f"masks/{name}.png" if has_masks(frames) else ""
    names, style = base_names(frames.names), data.options.masks

    def files_of(views: Sequence[str]) -> Files:
        return Files(data.folder, views, f"images/{name}{{suffix}}", mask, style, names)

    if not faces:
        files, poses = files_of(("",)), data.reconstruction.world_T_rigs
        sensors = [
            _sensor(number, "panorama", "spherical", kind.width, kind.height)
            for number, kind in enumerate(frames.formats)
        ]
        paths = [files.images(frames, f)[0] for f in range(len(frames))]
        _write(data, sensors, list(zip(paths, poses, frames.cameras.tolist(), strict=True)))
        return panorama_writers(data, files)
    views = views_of_cameras(frames, data.options.face_size, cameras)
    of_cameras = [files_of([view.name for view in own]) for own in views]
    sensors, kinds = list[ET.Element](), list[list[int]]()
    for own in views:
        alike = len({view.intrinsics for view in own}) == 1
        first = len(sensors)
        sensors += [_pinhole(first + n, view) for n, view in enumerate(own[:1] if alike else own)]
        kinds.append([first + n * (not alike) for n in range(len(own))])
    seen, images = seen_from_lenses(data.reconstruction, cameras), list[_Image]()
    for f, camera in enumerate(frames.cameras.tolist()):
        poses = seen.world_T_rigs[f] @ np.stack([view.rig_T_view for view in views[camera]])
        paths = of_cameras[camera].images(frames, f)
        images += zip(paths, poses, kinds[camera], strict=True)
    _write(data, sensors, images)
    return view_writers(data, of_cameras, views)


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


def _write(data: Dataset, sensors: Sequence[ET.Element], images: Sequence[_Image]) -> None:
    """Write cameras.xml and the cloud."""
    write_cloud(data.folder / "points3D.ply", data.reconstruction)
    document = ET.Element("document", {"version": "1.5.0"})
    chunk = ET.SubElement(document, "chunk", {"label": "gsba", "enabled": "true"})
    ET.SubElement(chunk, "sensors", {"next_id": str(len(sensors))}).extend(sensors)
    components = ET.SubElement(chunk, "components", {"next_id": "1", "active_id": "0"})
    component = {"id": "0", "label": "Component 1", "active": "true"}
    transform = ET.SubElement(ET.SubElement(components, "component", component), "transform")
    ET.SubElement(transform, "rotation").text = "1 0 0 0 1 0 0 0 1"
    ET.SubElement(transform, "translation").text = "0 0 0"
    ET.SubElement(transform, "scale").text = "1"
    cameras = ET.SubElement(chunk, "cameras", {"next_id": str(len(images))})
    for number, (path, world_T_camera, sensor) in enumerate(images):
        camera = {"id": str(number), "sensor_id": str(sensor)}
        camera |= {"component_id": "0", "label": Path(path).stem, "enabled": "true"}
        entry = ET.SubElement(cameras, "camera", camera)
        numbers = map(repr, map(float, world_T_camera.ravel()))
        ET.SubElement(entry, "transform").text = " ".join(numbers)
    ET.indent(document)
    tree = ET.ElementTree(document)
    tree.write(data.folder / "cameras.xml", encoding="UTF-8", xml_declaration=True)
