"""Localised photos in datasets, read back: poses, cameras, pictures, and lists that are refused."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from export_scene import NUM_FRAMES, POINTS, exported, panoramas, reconstruction
from refusals import refused

from gsba.camera.projections import PerspectiveProjection
from gsba.export import ExportFormat, ExportOptions, export, export_all
from gsba.export.photos import read_photos
from gsba.export.trainers import options_for
from gsba.geometry import pose
from gsba.log import GsbaError
from gsba.placement.placement import Placement
from gsba.similarity import Sim3

CAMERA = PerspectiveProjection(64, 48, 50.0, (33.0, 23.5), (0.04, -0.01))
MOVE = Sim3(2.0, np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([1.0, 2, 3]))


@pytest.fixture
def located(tmp_path: Path) -> Path:
    """Folder as `gsba localize` leaves it: a photo of each pose, and one that was refused."""
    folder = tmp_path / "located"
    folder.mkdir()
    pictures = []
    for n in range(2):
        path = tmp_path / f"shot{n}.jpg"
        cv2.imwrite(str(path), np.full((48, 64, 3), 90 * n, np.uint8))
        world_T_camera = pose(np.eye(3), np.array([0.1 * n, 0.2, -1.0]))
        pictures.append(_entry(path, 0, world_T_camera, ""))
    pictures.append(_entry(tmp_path / "gone.jpg", None, np.eye(4), "no place looks like it"))
    camera = {
        "model": "perspective",
        "width": 64,
        "height": 48,
        "focal": 50.0,
        "principal": [33.0, 23.5],
        "radial": [0.04, -0.01],
    }
    content = {
        "run": str(tmp_path / "run"),
        "map": "as it is",
        "pictures": pictures,
        "cameras": [camera],
    }
    (folder / "localized.json").write_text(json.dumps(content))
    return folder


def _entry(path: Path, camera: int | None, world_T_camera: np.ndarray, reason: str) -> dict:
    entry = {"name": path.stem, "file": str(path), "camera": camera, "reason": reason}
    return entry | {"world_T_picture": world_T_camera.tolist()}


@pytest.mark.parametrize("to", [ExportFormat.COLMAP, ExportFormat.COLMAP_FLAT])
def test_colmap_has_photos_as_cameras_of_their_own(
    to: ExportFormat, located: Path, tmp_path: Path
) -> None:
    photos = read_photos(located, tmp_path / "run", "as it is")
    frames, out = panoramas(tmp_path / "frames"), tmp_path / "out"
    given = reconstruction(), frames, out, to
    export(*given, placement=Placement(MOVE), photos=photos, split=False)
    model = pycolmap.Reconstruction(str(out / "sparse/0"))
    assert model.num_reg_frames() == NUM_FRAMES + 2
    assert model.num_points3D() == len(POINTS)
    names = {image.name: image for image in model.images.values()}
    pattern = "photos/shot{}.jpg" if to == ExportFormat.COLMAP else "photo_shot{}.jpg"
    for n in range(2):
        image = names[pattern.format(n)]
        assert (out / "images" / image.name).read_bytes() == (
            tmp_path / f"shot{n}.jpg"
        ).read_bytes()
        ahead = np.array([[0.2 + 0.1 * n, 0.1, 1.0]])  # 2 units before the camera
        local = ahead - [0.1 * n, 0.2, -1.0]
        seen = image.project_point(MOVE.points(ahead)[0])
        np.testing.assert_allclose(seen, CAMERA.project(local)[0], atol=1e-9)


@pytest.mark.parametrize("num", [2, 60])
def test_photos_are_in_the_order_by_which_readers_hold_images_out(
    num: int, located: Path, tmp_path: Path
) -> None:
    photos, out = read_photos(located, tmp_path / "run", "as it is"), tmp_path / "out"
    more = (replace(photos.photos[0], name=f"shot{n}") for n in range(num))
    photos = replace(photos, photos=tuple(more))
    frames = panoramas(tmp_path / "frames")
    export(reconstruction(), frames, out, ExportFormat.COLMAP_FLAT, face_size=16, photos=photos)
    images = pycolmap.Reconstruction(out / "sparse/0").images
    by_name = sorted(image.name for image in images.values())
    assert by_name == [images[number].name for number in sorted(images)]
    assert sum("photo_shot" in name for name in by_name) == num
    assert (out / "test_list.txt").read_text().split() == by_name[::8]
    training = [name for n, name in enumerate(by_name) if n % 8]
    assert sorted((out / "train_list.txt").read_text().split()) == training
    held = {name.split("_")[2] for name in by_name[::8] if "photo" not in name}
    assert held and not held & {name.split("_")[2] for name in training}
    assert all((out / "images" / name).is_file() for name in by_name)


def test_photos_are_undistorted_for_programs_that_read_pinholes(
    located: Path, tmp_path: Path
) -> None:
    """A line through the distorted photo is where the pinhole camera has the same rays."""
    columns, rows = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    ramp = np.dstack([4 * columns, 5 * rows, np.full_like(rows, 90)]).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "shot0.jpg"), ramp, [cv2.IMWRITE_JPEG_QUALITY, 100])
    photos, out = read_photos(located, tmp_path / "run", "as it is"), tmp_path / "out"
    frames, options = panoramas(tmp_path / "frames"), ExportOptions(face_size=16, photos=photos)
    options = replace(options_for("opensplat", options), split=False)
    export_all(reconstruction(), frames, {ExportFormat.COLMAP_FLAT: out}, options)
    model = pycolmap.Reconstruction(out / "sparse/0")
    assert {camera.model.name for camera in model.cameras.values()} == {"PINHOLE"}
    (shot,) = (image for image in model.images.values() if image.name == "photo_shot0.jpg")
    image = cv2.imread(str(out / "images/photo_shot0.jpg"))
    for pixel in ([8, 8], [56, 8], [30, 40], [8, 40]):
        ray = np.append(shot.camera.cam_from_img(np.array(pixel) + 0.5), 1.0)
        seen = CAMERA.project(ray[None])[0]
        np.testing.assert_allclose(image[pixel[1], pixel[0], :2] / [4, 5], seen, atol=0.6)


@pytest.mark.parametrize("to", [ExportFormat.COLMAP_FLAT, ExportFormat.NERFSTUDIO])
def test_photos_have_masks_where_all_images_must_have_one(
    to: ExportFormat, located: Path, tmp_path: Path
) -> None:
    photos, out = read_photos(located, tmp_path / "run", "as it is"), tmp_path / "out"
    frames = panoramas(tmp_path / "frames", masked=True)
    export(reconstruction(), frames, out, to, face_size=16, photos=photos)
    images = {path.stem for path in (out / "images").iterdir()}
    assert images == {path.stem for path in (out / "masks").iterdir()}
    (mask,) = (out / "masks").glob("*photo_shot0.png")
    assert (cv2.imread(str(mask), cv2.IMREAD_UNCHANGED) == np.full((48, 64), 255)).all()
    if to == ExportFormat.NERFSTUDIO:
        entries = json.loads((out / "transforms.json").read_text())["frames"]
        assert all((out / entry["mask_path"]).is_file() for entry in entries)


def test_photos_that_would_overwrite_one_another_are_refused(located: Path, tmp_path: Path) -> None:
    photos = read_photos(located, tmp_path / "run", "as it is")
    twice = replace(photos, photos=(photos.photos[0], replace(photos.photos[1], name="shot0")))
    given = reconstruction(), panoramas(tmp_path / "frames"), tmp_path / "out"
    with pytest.raises(GsbaError, match=r"shot0.jpg and .*shot1.jpg would both be images/photo_sh"):
        export(*given, ExportFormat.COLMAP_FLAT, face_size=16, photos=twice)
    assert not (tmp_path / "out").exists()


def test_nerfstudio_has_intrinsics_of_each_frame(located: Path, tmp_path: Path) -> None:
    photos = read_photos(located, tmp_path / "run", "as it is")
    out = exported(tmp_path, ExportFormat.NERFSTUDIO, photos=photos)
    document = json.loads((out / "transforms.json").read_text())
    assert "fl_x" not in document and "k1" not in document
    assert all({"fl_x", "cx", "w", "k1"} <= entry.keys() for entry in document["frames"])
    shot = next(e for e in document["frames"] if e["file_path"] == "images/photo_shot1.jpg")
    assert (shot["fl_x"], shot["cx"], shot["k1"]) == (50.0, 33.0, 0.04)
    matrix, applied = np.array(shot["transform_matrix"]), np.array(document["applied_transform"])
    np.testing.assert_allclose(matrix[:3, 3], applied @ [0.1, 0.2, -1.0, 1])
    np.testing.assert_allclose(matrix[:3, 2], applied[:, :3] @ [0, 0, -1], atol=1e-12)
    assert "images/photo_shot0.jpg" in document["train_filenames"]
    assert (out / "images/photo_shot0.jpg").is_file()


def test_lists_that_cannot_be_used_are_refused(located: Path, tmp_path: Path) -> None:
    refused("are localised in", read_photos, located, tmp_path / "other", "as it is")
    refused("or before it changed", read_photos, located, tmp_path / "run", "grown")
    refused("is no list of gsba localize", read_photos, tmp_path, tmp_path / "run", "as it is")
    photos, frames = (
        read_photos(located, tmp_path / "run", "as it is"),
        panoramas(tmp_path / "frames"),
    )
    with pytest.raises(GsbaError, match="photos go beside cube faces"):
        export(reconstruction(), frames, tmp_path / "o", ExportFormat.TUM, photos=photos)
    assert not (tmp_path / "o").exists()
    (tmp_path / "shot0.jpg").unlink()
    refused("this photo is gone", read_photos, located, tmp_path / "run", "as it is")
