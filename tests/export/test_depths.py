"""Depths of points in exported faces, read by the rules of the programs that use them."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from export_scene import HEIGHT, NUM_FRAMES, POINTS, WIDTH, exported, panoramas, reconstruction
from scipy.spatial.transform import Rotation
from synthetic import unit

from gsba.bundle.point_covariances import depth_variances, point_covariances
from gsba.export import ExportFormat, export
from gsba.export.photos import PhotoCamera, Photos, PlacedPhoto
from gsba.export.trainers import how_to_start
from gsba.geometry import inverse
from gsba.log import GsbaError
from gsba.types import JointErrors, Reconstruction


def _nerfstudio_map(path: Path, width: int, height: int, scale_factor: float = 1e-3) -> np.ndarray:
    """Depth map as nerfstudio 1.1.5 reads it (`get_depth_image_from_path`), in map units."""
    image = cv2.imread(str(path), cv2.IMREAD_ANYDEPTH)
    image = image.astype(np.float32) * scale_factor
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_NEAREST)


def test_nerfstudio_reads_the_depth_of_each_point(tmp_path: Path) -> None:
    out = exported(tmp_path, ExportFormat.NERFSTUDIO, 96, depths=True)
    meta = json.loads((out / "transforms.json").read_text())
    world = np.array(meta["applied_transform"])[:, :3]
    found = 0
    for entry in meta["frames"]:
        depths = _nerfstudio_map(out / entry["depth_file_path"], meta["w"], meta["h"])
        local = np.column_stack([POINTS @ world.T, np.ones(len(POINTS))])
        local = local @ inverse(np.array(entry["transform_matrix"]))[:3].T
        u = meta["cx"] - meta["fl_x"] * local[:, 0] / local[:, 2]
        v = meta["cy"] + meta["fl_y"] * local[:, 1] / local[:, 2]
        rows, columns = np.nonzero(depths)
        for row, column in zip(rows, columns, strict=True):
            off = np.hypot(u - column - 0.5, v - row - 0.5)
            (point,) = np.flatnonzero((off <= np.sqrt(0.5)) & (local[:, 2] < 0))
            assert depths[row, column] == pytest.approx(-local[point, 2], rel=1e-6)
        found += len(rows)
    assert found == len(POINTS) * NUM_FRAMES  # each in one face of each frame
    assert "depth-nerfacto" in how_to_start("nerfstudio", out)[-1]
    assert how_to_start("instant-ngp", out)[-1] == "instant-ngp reads none of the depths"


@pytest.mark.parametrize("to", ["colmap", "colmap-flat"])
def test_depths_beside_a_colmap_model_are_those_of_its_points(to: str, tmp_path: Path) -> None:
    """Of each image of the model, the same points in the same pixels as in images.bin."""
    out = exported(tmp_path, ExportFormat(to), 64, depths=True)
    model = pycolmap.Reconstruction(out / "sparse/0")
    files = {
        path.relative_to(out / "sparse_depths") for path in out.rglob("sparse_depths/**/*.npz")
    }
    assert files == {Path(image.name).with_suffix(".npz") for image in model.images.values()}
    assert not (out / "depths").exists()
    for image in model.images.values():
        with np.load(out / "sparse_depths" / Path(image.name).with_suffix(".npz")) as seen:
            told = {int(point): row for row, point in enumerate(seen["point"])}
            keypoints = [p for p in image.points2D if p.has_point3D()]
            assert sorted(told) == sorted(p.point3D_id - 1 for p in keypoints)
            for keypoint in keypoints:
                row = told[keypoint.point3D_id - 1]
                local = image.cam_from_world() * model.points3D[keypoint.point3D_id].xyz
                np.testing.assert_allclose(seen["uv"][row], keypoint.xy, atol=1e-4)
                assert seen["depth"][row] == pytest.approx(local[2], rel=1e-6)
                assert 0 < seen["sigma"][row] < 0.1 * local[2]


def test_standard_deviations_of_points_are_those_of_their_errors() -> None:
    """Points estimated from noisy bearings: errors over standard deviations have variance 1."""
    rng, sigma = np.random.default_rng(0), 2e-3
    points, frames, numbers, rays = _many(rng, 40, 0.5, 3)
    noise = rng.normal(0, sigma, rays.shape)
    estimated = _estimated(points, frames, numbers, rays, noise, sigma)
    deviations = np.linalg.cholesky(np.linalg.inv(point_covariances(estimated)))
    whitened = np.einsum("jba,jb->ja", deviations, estimated.points_world - points)
    # 1080 numbers: the standard deviation of their mean square is 0.043.
    assert np.mean(whitened**2) == pytest.approx(1, abs=0.17)


def test_errors_of_poses_are_errors_of_depths() -> None:
    """Points triangulated from exact rays by poses in error, seen from these poses."""
    scene, rng = reconstruction(), np.random.default_rng(1)
    points, poses = scene.points_world, scene.world_T_rigs
    numbers, frames = scene.observation_points, scene.observation_frames
    draws = rng.normal(0, 1e-3, (16, NUM_FRAMES, 6)) * [1, 1, 1, 5, 5, 5]
    draws[:, :, 3:] += 0.02 * (poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0))  # a wrong scale
    axes, errors = poses[frames, :3, 2], []
    for draw in draws:
        moved = poses.copy()
        moved[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(draw[:, :3]).as_matrix()
        moved[:, :3, 3] += np.einsum("fij,fj->fi", poses[:, :3, :3], draw[:, 3:])
        rays = np.einsum("oij,oj->oi", moved[frames][:, :3, :3], scene.observation_bearings)
        found = _triangulated(moved[frames, :3, 3], rays, numbers, points)
        around = poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)
        scale = np.sum(around * (moved - poses)[:, :3, 3]) / np.sum(around**2)
        depths = np.einsum("oi,oi->o", moved[frames, :3, 2], found[numbers] - moved[frames, :3, 3])
        expected = np.einsum("oi,oi->o", axes, points[numbers] - poses[frames, :3, 3])
        errors.append(depths - expected * (1 + scale))
    joint = JointErrors(np.zeros((NUM_FRAMES - 1, 6, 6)), draws.astype(np.float32))
    exact = _observed(scene, numbers, frames, scene.observation_bearings, 1e-7)
    alone = depth_variances(exact, axes)
    found = depth_variances(replace(exact, joint_errors=joint), axes)
    assert alone.max() < 1e-4 * found.min()
    np.testing.assert_allclose(np.sqrt(found), np.sqrt(np.mean(np.square(errors), 0)), rtol=0.1)


@pytest.mark.parametrize("shift", [0.0, 0.01])
def test_shifts_that_grow_along_tracks_are_errors_of_depths(shift: float) -> None:
    """Observations of each point are shifted in proportion to the change of its viewing direction,
    as patches that show other surfaces, too: errors are then many times those of independent noise.
    They stay as far below `sigma`, for these shifts are as large across baselines as along."""
    rng, sigma = np.random.default_rng(0), 1e-4
    points, frames, numbers, rays = _many(rng, 80, 0.8, 1.25)
    means = rays.reshape(len(points), NUM_FRAMES, 3).mean(axis=1)
    turns = rng.normal(0, shift, (len(points), 3, 3))[numbers]
    moved = np.einsum("oij,oj->oi", turns, rays - means[numbers])
    moved += rng.normal(0, sigma, rays.shape)
    estimated = _estimated(points, frames, numbers, rays, moved, sigma)
    axes = estimated.world_T_rigs[frames, :3, 2]
    errors = np.sum(axes * (estimated.points_world - points)[numbers], axis=1)
    alone = np.einsum("oi,oij,oj->o", axes, point_covariances(estimated)[numbers], axes)
    off = np.median(np.abs(errors) / np.sqrt(depth_variances(estimated, axes))) / 0.6745
    assert off == pytest.approx(1 / 1.8, rel=0.2)
    assert (np.median(np.abs(errors) / np.sqrt(alone)) > 5) == (shift > 0)


def _many(
    rng: np.random.Generator, copies: int, nearest: float, farthest: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The scene's points many times at other distances; frame, point and ray of each sighting."""
    scene = reconstruction()
    num = copies * len(POINTS)
    points = np.tile(scene.points_world, (copies, 1)) * rng.uniform(nearest, farthest, (num, 1))
    frames = np.tile(np.arange(NUM_FRAMES, dtype=np.int32), num)
    numbers = np.repeat(np.arange(num, dtype=np.int32), NUM_FRAMES)
    rays = unit(points[numbers] - scene.world_T_rigs[frames, :3, 3])
    return points, frames, numbers, rays


