"""Pictures of several datasets at once: the same bytes as one by one, each frame read once."""

import tracemalloc
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from export_scene import HEIGHT, NUM_FRAMES, WIDTH, contents, cube_frames, panoramas, reconstruction
from refusals import refused
from scipy.spatial.transform import Rotation
from shard_jobs import Parts

from factors.sphere_field import num_harmonics
from gsba.camera.cameras import Cameras
from gsba.camera.lens import ONE_CENTRE, Lenses
from gsba.camera.rig import CubeRig
from gsba.export import ExportFormat, ExportOptions, export, export_all, images, pictures
from gsba.export.dataset import Dataset
from gsba.frames import cubemap, masks, pixels
from gsba.frames.pixels import load_erp
from gsba.log import GsbaError
from gsba.placement.placement import Placement
from gsba.types import FrameSet

FORMATS = [ExportFormat.COLMAP, ExportFormat.COLMAP_FLAT, ExportFormat.NERFSTUDIO]
BENT = tuple(0.004 * np.random.default_rng(3).normal(size=num_harmonics(3)))
TWO = Lenses(np.array([0.01, -0.02, 0.2]), band_rad=np.deg2rad(3))
MOVING = replace(
    TWO,
    row_directions=np.array([[0, 1.0, 0], [0, 1.0, 0]]),
    readout_motion=0.02 * np.random.default_rng(4).normal(size=(NUM_FRAMES, 6)),
    axes=Rotation.from_rotvec(
        0.1 * np.random.default_rng(5).normal(size=(NUM_FRAMES, 3))
    ).as_matrix(),
)
PADDED = 3 * (HEIGHT + 8) * (WIDTH + 8)  # bytes


