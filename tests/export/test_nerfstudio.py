"""nerfstudio exports, read by the rules its documentation and data parser state."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from export_scene import (
    COLORS,
    NUM_FRAMES,
    POINTS,
    assert_blob,
    cube_frames,
    panoramas,
    reconstruction,
)
from plyfile import PlyData
from synthetic import unit

from gsba.export import ExportFormat, export
from gsba.types import FACES, PoseStatus


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("nerfstudio")
    frames = panoramas(folder / "frames", ".jpg", masked=True)
    export(reconstruction(), frames, folder / "out", ExportFormat.NERFSTUDIO)
    return folder / "out"


def _meta(dataset, name="transforms.json"):
    return json.loads((dataset / name).read_text())


def _cloud(dataset, meta):
    vertex = PlyData.read(dataset / meta["ply_file_path"])["vertex"]
    xyz = np.column_stack([vertex["x"], vertex["y"], vertex["z"]]).astype(np.float64)
    return xyz, np.column_stack([vertex["red"], vertex["green"], vertex["blue"]])


def _pinhole_pixels(meta, matrix, points):
    """Pixels (J, 2), corner origin, and depths (J,) by nerfstudio's ray rule, solved for u, v.

    The ray of (u, v) is ((u - cx) / fl_x, -(v - cy) / fl_y, -1) in camera axes y up, z backward.
    """
    local = (points - matrix[:3, 3]) @ matrix[:3, :3]
    depths = -local[:, 2]
    u = meta["cx"] + meta["fl_x"] * local[:, 0] / depths
    v = meta["cy"] - meta["fl_y"] * local[:, 1] / depths
    return np.column_stack([u, v]), depths


def _erp_rays(meta, matrix, pixels):
    """World rays (N, 3) of pixels (N, 2) by nerfstudio's equirectangular rule."""
    x = (pixels[:, 0] - meta["cx"]) / meta["fl_x"]
    y = -(pixels[:, 1] - meta["cy"]) / meta["fl_y"]
    theta, phi = -np.pi * x, np.pi * (0.5 - y)
    rays = [-np.sin(theta) * np.sin(phi), np.cos(phi), -np.cos(theta) * np.sin(phi)]
    return np.column_stack(rays) @ matrix[:3, :3].T


def test_the_applied_transform_takes_our_world_to_theirs(dataset):
    scene = reconstruction()
    for name in ("transforms.json", "transforms_erp.json"):
        meta = _meta(dataset, name)
        applied = np.array(meta["applied_transform"])
        assert applied.shape == (3, 4) and np.linalg.det(applied[:, :3]) == pytest.approx(1)
        assert np.array_equal(applied[:, :3] @ [0, -1, 0], [0, 0, 1])  # up is +z
        xyz, colors = _cloud(dataset, meta)
        assert np.allclose(xyz, POINTS @ applied[:, :3].T, atol=1e-6)  # float32
        assert np.array_equal(colors, COLORS)
        per_frame = len(meta["frames"]) // NUM_FRAMES
        for index, frame in enumerate(meta["frames"]):
            centre = np.array(frame["transform_matrix"])[:3, 3]
            world_T_rig = scene.world_T_rigs[index // per_frame]
            assert np.allclose(centre, applied[:, :3] @ world_T_rig[:3, 3], atol=1e-12)


def test_points_land_on_their_pixels_in_pinhole_faces(dataset):
    meta = _meta(dataset)
    assert (meta["w"], meta["h"]) == (128, 128)
    assert [meta[k] for k in ("k1", "k2", "p1", "p2")] == [0, 0, 0, 0]
    points = POINTS @ np.array(meta["applied_transform"])[:, :3].T
    expected = reconstruction().observation_bearings.reshape(len(POINTS), NUM_FRAMES, 3)
    assert len(meta["frames"]) == 6 * NUM_FRAMES
    looked, seen = 0, 0
    for index, frame in enumerate(meta["frames"]):
        f, face = divmod(index, 6)
        matrix = np.array(frame["transform_matrix"])
        assert np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-12)
        pixels, depths = _pinhole_pixels(meta, matrix, points)
        inside = (depths > 0) & (pixels > 0).all(axis=1) & (pixels < 128).all(axis=1)
        image = cv2.imread(str(dataset / frame["file_path"]))[..., ::-1]
        assert image.shape == (128, 128, 3)
        for j in np.flatnonzero(inside):
            rig_axis = {"front": 2, "right": 0, "back": 2, "left": 0, "up": 1, "down": 1}
            assert np.argmax(np.abs(expected[j, f])) == rig_axis[FACES[face]]
            seen += assert_blob(image, pixels[j], COLORS[j])
            looked += 1
    assert looked == NUM_FRAMES * len(POINTS) and seen > looked / 2


