"""Panoramas at the depth of the map, and raw fisheyes, as trainers and pycolmap read them."""

import csv
import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from export_scene import (
    NUM_FRAMES,
    POINTS,
    assert_blob,
    bearings,
    cube_frames,
    moved_by_velocities,
    panoramas,
    picture,
    poses,
    reconstruction,
    seen_by_lenses,
)
from pixels import pixel_centres
from plain_records import frames_of
from scipy.spatial.transform import Rotation, Slerp
from synthetic import unit
from two_fisheyes import made_pair

from gsba.camera.fisheye import project, unproject
from gsba.camera.lens import Lenses, rows_run
from gsba.disk import write_image
from gsba.export import ExportFormat, Shutter, export, sensors
from gsba.export.dataset import MaskStyle
from gsba.geometry import inverse, pose
from gsba.log import GsbaError
from gsba.trajectory.files import read_trajectory
from gsba.types import FrameSet, PictureFormat

TWO = Lenses(np.array([0.01, -0.02, 0.2]), band_rad=np.deg2rad(3))
TURNED = replace(TWO, axes=Rotation.from_rotvec(0.3 * np.eye(3)).as_matrix().repeat(3, axis=0))
PAIR = made_pair(240)
TWISTS = np.random.default_rng(1).normal(size=(NUM_FRAMES, 6)) * np.repeat([0.02, 0.05], 3)
RAW = Lenses(
    np.array([0.01, -0.02, 0.2]),
    band_rad=np.deg2rad(1.5),
    row_directions=np.array([[1.0], [-1.0]]) * rows_run(PAIR),
    readout_motion=TWISTS,
    reference_calibration=PAIR,
)
ROWS = np.arange(4)  # of frames, where a few are as good as all
PANORAMAS = {"two centres": TWO, "turned below the panorama": TURNED}


def _local() -> np.ndarray:
    """POINTS in the rig frames, (F, J, 3)."""
    return (POINTS - poses()[:, None, :3, 3]) @ poses()[:, :3, :3]


_scene = partial(seen_by_lenses, band_rad=0.05)  # points that are not at the seam


def _raw_frames(folder: Path) -> FrameSet:
    """Pictures of both lenses, rows at their times."""
    names, paths = tuple(f"frame_{f:04d}" for f in range(NUM_FRAMES)), []
    for f, name in enumerate(names):
        of_frame = []
        for number, lens in enumerate(PAIR):
            frames, of_lens = np.full(len(POINTS), f), np.full(len(POINTS), number)
            seen = unit(RAW.seeing(_local()[f], frames, of_lens))
            pixels = pixel_centres(240, 240)
            path = folder / ("front", "back")[number] / f"{name}.png"
            write_image(path, picture(unproject(lens, pixels), seen))
            of_frame.append(path)
        paths.append(tuple(of_frame))
    form = PictureFormat("erp", 512, 256, fisheyes=PAIR)
    return frames_of(form, paths, np.arange(NUM_FRAMES) * 0.5, names)


def _check_erp(image: np.ndarray, lenses: Lenses, f: int) -> int:
    """Blobs of POINTS lie where one camera in the middle has them; returns how many were."""
    seen = bearings(poses())[f]
    clear = ~replace(lenses, band_rad=0.2).blended(seen, np.full(len(seen), f))
    x, y, z = seen.T
    pixels = [512 * (0.5 + np.arctan2(x, z) / (2 * np.pi)), 256 * (0.5 + np.arcsin(y) / np.pi)]
    level = (np.abs(y) < 0.5) & clear  # blobs are round there, and whole
    colors = reconstruction().point_colors
    rows = zip(np.transpose(pixels)[level], colors[level], strict=True)
    return sum(assert_blob(image, pixel, color, 512 / (2 * np.pi)) for pixel, color in rows)


@pytest.mark.parametrize("name", [*PANORAMAS, "raw"])
def test_things_lie_where_one_camera_has_them(name: str, tmp_path: Path) -> None:
    lenses = PANORAMAS.get(name, RAW)
    frames = _raw_frames(tmp_path) if name == "raw" else panoramas(tmp_path, lenses=lenses)
    scene, frames, to = _scene(lenses).taken(ROWS), frames.taken(ROWS), ExportFormat.COLMAP_ERP
    lenses = lenses.taken(ROWS)
    export(scene, frames, tmp_path / "out", to, lenses=lenses, images="panorama")
    model = pycolmap.Reconstruction(tmp_path / "out/sparse/0")
    assert model.num_cameras() == 1 and model.num_images() == len(ROWS)
    assert model.compute_mean_reprojection_error() < 1e-4
    looked = 0
    for image in model.images.values():
        f = image.frame_id - 1
        pixels = _image(tmp_path / "out/images" / image.name)
        np.testing.assert_allclose(image.projection_center(), poses()[f, :3, 3], atol=1e-9)
        looked += _check_erp(pixels, lenses, f)
    assert looked > 2 * len(ROWS)


