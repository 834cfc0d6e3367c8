"""Localised photos in datasets, read back: poses, cameras, pictures, and lists that are refused."""

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from export_scene import NUM_FRAMES, POINTS, panoramas, reconstruction

from gsba.camera.projections import PerspectiveProjection
from gsba.export import ExportFormat, export
from gsba.export.photos import read_photos
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
    content = {"run": str(tmp_path / "run"), "pictures": pictures, "cameras": [camera]}
    (folder / "localized.json").write_text(json.dumps(content))
    return folder


def _entry(path: Path, camera: int | None, world_T_camera: np.ndarray, reason: str) -> dict:
    entry = {"name": path.stem, "file": str(path), "camera": camera, "reason": reason}
    return entry | {"world_T_picture": world_T_camera.tolist()}


@pytest.mark.parametrize("to", [ExportFormat.COLMAP, ExportFormat.COLMAP_FLAT])
def test_colmap_has_photos_as_cameras_of_their_own(
    to: ExportFormat, located: Path, tmp_path: Path
) -> None:
    photos = read_photos(located, tmp_path / "run")
    frames, out = panoramas(tmp_path / "frames"), tmp_path / "out"
    export(reconstruction(), frames, out, to, placement=Placement(MOVE), photos=photos)
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


def test_nerfstudio_has_intrinsics_of_each_frame(located: Path, tmp_path: Path) -> None:
    photos = read_photos(located, tmp_path / "run")
    frames, out = panoramas(tmp_path / "frames"), tmp_path / "out"
    export(reconstruction(), frames, out, ExportFormat.NERFSTUDIO, photos=photos)
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
    with pytest.raises(GsbaError, match="are localised in"):
        read_photos(located, tmp_path / "other")
    with pytest.raises(GsbaError, match="is no list of gsba localize"):
        read_photos(tmp_path, tmp_path / "run")
    photos, frames = read_photos(located, tmp_path / "run"), panoramas(tmp_path / "frames")
    with pytest.raises(GsbaError, match="photos go beside cube faces"):
        export(reconstruction(), frames, tmp_path / "o", ExportFormat.TUM, photos=photos)
    assert not (tmp_path / "o").exists()
    (tmp_path / "shot0.jpg").unlink()
    with pytest.raises(GsbaError, match="this photo is gone"):
        read_photos(located, tmp_path / "run")
