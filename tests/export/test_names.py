"""Names of exported images: sorted as frames are, and none the end or the copy of another."""

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from export_scene import panoramas, reconstruction
from refusals import refused

from gsba.export import ExportFormat, export
from gsba.export.names import base_names, padded_names
from gsba.log import GsbaError
from gsba.trajectory.metashape import read_metashape
from gsba.types import FrameSet


@pytest.mark.parametrize(
    ("names", "padded"),
    [
        (["1", "11", "2"], ["01", "11", "02"]),
        (["a9b1", "a10b2", "b1"], ["a09b1", "a10b2", "b1"]),
        (["r2/9", "r2/10", "r10/1"], ["r2/09", "r2/10", "r10/1"]),
        (["1", "01", "10"], ["1", "01", "10"]),  # only zeros tell the first two apart
        (["front", "back"], ["front", "back"]),
    ],
)
def test_numbers_have_one_length(names: list[str], padded: list[str]) -> None:
    assert list(padded_names(names).values()) == padded


def test_two_frames_never_get_one_name() -> None:
    assert base_names(["a/1", "b/1"]) == {"a/1": "a_1", "b/1": "b_1"}
    with pytest.raises(GsbaError, match=r"'a/b_1' and 'a_b/1' would both be named 'a_b_1'.*rename"):
        base_names(["a/b_1", "a_b/1"])


def _named(folder: Path, *names: str) -> FrameSet:
    frames = panoramas(folder).taken(np.arange(len(names)))
    shifts = (0.0,) * len(names) if any("/" in name for name in names) else ()
    return replace(frames, names=names, clock_shifts=shifts)


@pytest.mark.parametrize("split", [False, True])
def test_brush_finds_each_image_by_the_end_of_its_name(split: bool, tmp_path: Path) -> None:
    frames, out = _named(tmp_path / "frames", "1", "11", "111"), tmp_path / "out"
    scene = reconstruction().taken(np.arange(3))
    export(scene, frames, out, ExportFormat.COLMAP_FLAT, face_size=16, split=split)
    images = pycolmap.Reconstruction(out / "sparse/0").images.values()
    files = [str(path.relative_to(out)) for path in out.glob("**/*.png")]
    for image in images:
        assert [file for file in files if file.endswith(image.name)] == [f"images/{image.name}"]


@pytest.mark.parametrize("images", ["panorama", "cube"])
def test_labels_of_metashape_are_unique_names_of_files(images: str, tmp_path: Path) -> None:
    names = ("day/0001", "day/0002", "night/0001")
    frames, scene = _named(tmp_path / "frames", *names), reconstruction().taken(np.arange(3))
    export(scene, frames, tmp_path / "out", ExportFormat.METASHAPE, face_size=16, images=images)
    cameras = ET.parse(tmp_path / "out/cameras.xml").getroot().findall("chunk/cameras/camera")
    labels = sorted(str(camera.get("label")) for camera in cameras)
    assert labels == sorted(path.stem for path in (tmp_path / "out/images").iterdir())
    assert len(set(labels)) == len(labels) == (3 if images == "panorama" else 18)
    if images == "panorama":
        (component,) = read_metashape(tmp_path / "out/cameras.xml")
        poses = component.timed(frames).world_T_rigs
        np.testing.assert_allclose(poses, scene.world_T_rigs, atol=1e-12)


def test_names_that_collide_are_refused_and_nothing_is_written(tmp_path: Path) -> None:
    frames = _named(tmp_path / "frames", "a/b_1", "a_b/1", "c/1")
    scene, out = reconstruction().taken(np.arange(3)), tmp_path / "out"
    for to in (ExportFormat.COLMAP_FLAT, ExportFormat.NERFSTUDIO, ExportFormat.METASHAPE):
        refused("would both be named 'a_b_1'", export, scene, frames, out, to, face_size=16)
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]
