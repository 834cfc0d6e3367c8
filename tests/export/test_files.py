"""What an export leaves on disk: point clouds, trajectories, and nothing half-written."""

import errno
import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from export_scene import COLORS, NUM_FRAMES, POINTS, cube_frames, panoramas, reconstruction
from PIL import Image
from plyfile import PlyData
from refusals import refused

from gsba.export import ExportFormat, export, pictures, write_points
from gsba.export.images import face_size_for
from gsba.log import GsbaError
from gsba.trajectory.files import read_trajectory


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    return panoramas(tmp_path_factory.mktemp("scene") / "frames", ".jpg")


def _entries(folder):
    return sorted(path.name for path in folder.iterdir())


def test_the_runs_cloud_states_colour_error_and_track_length(tmp_path):
    scene = reconstruction()
    write_points(tmp_path / "points.ply", scene)
    vertex = PlyData.read(tmp_path / "points.ply")["vertex"]
    assert np.allclose(np.column_stack([vertex["x"], vertex["y"], vertex["z"]]), POINTS, atol=1e-6)
    assert np.array_equal(np.column_stack([vertex["red"], vertex["green"], vertex["blue"]]), COLORS)
    assert np.allclose(vertex["error_deg"], np.degrees(scene.point_errors), rtol=1e-6)
    assert vertex["track_length"].tolist() == [NUM_FRAMES] * len(POINTS)
    assert _entries(tmp_path) == ["points.ply"]


def test_the_start_cloud_is_inrias(tmp_path, frames):
    export(reconstruction(), frames, tmp_path / "out", ExportFormat.PLY)
    cloud = PlyData.read(tmp_path / "out" / "points3D.ply")
    assert not cloud.text and cloud.byte_order == "<"
    kinds = [(p.name, p.val_dtype) for p in cloud["vertex"].properties]
    assert kinds == [
        *((name, "f4") for name in ("x", "y", "z", "nx", "ny", "nz")),
        *((name, "u1") for name in ("red", "green", "blue")),
    ]
    assert not np.any(cloud["vertex"]["nx"])


def test_the_trajectory_is_read_back(tmp_path, frames):
    export(reconstruction(), frames, tmp_path / "out", ExportFormat.TUM)
    trajectory = read_trajectory(tmp_path / "out" / "trajectory.tum")
    assert np.array_equal(trajectory.timestamps, frames.timestamps)
    assert np.allclose(trajectory.world_T_rigs, reconstruction().world_T_rigs, atol=1e-12)


def test_jpeg_frames_give_jpeg_faces_and_panoramas_are_not_encoded_again(tmp_path, frames):
    export(reconstruction(), frames, tmp_path / "faces", ExportFormat.COLMAP)
    faces = list((tmp_path / "faces" / "images" / "front").iterdir())
    assert len(faces) == NUM_FRAMES and all(path.suffix == ".jpg" for path in faces)
    assert cv2.imread(str(faces[0])).shape == (128, 128, 3)
    assert not (tmp_path / "faces" / "masks").exists()


def test_who_edits_an_export_does_not_edit_the_frames(tmp_path, frames):
    before = [path.read_bytes() for (path,) in frames.paths]
    export(reconstruction(), frames, tmp_path / "out", ExportFormat.COLMAP_ERP)
    for (path,), content in zip(frames.paths, before, strict=True):
        copied = tmp_path / "out" / "images" / path.name
        assert copied.read_bytes() == content and not copied.samefile(path)
        with copied.open("r+b") as file:
            file.write(b"edited")
        assert path.read_bytes() == content


def test_faces_that_leave_unchanged_are_copies(tmp_path):
    images = cube_frames(tmp_path / "frames")
    export(reconstruction(), images, tmp_path / "out", ExportFormat.COLMAP)
    faces = [*(tmp_path / "out" / "images").rglob("*.png")]
    assert len(faces) == sum(map(len, images.paths)) and all(
        path.stat().st_nlink == 1 for path in faces
    )


