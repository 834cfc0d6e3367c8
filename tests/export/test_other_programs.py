"""Exports for Metashape, Blender and trainers by name, read back by their own readers or rules."""

import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from export_scene import (
    COLORS,
    NUM_FRAMES,
    POINTS,
    assert_blob,
    cube_frames,
    exported,
    moved_by_velocities,
    panoramas,
    poses,
    reconstruction,
)
from refusals import refused
from scipy.spatial.transform import Rotation, Slerp

from gsba.cli.options import OPTIONS
from gsba.disk import read_vertices
from gsba.export import ExportFormat, Shutter, export
from gsba.export.gltf import write_gltf
from gsba.export.trainers import PROGRAMS, format_of, how_to_start
from gsba.geometry import inverse
from gsba.log import GsbaError
from gsba.placement.placement import Placement
from gsba.similarity import Sim3
from gsba.trajectory.metashape import is_metashape, read_metashape

_CV_R_GL = np.diag([1.0, -1, -1, 1])


def _chunk(path: Path) -> ET.Element:
    chunk = ET.parse(path).getroot()[0]  # as nerfstudio's reader finds it
    assert chunk.tag == "chunk"
    return chunk


def test_metashape_holds_panoramas_as_nerfstudio_reads_them(tmp_path: Path) -> None:
    frames = panoramas(tmp_path / "frames")
    export(reconstruction(), frames, tmp_path / "out", ExportFormat.METASHAPE)
    chunk = _chunk(tmp_path / "out/cameras.xml")
    (sensor,) = chunk.findall("sensors/sensor")
    resolution = sensor.find("resolution")
    assert sensor.get("type") == "spherical" and sensor.find("calibration") is None
    assert (resolution.get("width"), resolution.get("height")) == ("512", "256")
    component = chunk.find("components/component/transform")
    assert component is not None and component.findtext("scale") == "1"
    cameras = chunk.findall("cameras/camera")
    assert [camera.get("label") for camera in cameras] == list(frames.names)
    for camera, pose in zip(cameras, poses(), strict=True):
        numbers = np.array((camera.findtext("transform") or "").split(), float)
        np.testing.assert_array_equal(numbers.reshape(4, 4), pose)
        assert (tmp_path / "out/images" / f"{camera.get('label')}.png").is_file()


@pytest.mark.parametrize("layout", ["erp", "cube"])
def test_metashape_faces_show_points_where_their_cameras_say(layout: str, tmp_path: Path) -> None:
    make = {"erp": panoramas, "cube": cube_frames}[layout]
    frames = make(tmp_path / "frames")
    to = ExportFormat.METASHAPE
    export(reconstruction(), frames, tmp_path / "out", to, images="cube")
    chunk = _chunk(tmp_path / "out/cameras.xml")
    sensors = {sensor.get("id"): sensor for sensor in chunk.findall("sensors/sensor")}
    looked = 0
    for camera in chunk.findall("cameras/camera"):
        sensor = sensors[camera.get("sensor_id")]
        calibration = sensor.find("calibration")
        assert sensor.get("type") == "frame" and calibration is not None
        f, cx, cy = (float(calibration.findtext(name) or "") for name in ("f", "cx", "cy"))
        image = cv2.imread(str(tmp_path / f"out/images/{camera.get('label')}.png"))
        height, width = image.shape[:2]
        chunk_T_camera = np.array((camera.findtext("transform") or "").split(), float)
        local = (inverse(chunk_T_camera.reshape(4, 4)) @ np.column_stack([POINTS, [1] * 9]).T).T
        for (x, y, z), color in zip(local[:, :3], COLORS, strict=True):
            pixel = np.array([f * x / z + cx + width / 2, f * y / z + cy + height / 2])
            if z > 0 and (pixel > 0).all() and (pixel < (width, height)).all():
                looked += assert_blob(image[..., ::-1], pixel, color, f)
    assert looked > NUM_FRAMES


