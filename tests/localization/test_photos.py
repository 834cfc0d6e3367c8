"""Rendered photos of a tiny walk, localised in its finished run; tags and pixels of photos."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from one_gallery import gallery
from PIL import Image
from pixels import pixel_centres
from scipy.spatial.transform import Rotation
from tiny_run import Case

from gsba import Localizer
from gsba.camera.projections import PerspectiveProjection
from gsba.camera.rig import CubeRig
from gsba.camera.sphere import bearings_from_erp, erp_from_bearings
from gsba.config import FeatureSettings
from gsba.demo.render import render_erp
from gsba.features import SiftExtractor
from gsba.geometry import rotation_angle
from gsba.localization import localize_photos, read_photo
from gsba.localization.photos import Photo, as_panorama, photo_features, photo_rig
from gsba.similarity import pose_similarity
from gsba.trajectory.files import read_trajectory

CAMERA = PerspectiveProjection(640, 480, 430.0, (323.0, 238.0), (-0.03, 0.01))
SMALL = PerspectiveProjection(320, 240, 215.0, (161.5, 119.0), (-0.03, 0.01))
UPRIGHT = PerspectiveProjection(240, 320, 150.0, (120.5, 161.0), (0.02, 0.0))  # 94 degrees high
_WIDTH = 768  # pixels of the panoramas that photos are cut from


@pytest.fixture(scope="module")
def taken(case: Case, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """Folder of photos, and their true poses and cameras by name."""
    folder, truth = tmp_path_factory.mktemp("photos"), {}
    rng, scene = np.random.default_rng(1), gallery()
    for n, (frame, yaw, camera) in enumerate([(2, 20, SMALL), (4, 110, SMALL), (3, 300, UPRIGHT)]):
        pose = case.truth.world_T_rigs[frame].copy()
        turn = Rotation.from_euler("yx", [yaw, -5], degrees=True)
        pose[:3, :3] = pose[:3, :3] @ turn.as_matrix()
        pose[:3, 3] += rng.normal(0, 0.08, 3)
        image = _photographed(scene, pose, camera, rng)
        path = folder / f"photo{n}.jpg"
        tags = Image.Exif()
        if camera is SMALL:
            tags[0x010F], tags[0x0110] = "Maker", "Model"
            diagonal = SMALL.focal * np.hypot(36, 24) / np.hypot(320, 240)
            tags.get_ifd(0x8769)[0xA405] = round(diagonal)
        Image.fromarray(image).save(path, quality=95, exif=tags)
        truth[path.stem] = pose, camera
    return folder, truth


@pytest.fixture(scope="module")
def localizer(case: Case) -> Localizer:
    return Localizer(case.out)


def test_photos_are_found_with_their_cameras(
    case: Case, localizer: Localizer, taken: tuple[Path, dict]
) -> None:
    folder, truth = taken
    photos = [read_photo(path) for path in sorted(folder.glob("*.jpg"))]
    assert [photo.focal is None for photo in photos] == [False, False, True]
    found = localize_photos(localizer, photos)
    assert all(frame.found for frame in found.frames), [frame.reason for frame in found.frames]
    assert [frame.camera for frame in found.frames] == [0, 0, 1]
    assert [len(camera.photos) for camera in found.cameras] == [2, 1]
    for frame in found.frames:
        pose, camera = truth[frame.name]
        assert frame.camera is not None
        projection = found.cameras[frame.camera].projection
        assert projection.focal == pytest.approx(camera.focal, rel=6e-3)
        moved = _in_truth(case, frame.world_T_rig)
        assert np.linalg.norm(moved[:3, 3] - pose[:3, 3]) < 0.02
        assert np.degrees(rotation_angle(moved[:3, :3].T @ pose[:3, :3])) < 0.3


def test_a_photo_of_something_else_is_refused(localizer: Localizer, tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (30, 40, 3)).astype(np.uint8)
    path = tmp_path / "other.png"
    cv2.imwrite(str(path), cv2.resize(noise, (640, 480), interpolation=cv2.INTER_CUBIC))
    found = localize_photos(localizer, [read_photo(path)])
    assert found.frames[0].reason == "no place of the map looks like it"
    assert found.cameras == ()


def test_tags_give_the_focal_length_and_the_shared_camera(tmp_path: Path) -> None:
    def photo(name: str, size: tuple[int, int], focal: int | None) -> Photo:
        tags = Image.Exif()
        tags[0x0110] = "Phone"
        if focal is not None:
            tags.get_ifd(0x8769)[0xA405] = focal
        Image.new("RGB", size).save(tmp_path / name, exif=tags)
        return read_photo(tmp_path / name)

    one, two = photo("a.jpg", (600, 400), 36), photo("b.jpg", (600, 400), 36)
    assert one.focal == pytest.approx(600.0)  # 36 mm on film 36 mm wide
    assert one.camera == two.camera
    assert photo("c.jpg", (600, 400), 24).camera != one.camera
    none = photo("d.jpg", (600, 400), None)
    assert none.focal is None
    assert none.camera != photo("e.jpg", (600, 400), None).camera


def test_keypoints_on_faces_lie_where_the_photo_shows_them() -> None:
    rng = np.random.default_rng(2)
    image = np.full((480, 640, 3), 30, np.uint8)
    spots = np.stack(np.meshgrid(range(60, 600, 90), range(60, 440, 80)), axis=-1).reshape(-1, 2)
    spots = spots + rng.integers(-15, 16, spots.shape)
    for u, v in spots:
        cv2.circle(image, (int(u), int(v)), 6, (230, 230, 230), -1, cv2.LINE_AA)
    rig = photo_rig(CAMERA, CubeRig(256, np.deg2rad(96.0)))
    found = photo_features(image, CAMERA, rig, SiftExtractor(FeatureSettings()))
    pixels = CAMERA.project(found.bearings_rig)
    off = np.linalg.norm(pixels[:, None] - (spots + 0.5), axis=2).min(axis=0)
    assert np.median(off) < 0.3


def test_a_photo_as_panorama_shows_its_pixels_in_their_directions() -> None:
    columns = np.tile(np.linspace(0, 255, 640), (480, 1)).astype(np.uint8)
    grey, mask = as_panorama(np.repeat(columns[..., None], 3, axis=2), CAMERA, 1024)
    rows, found = np.nonzero(mask)
    bearings = bearings_from_erp(np.column_stack([found + 0.5, rows + 0.5]), 1024, 512)
    expected = (CAMERA.project(bearings)[:, 0] - 0.5) * 255 / 639
    assert np.abs(grey[mask] - expected).max() < 2
    assert 0.03 < mask.mean() < 0.2


def _photographed(
    scene, world_T_camera: np.ndarray, camera: PerspectiveProjection, rng: np.random.Generator
) -> np.ndarray:
    """A photo (H, W, 3) uint8 RGB of the gallery."""
    panorama = render_erp(scene, world_T_camera, _WIDTH, _WIDTH // 2)
    bearings = camera.unproject(pixel_centres(camera.width, camera.height))
    pixels = (erp_from_bearings(bearings, _WIDTH, _WIDTH // 2) + 3.5).astype(np.float32)
    padded = cv2.copyMakeBorder(panorama, 4, 4, 4, 4, cv2.BORDER_WRAP)
    u, v = (np.ascontiguousarray(part) for part in np.moveaxis(pixels, -1, 0))
    image = cv2.remap(padded, u, v, cv2.INTER_CUBIC) + 2 * rng.standard_normal((*u.shape, 3))
    return np.clip(image + 0.5, 0, 255).astype(np.uint8)


def _in_truth(case: Case, pose: np.ndarray) -> np.ndarray:
    """A pose in the world of the truth."""
    mapped = read_trajectory(case.out / "trajectory.tum").world_T_rigs
    return pose_similarity(mapped, case.truth.world_T_rigs).poses(pose[None])[0]
