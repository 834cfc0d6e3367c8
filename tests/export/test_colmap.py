"""COLMAP exports, read back with pycolmap."""

import shutil
from dataclasses import replace

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
    panoramas,
    reconstruction,
    reprojection_errors,
)
from plain_records import observing
from plyfile import PlyData

from gsba.export import ExportFormat, ExportOptions, export, export_all
from gsba.log import GsbaError
from gsba.types import FACES

LAYOUTS = [ExportFormat.COLMAP, ExportFormat.COLMAP_FLAT, ExportFormat.COLMAP_ERP]


@pytest.fixture(scope="module")
def exports(tmp_path_factory):
    """The scene in each COLMAP layout, with masks."""
    folder = tmp_path_factory.mktemp("colmap")
    frames = panoramas(folder / "frames", masked=True)
    outs = {to: folder / to for to in LAYOUTS}
    export_all(reconstruction(), frames, outs, ExportOptions(split=False))
    return folder


def _names(model):
    return {image.name for image in model.images.values()}


@pytest.mark.parametrize("to", LAYOUTS)
def test_points_land_on_their_observations(exports, to):
    model = pycolmap.Reconstruction(exports / to / "sparse" / "0")
    assert model.is_valid() is not False
    assert model.num_reg_frames() == NUM_FRAMES and model.num_points3D() == len(POINTS)
    errors = reprojection_errors(model)
    assert errors.max() < 1e-6  # round-off on coordinates of some hundred pixels
    assert len(errors) == NUM_FRAMES * len(POINTS) == model.compute_num_observations()


@pytest.mark.parametrize("to", LAYOUTS)
def test_points_keep_place_colour_track_and_error(exports, to):
    model = pycolmap.Reconstruction(exports / to / "sparse" / "0")
    for j in range(len(POINTS)):
        point = model.points3D[j + 1]
        assert np.array_equal(point.xyz, POINTS[j]) and np.array_equal(point.color, COLORS[j])
        assert point.track.length() == NUM_FRAMES and 0 <= point.error < 1e-6
        for element in point.track.elements:
            image = model.images[element.image_id]
            assert image.points2D[element.point2D_idx].point3D_id == j + 1


@pytest.mark.parametrize("to", LAYOUTS)
def test_readers_of_images_alone_get_the_poses_of_frames_and_rigs(exports, to, tmp_path):
    source = exports / to / "sparse" / "0"
    for name in ("cameras.bin", "images.bin", "points3D.bin"):  # COLMAP up to 3.11, trainers
        shutil.copy(source / name, tmp_path / name)
    old, new = pycolmap.Reconstruction(tmp_path), pycolmap.Reconstruction(source)
    world_T_rigs = reconstruction().world_T_rigs
    assert sorted(old.images) == sorted(new.images)
    for image_id, image in new.images.items():
        matrix = image.cam_from_world().matrix()
        assert np.allclose(old.images[image_id].cam_from_world().matrix(), matrix, atol=1e-12)
        centre = -matrix[:, :3].T @ matrix[:, 3]
        assert np.allclose(centre, world_T_rigs[image.frame_id - 1, :3, 3], atol=1e-12)


@pytest.mark.parametrize("to", [ExportFormat.COLMAP, ExportFormat.COLMAP_FLAT])
def test_pictures_show_the_points_where_the_cameras_say(exports, to):
    model = pycolmap.Reconstruction(exports / to / "sparse" / "0")
    seen = dict.fromkeys(FACES, 0)
    for image in model.images.values():
        pixels = cv2.imread(str(exports / to / "images" / image.name))[..., ::-1]
        camera = model.cameras[image.camera_id]
        assert pixels.shape == (camera.height, camera.width, 3)
        face = next(face for face in FACES if face in image.name)
        for point2D in image.points2D:
            color = model.points3D[point2D.point3D_id].color
            seen[face] += assert_blob(pixels, point2D.xy, color)
    assert min(seen.values()) > 0


