"""One export read by the programs it is for: `packaging/consumers.sh` installs them."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
from export_scene import COLORS, NUM_FRAMES, POINTS, panoramas, poses, reconstruction
from synthetic import unit
from two_fisheyes import made_pair, picture, write

from gsba.camera.lens import Lenses
from gsba.camera.rig import RIG_R_FACE
from gsba.export import ExportFormat, ExportOptions, export_all
from gsba.export.photos import PhotoCamera, Photos, PlacedPhoto
from gsba.frames.held_out import held_out_rows
from gsba.geometry import pose
from gsba.splat.gaussians import Gaussians, read_ply, write_ply
from gsba.types import FACES, FrameSet, PictureFormat

pytestmark = [pytest.mark.consumers, pytest.mark.filterwarnings("ignore")]  # of the programs

HELD_OUT = {f"frame_{f:04d}" for f in held_out_rows(NUM_FRAMES)}
PAIR = made_pair(120)
RAW = Lenses(np.array([0.01, -0.02, 0.2]), band_rad=0.03, reference_calibration=PAIR)
_FAR_DEG = 0.01  # of a ray
_BESIDE_PARSERS = ("tensorboard", "torch.utils.tensorboard", "newrawpy", "rawpy")  # imported beside
# nerfstudio's parsers, which do not use them


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Masked panoramas and a photo in each format that holds photos, and the others without it."""
    home = tmp_path_factory.mktemp("consumers")
    frames = panoramas(home / "frames", masked=True)
    shot = write(home / "shot.png", np.full((48, 64, 3), 90, np.uint8))
    camera = PhotoCamera(64, 48, 50.0, (32.0, 24.0), (0.0, 0.0))
    photo = PlacedPhoto("shot", shot, pose(np.eye(3), np.array([0.5, 0.2, -1.0])), 0)
    options = ExportOptions(face_size=64, photos=Photos((photo,), (camera,)))
    outs = {to: home / to for to in (ExportFormat.COLMAP_FLAT, ExportFormat.NERFSTUDIO)}
    options = replace(options, cameras=("PINHOLE",))  # nerfstudio reads models of one kind alone
    export_all(reconstruction(), frames, outs, options)
    outs = {to: home / to for to in (ExportFormat.TUM, ExportFormat.PLY, ExportFormat.GLTF)}
    export_all(reconstruction(), frames, outs)
    return home


def _read(folder: Path, split: str):
    """Cameras and files of a split, as nerfstudio parses a folder, in the exported world."""
    pytest.importorskip("torch")
    for beside in _BESIDE_PARSERS:
        sys.modules.setdefault(beside, MagicMock())
    plain = {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False}
    name, settings = "nerfstudio", {"data": folder, "downscale_factor": 1, **plain}
    if folder.name == "colmap-flat":
        name, paths = "colmap", {"colmap_path": Path("sparse/0"), "masks_path": Path("masks")}
        settings |= paths | {"assume_colmap_world_coordinate_convention": False}
        settings["load_3D_points"] = False
    module = f"nerfstudio.data.dataparsers.{name}_dataparser"
    parsers = pytest.importorskip(module, exc_type=ImportError)
    config = getattr(parsers, f"{name.capitalize()}DataParserConfig")
    return config(**settings).setup().get_dataparser_outputs(split)