def test_all_formats_hold_the_same_panoramas(tmp_path: Path) -> None:
    frames = panoramas(tmp_path / "frames", masked=True, lenses=TWO).taken(ROWS)
    for to in (ExportFormat.COLMAP_ERP, ExportFormat.NERFSTUDIO, ExportFormat.TUM):
        export(_scene(TWO).taken(ROWS), frames, tmp_path / to, to, lenses=TWO, images="panorama")
    meta = json.loads((tmp_path / "nerfstudio/transforms.json").read_text())
    assert meta["camera_model"] == "EQUIRECTANGULAR" and (meta["w"], meta["h"]) == (512, 256)
    assert len(meta["frames"]) == len(ROWS)
    for entry in meta["frames"]:
        name = Path(entry["file_path"]).name
        exported = (tmp_path / "nerfstudio" / entry["file_path"]).read_bytes()
        mask = (tmp_path / "nerfstudio" / entry["mask_path"]).read_bytes()
        for other in ("colmap-erp", "tum"):
            assert (tmp_path / other / "images" / name).read_bytes() == exported
        assert (tmp_path / "colmap-erp/masks" / f"{name}.png").read_bytes() == mask
    rows = list(csv.reader((tmp_path / "tum/images/timestamps.csv").open()))
    assert rows[0] == ["name", "timestamp"] and len(rows) == len(ROWS) + 1
    kept = read_trajectory(tmp_path / "tum/trajectory.tum")
    np.testing.assert_allclose(kept.world_T_rigs, poses()[ROWS], atol=1e-6)
    np.testing.assert_allclose(kept.timestamps, [float(row[1]) for row in rows[1:]])


def test_panoramas_of_one_centre_go_out_as_they_are(tmp_path: Path) -> None:
    frames = panoramas(tmp_path / "frames")
    export(reconstruction(), frames, tmp_path / "out", ExportFormat.TUM, images="panorama")
    for (source,) in frames.paths:
        assert (tmp_path / "out/images" / source.name).read_bytes() == source.read_bytes()


def test_what_has_no_place_for_images_is_refused(tmp_path: Path) -> None:
    frames = panoramas(tmp_path / "frames")
    for to, images in (("colmap", "panorama"), ("ply", "panorama"), ("tum", "fisheye")):
        with pytest.raises(GsbaError, match=f"{images} goes with .*, not with {to}"):
            export(reconstruction(), frames, tmp_path / "out", ExportFormat(to), images=images)
    with pytest.raises(GsbaError, match="needs panoramas"):
        cubes = cube_frames(tmp_path / "cube", 32)
        export(reconstruction(), cubes, tmp_path / "out", ExportFormat.TUM, images="panorama")
    with pytest.raises(GsbaError, match="stitched"):
        to = ExportFormat.NERFSTUDIO
        export(reconstruction(), frames, tmp_path / "out", to, lenses=TWO, images="fisheye")
    assert not (tmp_path / "out").exists()