def test_metashape_cameras_come_back_as_a_trajectory(tmp_path: Path) -> None:
    frames = panoramas(tmp_path / "frames")
    export(reconstruction(), frames, tmp_path / "out", ExportFormat.METASHAPE)
    path = tmp_path / "out/cameras.xml"
    assert is_metashape(path)
    (component,) = read_metashape(path)
    trajectory = component.timed(frames)
    np.testing.assert_array_equal(trajectory.timestamps, frames.timestamps)
    np.testing.assert_allclose(trajectory.world_T_rigs, poses(), atol=1e-12)
    with pytest.raises(GsbaError, match=r"0 of 9 cameras are frames of this run.*'frame_0000'"):
        component.timed(replace(frames, names=tuple(f"x{n}" for n in range(NUM_FRAMES))))


def test_each_component_of_metashape_is_a_piece(tmp_path: Path) -> None:
    text = _cameras_xml(
        [("a.jpg", 0, 0), ("b.jpg", 0, 1), ("c.jpg", 0, 1), ("sub/d.jpg", 0, 1), ("e", 1, 0)]
    )
    (tmp_path / "cameras.xml").write_text(text)
    first, second = read_metashape(tmp_path / "cameras.xml")
    assert (first.names, second.names) == (("b", "c", "d"), ("a",))


_FAULTS = {
    "": "damaged XML",
    "<document": "damaged XML",
    "<html></html>": "not Metashape's cameras.xml",
    "frame": "its cameras are of type frame",
    "unaligned": "none of its spherical cameras is aligned",
    "twice": "two cameras are named 'a.jpg'",
    "short": "its transform is not 16 numbers",
    "nan": "its transform is not finite",
    "mirrored": "is not a rotation",
}


@pytest.mark.parametrize("fault", _FAULTS)
def test_what_metashape_did_not_write_is_refused(fault: str, tmp_path: Path) -> None:
    text = _cameras_xml([("a.jpg", 0, 0), ("a.jpg" if fault == "twice" else "b.jpg", 0, 0)])
    one = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
    changes = {
        "frame": ("spherical", "frame"),
        "unaligned": ("transform", "reference"),
        "twice": ("", ""),
        "short": (one, "1 0 0"),
        "nan": (one, one.replace("1", "nan", 1)),
        "mirrored": (one, "-" + one),
    }
    (tmp_path / "x.xml").write_text(text.replace(*changes[fault]) if fault in changes else fault)
    refused(_FAULTS[fault], read_metashape, tmp_path / "x.xml")


def _cameras_xml(cameras: list[tuple[str, int, int]]) -> str:
    """File with cameras of (label, sensor, component), all at the origin."""
    rows = "".join(
        f'<camera id="{n}" sensor_id="{sensor}" component_id="{component}" label="{label}">'
        "<transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera>"
        for n, (label, sensor, component) in enumerate(cameras)
    )
    sensors = '<sensor id="0" type="spherical"/><sensor id="1" type="frame"/>'
    return (
        '<?xml version="1.0"?><document version="1.5.0"><chunk>'
        f"<sensors>{sensors}</sensors><cameras>{rows}</cameras></chunk></document>"
    )


_WORLD_R_LEVEL = {  # rotations of a world whose y points down, by the axis that then points up
    "-y": np.eye(3),
    "y": np.diag([1.0, -1, -1]),
    "z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "-z": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "x": np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]]),
    "-x": np.array([[0, 1.0, 0], [-1, 0, 0], [0, 0, 1]]),
}