def _rays(outputs, image: int, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre (3,) and directions (N, 3) of rays in the exported world, through pixels (N, 2) whose
    corners are integers."""
    import torch

    coords = torch.tensor(pixels[:, ::-1].copy(), dtype=torch.float32)
    bundle = outputs.cameras.generate_rays(torch.full((len(pixels), 1), image), coords=coords)
    world = outputs.dataparser_transform.numpy().astype(float)  # out of the exported one
    turned = bundle.directions.numpy().astype(float) @ world[:, :3]
    centre = (bundle.origins.numpy().astype(float)[0] - world[:, 3]) @ world[:, :3]
    return centre, turned / np.linalg.norm(turned, axis=1, keepdims=True)


def _frame_of(path: Path) -> str:
    """Frame of an image by its name; "" = a photo."""
    return next((name for name in map(_frame_name, range(NUM_FRAMES)) if name in path.name), "")


def _frame_name(f: int) -> str:
    return f"frame_{f:04d}"


@pytest.mark.parametrize("to", ["nerfstudio", "colmap-flat"])
def test_nerfstudio_reads_faces(to: str, exported: Path) -> None:
    train, test = (_read(exported / to, split) for split in ("train", "test"))
    assert len(train.image_filenames) == 6 * (NUM_FRAMES - len(HELD_OUT)) + 1
    trained, tested = ({_frame_of(p) for p in o.image_filenames} for o in (train, test))
    assert tested == HELD_OUT and not trained & HELD_OUT and "" in trained
    pixels = np.array([[32.0, 32], [1, 5], [50, 63]])
    for outputs in (train, test):
        assert outputs.mask_filenames is not None
        assert len(outputs.mask_filenames) == len(outputs.image_filenames)
        assert all(path.is_file() for path in (*outputs.mask_filenames, *outputs.image_filenames))
        for number, path in enumerate(outputs.image_filenames):
            if not _frame_of(path):
                continue
            world_T_rig = poses()[int(_frame_of(path)[-4:])]
            rig_R_face = RIG_R_FACE[FACES.index(path.stem.rpartition("_")[2])]
            centre, directions = _rays(outputs, number, pixels)
            np.testing.assert_allclose(centre, world_T_rig[:3, 3], atol=1e-5)
            local = np.column_stack([pixels / 32 - 1, np.ones(len(pixels))])
            expected = unit(local @ (world_T_rig[:3, :3] @ rig_R_face).T)
            _assert_parallel(directions, expected)


def _assert_parallel(some: np.ndarray, others: np.ndarray) -> None:
    off = np.rad2deg(np.linalg.norm(np.cross(some, others), axis=1))
    assert (off < _FAR_DEG).all() and (np.sum(some * others, axis=1) > 0).all(), off


def test_nerfstudio_reads_raw_fisheyes(tmp_path: Path) -> None:
    frames, out = _raw_frames(tmp_path), tmp_path / "nerfstudio"
    scene = reconstruction().taken(np.arange(len(frames)))
    options = ExportOptions(images="fisheye", lenses=RAW)
    export_all(scene, frames, {ExportFormat.NERFSTUDIO: out}, options)
    outputs = _read(out, "train")
    from gsba.camera.fisheye import project, rotation_of

    looked = 0
    for number, path in enumerate(outputs.image_filenames):
        f, which = int(_frame_of(path)[-4:]), int("front" not in path.name)
        lens = PAIR[which]
        centre = poses()[f][:3, :3] @ RAW.centres[which] + poses()[f][:3, 3]
        local = (POINTS - centre) @ poses()[f][:3, :3]
        ahead = local @ rotation_of(lens)[:, 2] > 0.2 * np.linalg.norm(local, axis=1)
        found, directions = _rays(outputs, number, project(lens, local[ahead]))
        np.testing.assert_allclose(found, centre, atol=1e-5)
        expected = POINTS[ahead] - centre
        _assert_parallel(directions, expected / np.linalg.norm(expected, axis=1, keepdims=True))
        looked += np.count_nonzero(ahead)
    assert looked > 2 * len(outputs.image_filenames)


def _raw_frames(home: Path, num: int = 4) -> FrameSet:
    base = panoramas(home / "frames").taken(np.arange(num))
    files: Sequence[Path] = [write(home / f"{k}.png", picture(lens)) for k, lens in enumerate(PAIR)]
    form = PictureFormat("fisheye", 240, 120, fisheyes=PAIR)
    return FrameSet(base.names, (tuple(files),) * num, base.timestamps, (None,) * num, (form,))


def test_evo_reads_the_trajectory(exported: Path) -> None:
    io = pytest.importorskip("evo.tools.file_interface")
    read = io.read_tum_trajectory_file(exported / "tum/trajectory.tum")
    np.testing.assert_allclose(read.positions_xyz, poses()[:, :3, 3], atol=1e-6)
    np.testing.assert_allclose(np.stack(read.poses_se3), poses(), atol=1e-6)
    np.testing.assert_allclose(read.timestamps, np.arange(NUM_FRAMES) * 0.5)


@pytest.mark.parametrize("cloud", ["ply", "colmap-flat/sparse/0"])
def test_open3d_reads_the_cloud(cloud: str, exported: Path) -> None:
    open3d = pytest.importorskip("open3d")
    read = open3d.io.read_point_cloud(str(exported / cloud / "points3D.ply"))
    np.testing.assert_allclose(np.asarray(read.points), POINTS, atol=1e-6)
    np.testing.assert_allclose(np.asarray(read.colors) * 255, COLORS, atol=1e-6)


def _node_package(name: str) -> Path:
    """Folder of a package of node; the test is skipped without it."""
    folder = Path(os.environ.get("GSBA_NODE_MODULES", "")) / name
    if not folder.is_absolute() or not folder.is_dir() or shutil.which("node") is None:
        pytest.skip(f"node or its package {name} is not installed")
    return folder


def test_the_scene_is_valid_gltf(exported: Path) -> None:
    validator = _node_package("gltf-validator")
    script = (
        f"require({json.dumps(str(validator))}).validateBytes(new Uint8Array("
        f"require('fs').readFileSync({json.dumps(str(exported / 'gltf/scene.glb'))})))"
        ".then((report) => console.log(JSON.stringify(report)))"
    )
    read = subprocess.run(["node", "-e", script], capture_output=True, text=True, check=True)
    report = json.loads(read.stdout)
    assert (report["issues"]["numErrors"], report["issues"]["numWarnings"]) == (0, 0), report
    assert report["info"]["animationCount"] == 1


def test_splat_transform_reads_splats(tmp_path: Path) -> None:
    """SuperSplat's command line: all numbers of a splat come back."""
    program = _node_package("@playcanvas/splat-transform") / "bin/cli.mjs"
    rng, num = np.random.default_rng(0), 50
    shapes = (num, 3), (num, 3), (num, 4), (num,), (num, 16, 3)
    splat = Gaussians(*(rng.normal(size=shape).astype(np.float32) for shape in shapes))
    before, after = tmp_path / "point_cloud.ply", tmp_path / "after.ply"
    write_ply(before, splat)
    subprocess.run(["node", program, before, after], capture_output=True, check=True)
    for one, other in zip(read_ply(before).arrays(), read_ply(after).arrays(), strict=True):
        np.testing.assert_array_equal(one, other)