def test_links_are_made_on_request(tmp_path, frames):
    export(reconstruction(), frames, tmp_path / "out", ExportFormat.COLMAP_ERP, link=True)
    for (path,) in frames.paths:
        assert (tmp_path / "out" / "images" / path.name).samefile(path)


def test_panoramas_are_copied_where_they_cannot_be_linked(tmp_path, frames, monkeypatch):
    def refuse(*_):
        raise OSError(errno.EXDEV, "other file system")

    monkeypatch.setattr(os, "link", refuse)
    export(reconstruction(), frames, tmp_path / "out", ExportFormat.COLMAP_ERP, link=True)
    for (path,) in frames.paths:
        copied = tmp_path / "out" / "images" / path.name
        assert copied.read_bytes() == path.read_bytes() and not copied.is_symlink()


def test_a_panorama_that_is_gone_is_named(tmp_path):
    frames = panoramas(tmp_path / "frames")
    frames.paths[4][0].unlink()
    with pytest.raises(GsbaError, match=r"frame_0004.png: cannot be read"):
        export(reconstruction(), frames, tmp_path / "out", ExportFormat.COLMAP_ERP)
    assert _entries(tmp_path) == ["frames"]


@pytest.mark.parametrize(
    ("made", "suffix"),
    [("grey.png", ".png"), ("deep.tif", ".png"), ("deep.png", ".png"), ("colour.webp", ".jpg")],
)
def test_what_trainers_misread_goes_out_in_eight_bits_and_colour(tmp_path, made, suffix):
    frames = panoramas(tmp_path / "frames")
    kind, wanted = Path(made), []
    paths = []
    for (path,) in frames.paths:
        rgb = cv2.imread(str(path))[..., ::-1]
        pixels = rgb if kind.stem == "colour" else rgb[..., 0]
        wanted.append(pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=2))
        stored = pixels.astype(np.uint16) * 257 if kind.stem == "deep" else pixels
        path.unlink()
        paths.append((path.with_suffix(kind.suffix),))
        options = {"quality": 100} if kind.suffix == ".webp" else {}
        Image.fromarray(stored).save(paths[-1][0], **options)
    frames = replace(frames, paths=tuple(paths))
    export(reconstruction(), frames, tmp_path / "erp", ExportFormat.COLMAP_ERP, link=True)
    model = pycolmap.Reconstruction(tmp_path / "erp" / "sparse" / "0")
    for image in model.images.values():
        f = frames.names.index(Path(image.name).stem)
        assert Path(image.name).suffix == suffix
        read = pycolmap.Bitmap.read(tmp_path / "erp" / "images" / image.name, True)
        off = np.abs(read.to_array().astype(int) - wanted[f])
        assert off.mean() < 3 if suffix == ".jpg" else off.max() == 0
    export(reconstruction(), frames, tmp_path / "ns", ExportFormat.NERFSTUDIO)
    for name in ("transforms.json", "transforms_erp.json"):
        for entry in json.loads((tmp_path / "ns" / name).read_text())["frames"]:
            with Image.open(tmp_path / "ns" / entry["file_path"]) as image:
                assert (
                    image.mode == "RGB" and image.format == {".png": "PNG", ".jpg": "JPEG"}[suffix]
                )


def test_turned_faces_go_out_upright(tmp_path):
    frames = cube_frames(tmp_path / "frames")
    shown = {}
    for path in [path for group in frames.paths for path in group]:
        pixels = cv2.imread(str(path))[..., ::-1]
        shown[path.parent.name, path.stem] = pixels
        exif = Image.Exif()
        exif[0x0112] = 8  # shown by a quarter turn to the left
        Image.fromarray(np.ascontiguousarray(np.rot90(pixels, -1))).save(path, exif=exif)
    export(reconstruction(), frames, tmp_path / "out", ExportFormat.COLMAP, link=True)
    for path in (tmp_path / "out" / "images").rglob("*.png"):
        with Image.open(path) as image:
            assert image.getexif().get(0x0112, 1) == 1
            assert np.array_equal(image, shown[path.parent.name, path.stem])