def test_points_land_on_their_pixels_in_panoramas(dataset):
    meta = _meta(dataset, "transforms_erp.json")
    assert meta["camera_model"] == "EQUIRECTANGULAR"
    sizes = [meta[k] for k in ("w", "h", "fl_x", "fl_y", "cx", "cy")]
    assert sizes == [512, 256, 256, 256, 256, 128]
    points = POINTS @ np.array(meta["applied_transform"])[:, :3].T
    bearings = reconstruction().observation_bearings.reshape(len(POINTS), NUM_FRAMES, 3)
    x, y, z = np.moveaxis(bearings, -1, 0)
    u = 512 * (0.5 + np.arctan2(x, z) / (2 * np.pi))
    v = 256 * (0.5 + np.arcsin(y) / np.pi)
    for f, frame in enumerate(meta["frames"]):
        matrix = np.array(frame["transform_matrix"])
        rays = _erp_rays(meta, matrix, np.column_stack([u[:, f], v[:, f]]))
        towards = unit(points - matrix[:3, 3])
        assert np.abs(rays - towards).max() < 1e-8  # a millionth of a pixel
        image = cv2.imread(str(dataset / frame["file_path"]))
        assert image.shape == (256, 512, 3)


def test_base_names_are_unique_and_every_frame_has_a_mask(dataset):
    for name in ("transforms.json", "transforms_erp.json"):
        frames = _meta(dataset, name)["frames"]
        assert len({frame["file_path"].rsplit("/", 1)[1] for frame in frames}) == len(frames)
        for frame in frames:
            mask = cv2.imread(str(dataset / frame["mask_path"]), -1)
            image = cv2.imread(str(dataset / frame["file_path"]))
            assert mask.shape == image.shape[:2] and set(np.unique(mask)) <= {0, 255}


@pytest.mark.parametrize("name", ["transforms.json", "transforms_erp.json"])
def test_whole_panoramas_are_held_out(dataset, name):
    meta = _meta(dataset, name)
    everything = [frame["file_path"] for frame in meta["frames"]]
    assert sorted(meta["train_filenames"] + meta["val_filenames"]) == sorted(everything)
    whole = len(everything) // NUM_FRAMES
    assert meta["val_filenames"] == meta["test_filenames"]
    assert (
        meta["val_filenames"]
        == everything[2 * whole : 3 * whole] + everything[6 * whole : 7 * whole]
    )


def test_frames_without_masks_get_white_ones_where_others_have_some(tmp_path):
    frames = panoramas(tmp_path / "frames", masked=True)
    frames = replace(frames, mask_paths=(None, *frames.mask_paths[1:]))
    export(reconstruction(), frames, tmp_path / "out", ExportFormat.NERFSTUDIO, face_size=32)
    masks = [
        cv2.imread(str(tmp_path / "out" / frame["mask_path"]), -1)
        for frame in _meta(tmp_path / "out")["frames"]
    ]
    assert all(mask.min() == 255 for mask in masks[:6])
    assert any(mask.min() == 0 for mask in masks[6:])


def test_cube_frames_give_faces_alone(tmp_path):
    frames = cube_frames(tmp_path / "frames", 64)
    export(reconstruction(), frames, tmp_path / "out", ExportFormat.NERFSTUDIO)
    meta = _meta(tmp_path / "out")
    assert len(meta["frames"]) == 4 * NUM_FRAMES and "mask_path" not in meta["frames"][0]
    assert not (tmp_path / "out" / "transforms_erp.json").exists()
    assert not (tmp_path / "out" / "masks").exists()


def test_unrefined_frames_go_out_with_a_warning(tmp_path, caplog):
    frames = panoramas(tmp_path / "frames")
    scene = reconstruction()
    statuses = scene.pose_statuses.copy()
    statuses[3] = PoseStatus.UNREFINED
    export(replace(scene, pose_statuses=statuses), frames, tmp_path / "out", ExportFormat.TUM)
    assert "frame_0003" in caplog.text