@pytest.mark.parametrize("up", _WORLD_R_LEVEL)
@pytest.mark.parametrize("known", [True, False])
def test_gltf_stands_upright_in_trimesh(up: str, known: bool, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    frames, level = panoramas(tmp_path / "frames"), reconstruction()
    placed = Placement(Sim3(rotation=_WORLD_R_LEVEL[up])).apply(level)
    write_gltf(tmp_path / "scene.glb", placed, frames, up if known else None)
    read = trimesh.load(tmp_path / "scene.glb")
    (cloud,) = read.geometry.values()
    np.testing.assert_array_equal(np.asarray(cloud.colors)[:, :3], COLORS)
    gltf_R_level = np.linalg.lstsq(POINTS, cloud.vertices, rcond=None)[0].T
    np.testing.assert_allclose(gltf_R_level @ gltf_R_level.T, np.eye(3), atol=1e-5)
    np.testing.assert_allclose(gltf_R_level @ [0, -1, 0], [0, 1, 0], atol=1e-5)  # y is up
    for name, pose in zip(frames.names[:-1], poses()[:-1], strict=True):  # the last camera
        matrix, _ = read.graph[name]  # becomes the view of trimesh's scene
        back = np.eye(4)
        back[:3] = gltf_R_level.T @ matrix[:3] @ _CV_R_GL
        np.testing.assert_allclose(back, pose, atol=1e-5)


def test_rigs_without_a_common_up_stay_in_a_world_whose_y_points_down(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    frames, scene = panoramas(tmp_path / "frames"), reconstruction()
    turns = Rotation.from_rotvec(np.arange(NUM_FRAMES)[:, None] * [2 * np.pi / NUM_FRAMES, 0, 0])
    scene.world_T_rigs[:, :3, :3] = turns.as_matrix()
    write_gltf(tmp_path / "scene.glb", scene, frames)
    (cloud,) = trimesh.load(tmp_path / "scene.glb").geometry.values()
    np.testing.assert_allclose(cloud.vertices, POINTS * (1, -1, -1), atol=1e-5)


@pytest.mark.parametrize("up", ["-y", "y", "z"])
def test_nerfstudio_gets_a_world_whose_z_points_up(up: str, tmp_path: Path) -> None:
    placement = Placement(Sim3(rotation=_WORLD_R_LEVEL[up]), up=up)
    out = exported(tmp_path, ExportFormat.NERFSTUDIO, 64, placement)
    vertices = read_vertices(out / "points3D.ply")
    np.testing.assert_allclose(np.sort(vertices["z"]), np.sort(-POINTS[:, 1]), atol=1e-5)


def test_gltf_camera_walks_through_all_frames(tmp_path: Path) -> None:
    gltf = pytest.importorskip("pygltflib").GLTF2()
    frames = panoramas(tmp_path / "frames")
    export(reconstruction(), frames, tmp_path / "out", ExportFormat.GLTF)
    scene = gltf.load(str(tmp_path / "out/scene.glb"))
    content = scene.binary_blob()

    def values(number: int, width: int) -> np.ndarray:
        accessor = scene.accessors[number]
        view = scene.bufferViews[accessor.bufferView]
        assert view.byteOffset % 4 == 0
        row = np.frombuffer(content, "<f4", accessor.count * width, view.byteOffset)
        return row.reshape(accessor.count, width)

    (walk,) = scene.animations
    assert scene.nodes[walk.channels[0].target.node].camera == 0
    for channel, width in zip(walk.channels, (3, 4), strict=True):
        sampler = walk.samplers[channel.sampler]
        times, moved = values(sampler.input, 1)[:, 0], values(sampler.output, width)
        np.testing.assert_allclose(times, frames.timestamps - frames.timestamps[0], atol=1e-6)
        if channel.target.path == "translation":
            np.testing.assert_allclose(moved, poses()[:, :3, 3] * (1, -1, -1), atol=1e-6)
        else:
            turns = np.diag([1.0, -1, -1]) @ poses()[:, :3, :3] @ _CV_R_GL[:3, :3]
            np.testing.assert_allclose(Rotation.from_quat(moved).as_matrix(), turns, atol=1e-6)
            assert (np.sum(moved[1:] * moved[:-1], axis=1) > 0).all()


@pytest.mark.parametrize("name", PROGRAMS)
def test_each_program_reads_the_format_that_its_name_gives(name: str, tmp_path: Path) -> None:
    frames, out = panoramas(tmp_path / "frames"), tmp_path / name
    export(reconstruction(), frames, out, format_of(name), face_size=64, split=False)
    (start,) = how_to_start(name, out)
    assert str(out) in start
    if format_of(name) == ExportFormat.COLMAP_FLAT:
        model = pycolmap.Reconstruction(out / "sparse/0")
        assert {camera.model.name for camera in model.cameras.values()} == {"PINHOLE"}
        names = [Path(image.name) for image in model.images.values()]
        assert len({path.name for path in names}) == len(names) == 6 * NUM_FRAMES
        assert all((out / "images" / path.name).is_file() for path in names)
        assert (out / "sparse/0/points3D.ply").is_file()
    elif format_of(name) == ExportFormat.NERFSTUDIO:
        meta = json.loads((out / "transforms.json").read_text())
        assert meta["ply_file_path"] == "points3D.ply" and meta["camera_model"] == "OPENCV"
    else:
        assert (out / "scene.glb").is_file()


def test_programs_hold_out_only_what_an_export_holds_out(tmp_path: Path) -> None:
    assert [line.count("--eval") for line in how_to_start("inria", tmp_path)] == [0]
    (tmp_path / "test_list.txt").write_text("")
    assert [line.count("--eval") for line in how_to_start("inria", tmp_path)] == [1]


def test_programs_are_listed_in_help_and_docs() -> None:
    listed = " ".join(OPTIONS["export.to"].help.split())
    page = (Path(__file__).parents[2] / "docs/exports.md").read_text()
    for name in PROGRAMS:
        assert name in listed and f"`gsba export RUN --to {name}" in page, name


def test_unknown_names_are_refused() -> None:
    refused(r"--to posthot is not known: use one of colmap.*postshot", format_of, "posthot")
    refused(r"supersplat: it edits splats.*point_cloud.ply", format_of, "supersplat")


def test_an_exposure_for_a_format_without_one_is_refused(tmp_path: Path) -> None:
    given, choices = (reconstruction(), panoramas(tmp_path / "frames")), {"shutter": Shutter(0, 1)}
    message = "--exposure-ms goes with nerfstudio, 3dgs-deblur, not with colmap"
    refused(message, export, *given, tmp_path / "out", ExportFormat.COLMAP, **choices)


def test_velocities_say_where_neighbouring_frames_are(tmp_path: Path) -> None:
    """A camera that turns and moves steadily: each face is where its velocity puts it."""
    frames = panoramas(tmp_path / "frames")
    frames = replace(frames, timestamps=np.arange(NUM_FRAMES) * 0.01)
    first, last = np.eye(4), np.eye(4)
    last[:3, :3] = Rotation.from_rotvec([0.02, 0.05, -0.03]).as_matrix()
    last[:3, 3] = [0.2, -0.1, 0.4]
    shares = np.linspace(0, 1, NUM_FRAMES)
    turns = Slerp([0, 1], Rotation.from_matrix(np.stack([first, last])[:, :3, :3]))(shares)
    walk = np.tile(np.eye(4), (NUM_FRAMES, 1, 1))
    walk[:, :3, :3], walk[:, :3, 3] = turns.as_matrix(), shares[:, None] * last[:3, 3]
    scene = replace(reconstruction(), world_T_rigs=walk)
    to, shutter = ExportFormat.NERFSTUDIO, Shutter(exposure_s=0.005)
    export(scene, frames, tmp_path / "out", to, face_size=32, shutter=shutter)
    meta = json.loads((tmp_path / "out/transforms.json").read_text())
    assert (meta["exposure_time"], meta["rolling_shutter_time"]) == (0.005, 0.0)
    for before, after in zip(meta["frames"][:-6], meta["frames"][6:], strict=True):
        wanted = np.array(after["transform_matrix"])
        np.testing.assert_allclose(moved_by_velocities(before, 0.01), wanted, atol=2e-4)


def test_frames_far_apart_have_no_velocities(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    frames, shutter = panoramas(tmp_path / "frames"), Shutter(exposure_s=0.005)  # half a second
    to, size = ExportFormat.NERFSTUDIO, 32
    export(reconstruction(), frames, tmp_path / "out", to, face_size=size, shutter=shutter)
    assert "the exposure is not written" in caplog.text
    meta = json.loads((tmp_path / "out/transforms.json").read_text())
    assert "exposure_time" not in meta and "camera_linear_velocity" not in meta["frames"][0]