def test_a_link_to_an_earlier_export_stays_a_link(tmp_path, frames):
    export(reconstruction(), frames, tmp_path / "real", ExportFormat.TUM)
    (tmp_path / "link").symlink_to(tmp_path / "real")
    export(reconstruction(), frames, tmp_path / "link", ExportFormat.PLY)
    assert _entries(tmp_path) == ["link", "real"] and (tmp_path / "link").is_symlink()
    assert (tmp_path / "real" / "points3D.ply").exists()


def test_face_size_defaults_to_a_quarter_and_is_even(frames):
    assert face_size_for(frames.format, None) == 128
    assert face_size_for(frames.format, 77) == 77
    refused("face size 8", face_size_for, frames.format, 8)


@pytest.mark.parametrize(
    ("failure", "raised"),
    [
        (KeyboardInterrupt(), KeyboardInterrupt),
        (OSError(errno.ENOSPC, "No space left on device"), GsbaError),
    ],
)
def test_an_export_that_does_not_end_keeps_the_last_one(
    tmp_path, frames, monkeypatch, failure, raised
):
    written = []

    def write(path, content, **options):
        if len(written) == 20:
            raise failure
        written.append(path)
        return whole(path, content, **options)

    whole = pictures.write_bytes
    monkeypatch.setattr(pictures, "write_bytes", write)
    with pytest.raises(raised) as told:
        export(reconstruction(), frames, tmp_path / "out", ExportFormat.COLMAP)
    assert "kept" not in str(told.value)  # of one export nothing is
    hidden = [path.name.startswith(".out.partial-") for path in tmp_path.iterdir()]
    assert hidden == ([True] if raised is KeyboardInterrupt else [])
    export(reconstruction(), frames, tmp_path / "out", ExportFormat.PLY)
    with pytest.raises(raised):
        export(reconstruction(), frames, tmp_path / "out", ExportFormat.COLMAP)
    assert len(_entries(tmp_path)) == 1 + len(hidden)
    assert (tmp_path / "out" / "points3D.ply").exists()


def test_an_empty_folder_is_used_and_an_earlier_export_replaced(tmp_path, frames):
    (tmp_path / "out").mkdir()
    for to, name in ((ExportFormat.TUM, "trajectory.tum"), (ExportFormat.PLY, "points3D.ply")):
        export(reconstruction(), frames, tmp_path / "out", to)
        assert _entries(tmp_path / "out") == sorted(["export.json", name, "transform.json"])
    assert _entries(tmp_path) == ["out"]


def test_what_others_wrote_is_refused_and_kept(tmp_path, frames):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "thesis.tex").write_text("years of work")
    with pytest.raises(GsbaError, match=r"holds 'thesis.tex', which gsba's export did not write"):
        export(reconstruction(), frames, folder, ExportFormat.TUM)
    assert _entries(folder) == ["thesis.tex"]
    file = tmp_path / "file"
    file.write_text("x")
    refused("is a file", export, reconstruction(), frames, file, ExportFormat.TUM)
    assert file.read_text() == "x" and _entries(tmp_path) == ["file", "out"]


def test_a_training_beside_an_earlier_export_is_refused_and_kept(tmp_path, frames):
    export(reconstruction(), frames, tmp_path / "out", ExportFormat.PLY)
    (tmp_path / "out" / "output").mkdir()
    with pytest.raises(GsbaError, match="holds 'output', which gsba's export did not write"):
        export(reconstruction(), frames, tmp_path / "out", ExportFormat.PLY)
    assert _entries(tmp_path / "out") == ["export.json", "output", "points3D.ply", "transform.json"]