def _frames(folder: Path, kind: str) -> FrameSet:
    frames = panoramas(folder / "frames", ".jpg", masked=kind != "plain")
    if kind == "corrected":
        return frames.with_formats([replace(frames.format, correction=BENT)])
    if kind == "masks of their own":
        own = [*frames.mask_paths]
        own[3:5] = folder / "own.png", None
        cv2.imwrite(str(own[3]), np.tile(np.array([0, 255], np.uint8), (HEIGHT, WIDTH // 2)))
        return replace(frames, mask_paths=tuple(own))
    return frames


def _count(monkeypatch: pytest.MonkeyPatch, module, name: str) -> Counter:
    """How often each file is decoded from there."""
    decode, counts = getattr(module, name), Counter()

    def counted(path: Path, *args, **kwargs) -> np.ndarray:
        counts[path] += 1
        return decode(path, *args, **kwargs)

    monkeypatch.setattr(module, name, counted)
    return counts


def _threads(monkeypatch: pytest.MonkeyPatch, num: int) -> None:
    monkeypatch.setattr(images.os, "cpu_count", lambda: num)


@pytest.mark.parametrize(
    ("kind", "lenses"),
    [
        ("plain", ONE_CENTRE),
        ("masks of their own", ONE_CENTRE),
        ("corrected", ONE_CENTRE),
        ("masks of their own", TWO),
    ],
)
def test_files_are_the_same_together_and_alone(tmp_path, monkeypatch, kind, lenses):
    rows, outs = np.arange(3, 6), {to: tmp_path / "all" / to for to in FORMATS}
    frames, scene = _frames(tmp_path, kind).taken(rows), reconstruction().taken(rows)
    _threads(monkeypatch, 4)
    export_all(scene, frames, outs, ExportOptions(face_size=64, lenses=lenses))
    _threads(monkeypatch, 1)
    for to in FORMATS:
        export(scene, frames, tmp_path / "one" / to, to, 64, lenses=lenses)
    together, alone = contents(tmp_path / "all"), contents(tmp_path / "one")
    assert together == alone and len(together) > 80


@pytest.mark.parametrize("size", [96, 40])  # cut as it is, and low-passed first
@pytest.mark.parametrize("kind", ["plain", "corrected"])
def test_faces_are_those_of_the_whole_panorama(tmp_path, monkeypatch, kind, size):
    frames = _frames(tmp_path, kind)
    _threads(monkeypatch, 2)
    export(reconstruction(), frames, tmp_path / "out", ExportFormat.COLMAP, size)
    for f in range(NUM_FRAMES):
        for name, face in zip(
            ("front", "right", "back", "left", "up", "down"),
            cubemap.cut(load_erp(frames, f), CubeRig(size, np.pi / 2)),
            strict=True,
        ):
            bgr = np.ascontiguousarray(face[..., ::-1])
            wanted = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
            path = tmp_path / "out" / "images" / name / f"{frames.names[f]}.jpg"
            assert path.read_bytes() == wanted.tobytes()


@pytest.mark.parametrize("kind", ["masked", "corrected"])
def test_frames_and_masks_are_read_once(tmp_path, monkeypatch, kind):
    frames = _frames(tmp_path, kind)
    read, masked = (_count(monkeypatch, module, "decode") for module in (pixels, masks))
    outs = {to: tmp_path / to for to in (*FORMATS, ExportFormat.COLMAP_ERP)}
    export_all(reconstruction(), frames, outs)
    assert read == dict.fromkeys((path for (path,) in frames.paths), 1)
    assert masked == {frames.mask_paths[0]: 1}


def test_a_thread_holds_one_panorama(tmp_path, monkeypatch):
    frames, seen = _frames(tmp_path, "plain"), set()
    load = pictures.load_padded

    def watched(*args) -> np.ndarray:
        padded = load(*args)
        seen.add(padded.ctypes.data)
        return padded

    monkeypatch.setattr(pictures, "load_padded", watched)
    _threads(monkeypatch, 2)
    export(reconstruction(), frames, tmp_path / "two", ExportFormat.COLMAP)
    assert len(seen) <= 2
    _threads(monkeypatch, 1)
    assert _peak(lambda: export(reconstruction(), frames, tmp_path / "1", FORMATS[0])) < 2 * PADDED


def _peak(call: Callable[[], object]) -> int:
    """Bytes that a call holds at most, beyond what is held before."""
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("kind", "lenses", "to", "chosen"),
    [
        ("plain", ONE_CENTRE, "nerfstudio", "auto"),
        ("corrected", ONE_CENTRE, "colmap-erp", "auto"),
        ("masks of their own", ONE_CENTRE, "colmap-flat", "auto"),
        ("masks of their own", MOVING, "colmap", "lenses"),
        ("masks of their own", MOVING, "colmap-erp", "panorama"),
        ("faces", ONE_CENTRE, "colmap", "auto"),
    ],
)
def test_parts_write_what_the_whole_does(tmp_path, kind, lenses, to, chosen):
    frames = cube_frames(tmp_path / "cube") if kind == "faces" else _frames(tmp_path, kind)
    whole, parts, rows = tmp_path / "whole", tmp_path / "parts", np.arange(3, 6)
    frames, scene, lenses = frames.taken(rows), reconstruction().taken(rows), lenses.taken(rows)
    options = {"lenses": lenses, "images": chosen}
    origins = lenses.origins(scene.observation_bearings, scene.observation_frames)
    scene = replace(scene, observation_origins=origins)
    export(scene, frames, whole, ExportFormat(to), **options)
    export(scene, frames, parts, ExportFormat(to), **options, workers=Parts(1))
    assert contents(whole) == contents(parts)


def test_whoever_is_late_makes_no_folders(tmp_path):
    """A worker whose frames another one has written meanwhile, or that does not see the disk."""
    files = pictures.Files(tmp_path / "out", ("",), "images/{name}{suffix}", "")
    frames = _frames(tmp_path, "plain")
    given = files.folder, reconstruction(), frames, Cameras(), ExportFormat.TUM, "panorama"
    data = Dataset(*given, Placement(), ExportOptions())
    writers = images.panorama_writers(data, files)
    with pytest.raises(GsbaError, match=r"cannot write .*out/images/frame_0000.jpg: No such file"):
        pictures.Pictures(frames, [writers])(0)
    assert not (tmp_path / "out").exists()


def test_what_one_format_cannot_take_leaves_none_written(tmp_path):
    frames = _frames(tmp_path, "plain")
    (tmp_path / "erp").write_text("mine")
    outs = {ExportFormat.COLMAP: tmp_path / "faces", ExportFormat.COLMAP_ERP: tmp_path / "erp"}
    refused("erp is a file", export_all, reconstruction(), frames, outs)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["erp", "frames"]