def test_the_rig_has_six_right_angled_faces_of_the_panoramas_resolution(exports):
    model = pycolmap.Reconstruction(exports / "colmap" / "sparse" / "0")
    assert model.num_rigs() == 1 and model.num_cameras() == 6 and model.num_frames() == NUM_FRAMES
    for camera in model.cameras.values():
        assert camera.model.name == "PINHOLE" and (camera.width, camera.height) == (128, 128)
        assert camera.params.tolist() == [64, 64, 64, 64]
    assert _names(model) == {f"{face}/frame_{f:04d}.png" for face in FACES for f in range(9)}


def test_the_rig_config_is_that_of_the_model(exports):
    model = pycolmap.Reconstruction(exports / "colmap" / "sparse" / "0")
    (config,) = pycolmap.read_rig_config(exports / "colmap" / "rig_config.json")
    assert [camera.image_prefix for camera in config.cameras] == [f"{face}/" for face in FACES]
    assert config.cameras[0].ref_sensor
    for camera_id, camera in enumerate(config.cameras[1:], start=2):
        sensor = model.cameras[camera_id].sensor_id
        matrix = model.rigs[1].sensor_from_rig(sensor).matrix()
        assert np.allclose(camera.cam_from_rig.matrix(), matrix, atol=1e-12)


def test_masks_lie_beside_every_image_and_hide_below(exports):
    for to, names in (("colmap", "{}/frame_0000.png.png"), ("colmap-flat", "frame_0000_{}.png")):
        share = {}
        for face in FACES:
            (path,) = (exports / to / "masks").glob(names.format(face))
            mask = cv2.imread(str(path), -1)
            assert mask.shape == (128, 128) and set(np.unique(mask)) <= {0, 255}
            share[face] = (mask > 0).mean()
        assert share["up"] == 1 and 0.9 < share["front"] < 1 and share["down"] < 0.3
        masks = {
            p.relative_to(exports / to / "masks") for p in (exports / to / "masks").rglob("*.png")
        }
        assert len(masks) == 6 * NUM_FRAMES
    mask = cv2.imread(str(exports / "colmap-erp" / "masks" / "frame_0003.png.png"), -1)
    assert mask.shape == (256, 512) and set(np.unique(mask)) == {0, 255}


def test_flat_names_are_unique_and_the_cloud_is_inrias(exports):
    root = exports / "colmap-flat"
    model = pycolmap.Reconstruction(root / "sparse" / "0")
    assert {path.name for path in (root / "images").iterdir()} == _names(model)
    cloud = PlyData.read(root / "sparse" / "0" / "points3D.ply")["vertex"]
    names = [p.name for p in cloud.properties]
    assert " ".join(names) == "x y z nx ny nz red green blue"
    assert np.allclose(np.column_stack([cloud["x"], cloud["y"], cloud["z"]]), POINTS, atol=1e-6)
    assert np.array_equal(np.column_stack([cloud["red"], cloud["green"], cloud["blue"]]), COLORS)


def test_panoramas_go_out_unchanged(exports):
    root = exports / "colmap-erp"
    model = pycolmap.Reconstruction(root / "sparse" / "0")
    (camera,) = model.cameras.values()
    assert camera.model.name == "EQUIRECTANGULAR" and camera.params.tolist() == [512, 256]
    for name in _names(model):
        assert (root / "images" / name).read_bytes() == (exports / "frames" / name).read_bytes()


def test_an_observation_across_the_seam_has_a_small_error(tmp_path):
    scene = reconstruction()
    points = scene.points_world.copy()
    points[2] = [-1e-9, 0, -5]  # the world of frame 0: projects to u = 0
    bearings = scene.observation_bearings.copy()
    bearings[2 * NUM_FRAMES] = [1e-6, 0, -1]  # seen at u = width
    frames = panoramas(tmp_path / "frames")
    keep = np.arange(len(bearings)) == 2 * NUM_FRAMES
    moved = observing(scene, keep, observation_bearings=bearings[keep], points_world=points)
    export(moved, frames, tmp_path / "out", ExportFormat.COLMAP_ERP)
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    assert model.points3D[3].error < 1e-3