def _between(start: np.ndarray, end: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) at shares (N,) of the way: places on a line, turns on an arc."""
    turns = Slerp([0, 1], Rotation.from_matrix([start[:3, :3], end[:3, :3]]))
    return pose(turns(shares).as_matrix(), start[:3, 3] + np.outer(shares, (end - start)[:3, 3]))


def _image(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return image if image.ndim == 2 else image[..., ::-1]


def test_rows_of_raw_fisheyes_have_their_poses(tmp_path: Path) -> None:
    frames = _raw_frames(tmp_path / "frames")
    to = ExportFormat.NERFSTUDIO
    shutter = Shutter(readout_s=0.02)
    export(_scene(RAW), frames, tmp_path / "out", to, lenses=RAW, images="fisheye", shutter=shutter)
    meta = json.loads((tmp_path / "out/transforms.json").read_text())
    assert meta["rolling_shutter_time"] == 0.02
    assert meta["camera_model"] == "OPENCV_FISHEYE" and meta["rolling_shutter"] == [0, 0, 1, 0]
    assert not {"fl_x", "cx", "w", "k1"} & set(meta)  # nerfstudio would take them for all frames
    assert meta["aabb_scale"] == 1 and all(entry["is_fisheye"] for entry in meta["frames"])
    points = POINTS @ np.array(meta["applied_transform"])[:, :3].T
    assert len(meta["frames"]) == 2 * NUM_FRAMES
    looked, moved = 0, 0.0
    for index, entry in enumerate(meta["frames"]):
        f, number = divmod(index, 2)
        lens, lengths = PAIR[number], ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4")
        camera = pycolmap.Camera(
            model="OPENCV_FISHEYE", width=240, height=240, params=[entry[key] for key in lengths]
        )
        image, mask = (_image(tmp_path / "out" / entry[key]) for key in ("file_path", "mask_path"))
        of_lens = np.full(len(POINTS), number)
        shown = RAW.seeing(_local()[f], np.full(len(POINTS), f), of_lens)
        ahead = shown @ Rotation.from_rotvec(lens.rotation).as_matrix()[:, 2]
        facing = np.flatnonzero(ahead > 0.1 * np.linalg.norm(shown, axis=1))
        expected = project(lens, shown[facing])
        middle, start, end = (
            np.array(entry[f"transform_matrix{when}"]) @ np.diag([1.0, -1, -1, 1])
            for when in ("", "_start", "_end")  # y down, z forward
        )
        for edge, sign in ((start, -1), (end, 1)):  # velocities say the same as these poses, but
            # for the arc of a lens about the rig's centre, which is of second order in the turn
            row = moved_by_velocities(entry, sign * 0.01) @ np.diag([1.0, -1, -1, 1])
            np.testing.assert_allclose(row, edge, atol=2e-4)
        shares = np.floor(expected[:, 1]) / (entry["h"] - 1)
        cameras_T_world = {
            "instant-ngp": inverse(_between(start, end, expected[:, 1] / entry["h"])),
            "gsplat": _between(inverse(start), inverse(end), shares),
            "nerfstudio": np.tile(inverse(middle), (len(facing), 1, 1)),
        }
        off = {}
        for name, matrices in cameras_T_world.items():
            local = np.einsum("nij,nj->ni", matrices[:, :3, :3], points[facing])
            found = camera.img_from_cam(local + matrices[:, :3, 3])
            off[name] = np.abs(found - expected).max()
        assert off["instant-ngp"] < 0.01 and off["gsplat"] < 0.03
        moved = max(moved, off["nerfstudio"])
        for j, pixel in zip(facing, expected, strict=True):
            if mask[tuple(np.floor(pixel[::-1]).astype(int))]:
                looked += assert_blob(image, pixel, reconstruction().point_colors[j], entry["fl_x"])
        assert mask[0, 0] == 0 and mask[120, 120] == 255
    assert looked > 6 * NUM_FRAMES and moved > 0.5


def test_colmap_holds_nothing_beyond_a_right_angle_of_a_lens(tmp_path: Path) -> None:
    """COLMAP's fisheye cameras give no ray there, or a wrong one."""
    frames, to = _raw_frames(tmp_path / "frames"), ExportFormat.COLMAP_FLAT
    export(_scene(RAW), frames, tmp_path / "out", to, lenses=RAW, images="fisheye", split=False)
    model = pycolmap.Reconstruction(tmp_path / "out/sparse/0")
    for image in list(model.images.values())[:2]:
        camera = model.cameras[image.camera_id]
        rows, columns = np.nonzero(_image(tmp_path / "out/masks" / f"{image.name[:-4]}.png"))
        pixels = np.column_stack([columns, rows])[::97] + 0.5
        rays = np.column_stack([camera.cam_from_img(pixels), np.ones(len(pixels))])
        assert np.isfinite(rays).all() and len(rays) > 100
        np.testing.assert_allclose(camera.img_from_cam(rays), pixels, atol=1e-3)
    axis = Rotation.from_rotvec(PAIR[0].rotation).as_matrix()[:, 2]
    angles = np.deg2rad([[88.0], [92.0]])
    aside = np.cross(axis, [0.0, 1.0, 0.0])
    bearings_rig = np.cos(angles) * axis + np.sin(angles) * aside / np.linalg.norm(aside)
    own = sensors.raw_sensors(frames.formats[0], RAW)
    which, _ = sensors._project_raw(own, bearings_rig, np.tile(RAW.centres[0], (2, 1)))
    assert which.tolist() == [0, -1]


def test_raw_lenses_are_painted_where_masks_hide(tmp_path: Path) -> None:
    frames, to, masks = (
        _raw_frames(tmp_path / "frames"),
        ExportFormat.NERFSTUDIO,
        MaskStyle("alpha"),
    )
    export(_scene(RAW), frames, tmp_path / "out", to, lenses=RAW, images="fisheye", masks=masks)
    entry = json.loads((tmp_path / "out/transforms.json").read_text())["frames"][0]
    shown = cv2.imread(str(tmp_path / "out" / entry["file_path"]), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(shown[..., 3], _image(tmp_path / "out" / entry["mask_path"]))
    assert (shown[0, 0] == 0).all() and shown[120, 120, 3] == 255