def _estimated(
    points: np.ndarray,
    frames: np.ndarray,
    numbers: np.ndarray,
    rays: np.ndarray,
    errors: np.ndarray,
    sigma: float,
) -> Reconstruction:
    """A map of points that are triangulated from rays in error."""
    scene = reconstruction()
    poses = scene.world_T_rigs[frames]
    noisy = unit(rays + errors - np.sum(errors * rays, axis=1, keepdims=True) * rays)
    found = _triangulated(poses[:, :3, 3], noisy, numbers, points)
    bearings = np.einsum("oji,oj->oi", poses[:, :3, :3], noisy)
    return replace(_observed(scene, numbers, frames, bearings, sigma), points_world=found)


def _observed(
    scene: Reconstruction,
    points: np.ndarray,
    frames: np.ndarray,
    bearings: np.ndarray,
    sigma: float,
) -> Reconstruction:
    sigmas = np.full(len(points), sigma)
    return replace(
        scene,
        observation_points=points,
        observation_frames=frames,
        observation_bearings=bearings,
        observation_sigmas=sigmas,
    )


def _triangulated(
    centres: np.ndarray, rays: np.ndarray, numbers: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Points (J, 3) nearest to their rays by angle: weighted distances, from true depths."""
    reaches = np.linalg.norm(points[numbers] - centres, axis=1)
    across = (np.eye(3) - rays[:, :, None] * rays[:, None]) / np.square(reaches)[:, None, None]
    left, right = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    np.add.at(left, numbers, across)
    np.add.at(right, numbers, np.einsum("oij,oj->oi", across, centres))
    return np.linalg.solve(left, right[..., None])[..., 0]


def test_uncertain_depths_are_in_no_map(tmp_path: Path) -> None:
    scene = reconstruction()
    scene.observation_sigmas[scene.observation_points == 4] = 1.0  # radians
    frames, out = panoramas(tmp_path / "frames"), tmp_path / "out"
    export(scene, frames, out, ExportFormat.NERFSTUDIO, 64, depths=True)
    mapped = sum(
        np.count_nonzero(_nerfstudio_map(path, 64, 64)) for path in (out / "depths").iterdir()
    )
    assert mapped == (len(POINTS) - 1) * NUM_FRAMES
    listed = sum(len(np.load(path)["depth"]) for path in (out / "sparse_depths").iterdir())
    assert listed == len(POINTS) * NUM_FRAMES


def test_a_photo_has_an_empty_depth_map(tmp_path: Path) -> None:
    """nerfstudio wants depth maps of all images or of none."""
    frames, out = panoramas(tmp_path / "frames"), tmp_path / "out"
    camera = PhotoCamera(80, 60, 70.0, (40.0, 30.0), (0.0, 0.0))
    cv2.imwrite(str(tmp_path / "p.jpg"), np.zeros((60, 80, 3), np.uint8))
    photos = Photos((PlacedPhoto("p", tmp_path / "p.jpg", np.eye(4), 0),), (camera,))
    to = ExportFormat.NERFSTUDIO
    export(reconstruction(), frames, out, to, 64, depths=True, photos=photos)
    entries = json.loads((out / "transforms.json").read_text())["frames"]
    assert all("depth_file_path" in entry for entry in entries)
    assert not _nerfstudio_map(out / entries[-1]["depth_file_path"], 80, 60).any()


@pytest.mark.parametrize(("to", "images"), [("nerfstudio", "panorama"), ("gltf", "auto")])
def test_depths_are_those_of_faces(to: str, images: str, tmp_path: Path) -> None:
    frames, out = panoramas(tmp_path / "frames"), tmp_path / "out"
    assert (frames.format.width, frames.format.height) == (WIDTH, HEIGHT)
    with pytest.raises(GsbaError, match=f"depths are those of cube faces in colmap.*not of {to}"):
        export(reconstruction(), frames, out, ExportFormat(to), images=images, depths=True)
    assert not out.exists()