def test_errors_are_pixels_of_the_exported_cameras(tmp_path):
    scene = reconstruction()
    bearings = scene.observation_bearings.copy()
    bearings[0] = [0.3 / 5 + 0.02, 0.2 / 5, 1]  # point 0 in frame 0, the world's own axes
    bearings[0] /= np.linalg.norm(bearings[0])
    frames = panoramas(tmp_path / "frames")
    moved = replace(scene, observation_bearings=bearings)
    export(moved, frames, tmp_path / "out", ExportFormat.COLMAP, face_size=200)
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    assert model.points3D[1].error == pytest.approx(0.02 * 100 / NUM_FRAMES, rel=1e-9)
    assert cv2.imread(str(tmp_path / "out" / "images" / "up" / "frame_0000.png")).shape[0] == 200


@pytest.mark.parametrize("face_size", [None, 64])
def test_faces_that_were_not_captured_stay_out(tmp_path, face_size):
    frames = cube_frames(tmp_path / "frames")
    scene = reconstruction()
    side = np.argmax(np.abs(scene.observation_bearings), axis=1) != 1
    scene = observing(scene, side)
    export(scene, frames, tmp_path / "out", ExportFormat.COLMAP, face_size)
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    assert {name.split("/")[0] for name in _names(model)} == {"front", "right", "back", "left"}
    assert len(list((tmp_path / "out" / "images").rglob("*.png"))) == 4 * NUM_FRAMES
    assert reprojection_errors(model).max() < 1e-6
    checked = 0
    for image in model.images.values():
        pixels = cv2.imread(str(tmp_path / "out" / "images" / image.name))[..., ::-1]
        assert pixels.shape[0] == (face_size or 128)
        for point2D in image.points2D:
            color = model.points3D[point2D.point3D_id].color
            checked += assert_blob(pixels, point2D.xy, color)
    assert checked > NUM_FRAMES


def test_a_rig_without_front_face_hangs_on_its_first(tmp_path):
    full = cube_frames(tmp_path / "frames")
    fewer = replace(full.format, faces=full.format.faces[1:])
    frames = replace(full, formats=(fewer,), paths=tuple(paths[1:] for paths in full.paths))
    scene = reconstruction()
    right = np.argmax(scene.observation_bearings, axis=1) == 0
    right &= np.abs(scene.observation_bearings).max(axis=1) == scene.observation_bearings[:, 0]
    scene = observing(scene, right)
    export(scene, frames, tmp_path / "out", ExportFormat.COLMAP)
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    errors = reprojection_errors(model)
    assert len(errors) == right.sum() and errors.max() < 1e-6
    seen_in = {i.name.split("/")[0] for i in model.images.values() if len(i.points2D)}
    assert seen_in == {"right"}


def test_masks_of_captured_faces_are_cut_from_their_panorama(tmp_path):
    frames = cube_frames(tmp_path / "frames", 32)
    mask = np.full((64, 128), 255, np.uint8)
    mask[:, :32] = mask[:, -32:] = 0  # the half that lies behind
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    frames = replace(frames, mask_paths=(tmp_path / "mask.png",) * NUM_FRAMES)
    scene = observing(reconstruction(), np.empty(0, int))
    export(scene, frames, tmp_path / "out", ExportFormat.COLMAP)
    folder = tmp_path / "out" / "masks"
    values = {
        face: cv2.imread(str(folder / face / "frame_0000.png.png"), -1)
        for face in frames.format.faces
    }
    assert sorted(path.name for path in folder.iterdir()) == sorted(frames.format.faces)
    assert values["front"].min() == 255 and values["back"].max() == 0
    assert (values["right"][:, :15] == 255).all() and (values["right"][:, 17:] == 0).all()


def test_cube_frames_have_no_equirectangular_export(tmp_path):
    frames = cube_frames(tmp_path / "frames", 32)
    with pytest.raises(GsbaError, match="use colmap"):
        export(reconstruction(), frames, tmp_path / "out", ExportFormat.COLMAP_ERP)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["frames"]
