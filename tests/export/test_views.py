"""Datasets of faces of one lens each, read back with pycolmap and by nerfstudio's rules."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from export_scene import (
    NUM_FRAMES,
    POINTS,
    assert_blob,
    panoramas,
    reconstruction,
    reprojection_errors,
    seen_by_lenses,
)
from scipy.spatial.transform import Rotation
from synthetic import unit

from gsba.camera.lens import Lenses
from gsba.camera.views import lens_views
from gsba.export import ExportFormat, ExportOptions, export, export_all
from gsba.placement.placement import Placement
from gsba.similarity import Sim3

TWO = Lenses(np.array([0.01, -0.02, 0.2]), band_rad=np.deg2rad(3))
ROWS = np.arange(4)  # of frames
RNG = np.random.default_rng(1)
TURNING = replace(
    TWO,
    inverse_stitch_radius=0.1,
    row_directions=np.array([[1.0, 0, 0], [0, -1.0, 0]]),
    readout_motion=RNG.normal(size=(NUM_FRAMES, 6)) * np.repeat([0.005, 0.0], 3),
    axes=Rotation.from_rotvec(0.3 * RNG.normal(size=(NUM_FRAMES, 3))).as_matrix(),
)
LENSES = {"two centres": TWO, "read row by row, turned below the panorama": TURNING}
SIDES = ("right", "left", "up", "down")
NAMES = {"front", "back", *(f"{side}_{lens}" for side in SIDES for lens in ("front", "back"))}


@pytest.fixture(scope="module", params=LENSES.values(), ids=LENSES)
def written(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory):
    every, folder = request.param, tmp_path_factory.mktemp("lenses")
    frames = panoramas(folder / "frames", masked=True, lenses=every).taken(ROWS)
    lenses, scene = every.taken(ROWS), seen_by_lenses(every).taken(ROWS)
    formats = ExportFormat.COLMAP, ExportFormat.COLMAP_FLAT, ExportFormat.NERFSTUDIO
    options = ExportOptions(lenses=lenses, split=False)
    export_all(scene, frames, {to: folder / to for to in formats}, options)
    return lenses, folder, len(scene.observation_points)


@pytest.mark.parametrize("to", ["colmap", "colmap-flat"])
def test_points_land_on_their_observations_and_pictures(written, to: str) -> None:
    _, folder, num_seen = written
    model, checked, looked = pycolmap.Reconstruction(folder / to / "sparse/0"), 0, 0
    assert reprojection_errors(model).max() < 1e-6
    assert model.num_rigs() == 1 and model.num_cameras() == 10
    for image in model.images.values():
        pixels = cv2.imread(str(folder / to / "images" / image.name))[..., ::-1]
        camera = model.cameras[image.camera_id]
        assert pixels.shape == (camera.height, camera.width, 3)
        for point2D in image.points2D:
            point = model.points3D[point2D.point3D_id]
            looked += assert_blob(pixels, point2D.xy, point.color, camera.params[0])
            checked += 1
    assert checked == num_seen and looked > 0.4 * checked


def test_every_image_has_its_lens_for_centre(written) -> None:
    lenses, folder, _ = written
    model = pycolmap.Reconstruction(folder / "colmap/sparse/0")
    poses, front = reconstruction().world_T_rigs, lenses.centre
    assert {image.name.split("/")[0] for image in model.images.values()} == NAMES
    for image in model.images.values():
        f, view = image.frame_id - 1, image.name.split("/")[0]
        local = front if view.endswith("front") else -front
        local = local if lenses.axes is None else lenses.axes[f] @ local
        expected = poses[f, :3, :3] @ local + poses[f, :3, 3]
        np.testing.assert_allclose(image.projection_center(), expected, atol=1e-9)
    (config,) = pycolmap.read_rig_config(folder / "colmap/rig_config.json")
    for camera_id, camera in enumerate(config.cameras[1:], start=2):
        matrix = model.rigs[1].sensor_from_rig(model.cameras[camera_id].sensor_id).matrix()
        np.testing.assert_allclose(camera.cam_from_rig.matrix(), matrix, atol=1e-12)


@pytest.mark.parametrize("band_deg", [0.0, 4.0, 20.0])
def test_views_hold_all_but_what_is_blended(band_deg: float) -> None:
    lenses, rng = replace(TWO, band_rad=np.deg2rad(band_deg)), np.random.default_rng(0)
    rays = unit(rng.normal(size=(20000, 3)))
    seen = np.zeros(len(rays), bool)
    for view in lens_views(lenses, 200):
        np.testing.assert_allclose(view.rig_R_view.T @ view.rig_R_view, np.eye(3), atol=1e-12)
        assert np.linalg.det(view.rig_R_view) == pytest.approx(1)
        corners = np.array([[0, 0], [view.width, 0], [0, view.height], [view.width, view.height]])
        along = view.rays(corners.astype(float))[:, 2] * np.sign(view.centre[2])
        assert along.min() > np.sin(lenses.band_rad)
        assert view.principal == (view.width / 2, view.height / 2)  # some trainers know no other
        local = rays @ view.rig_R_view
        pixels = view.focal * local[:, :2] / local[:, 2:] + view.principal
        inside = np.all((pixels >= 0) & (pixels <= [view.width, view.height]), axis=1)
        seen |= inside & (local[:, 2] > 0)
    clear = np.abs(rays[:, 2]) > np.sin(np.deg2rad(1.6 * band_deg + 1))
    assert seen[clear].all()


def test_masks_are_cut_alike(written) -> None:
    _, folder, _ = written
    images = sorted((folder / "colmap/images").rglob("*.png"))
    assert len(images) == 10 * len(ROWS)
    shares = {}
    for path in images:
        mask = folder / "colmap/masks" / f"{path.relative_to(folder / 'colmap/images')}.png"
        found = cv2.imread(str(mask), -1)
        assert found.shape == cv2.imread(str(path)).shape[:2]
        shares.setdefault(path.parent.name, []).append((found > 0).mean())
    assert np.mean(shares["up_front"]) > 0.9 and np.mean(shares["down_back"]) < 0.5


def test_nerfstudio_has_each_views_own_lengths_and_place(written) -> None:
    _, folder, _ = written
    meta = json.loads((folder / "nerfstudio/transforms.json").read_text())
    world = np.array(meta["applied_transform"])[:, :3]
    model = pycolmap.Reconstruction(folder / "colmap/sparse/0")
    images = {image.name: image for image in model.images.values()}
    assert len(meta["frames"]) == 10 * len(ROWS)
    assert not {"fl_x", "fl_y", "cx", "cy", "w", "h"} & set(meta)  # taken for all frames else
    for entry in meta["frames"]:
        name, view = Path(entry["file_path"]).stem.split("_", 2)[1:]
        image = images[f"{view}/frame_{name}.png"]
        camera = model.cameras[image.camera_id]
        assert (entry["w"], entry["h"]) == (camera.width, camera.height)
        params = [entry[key] for key in ("fl_x", "fl_y", "cx", "cy")]
        np.testing.assert_allclose(params, camera.params)
        matrix = np.array(entry["transform_matrix"])
        np.testing.assert_allclose(matrix[:3, 3], world @ image.projection_center(), atol=1e-9)
        axes = world @ image.cam_from_world().matrix()[:, :3].T @ np.diag([1.0, -1, -1])
        np.testing.assert_allclose(matrix[:3, :3], axes, atol=1e-9)


def test_a_placed_world_takes_the_lenses_along(tmp_path: Path) -> None:
    frames = panoramas(tmp_path / "frames", lenses=TWO)
    turn = Rotation.from_rotvec([0.3, 0.2, -1.0]).as_matrix()
    placement = Placement(Sim3(3.0, turn, np.array([1.0, 2, 3])))
    seen = seen_by_lenses(TWO)
    export(seen, frames, tmp_path / "out", ExportFormat.COLMAP, 64, placement, lenses=TWO)
    model = pycolmap.Reconstruction(tmp_path / "out/sparse/0")
    placed = 3 * POINTS @ turn.T + [1, 2, 3]
    assert reprojection_errors(model).max() < 1e-6
    for number, point in model.points3D.items():
        np.testing.assert_allclose(point.xyz, placed[number - 1])
