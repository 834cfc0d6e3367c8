"""Recordings of one place by different cameras in one run: sizes, layouts, calibrations."""

import csv
import json
import shutil
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pycolmap
import pytest
from tiny_run import SETTINGS

from gsba import Recording, RunResult, refine_recordings
from gsba.camera.calibration import calibration_json
from gsba.camera.fisheye import unproject
from gsba.camera.rig import CubeRig
from gsba.camera.sphere import around_sphere, erp_from_bearings
from gsba.config import RefineSettings
from gsba.demo import make_walk
from gsba.evaluate.trajectory import evaluate
from gsba.frames.cubemap import cut
from gsba.log import GsbaError
from gsba.store.finished import load_run
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import FACES, Fisheye, Trajectory

NUM, WIDTH, SMALL = 10, 512, 384  # frames of a recording, and widths of the two cameras
LENS = Fisheye(240, 240, 73.0, (120.0, 120.0), (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
PAIR = LENS, Fisheye(240, 240, 73.0, (120.0, 120.0), (0.0,) * 4, (0.0, np.pi, 0.0))


class Home(NamedTuple):
    """Two halves of a walk: each half's pictures, trajectory and truth."""

    folder: Path
    pictures: tuple[list[Path], list[Path]]
    trajectories: tuple[Path, Path]
    truth: Trajectory  # of both, one after the other


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Home:
    """Every other frame of a walk is of the first recording."""
    folder = tmp_path_factory.mktemp("cameras")
    walk = make_walk(folder / "walk", "oval", "locked", 2 * NUM, WIDTH)
    truth, slam = read_trajectory(walk.truth_path), read_trajectory(walk.slam_path)
    images, files = sorted(walk.frames_dir.glob("*.jpg")), []
    times = 0.5 * np.arange(NUM)
    for n in range(2):
        files.append(folder / f"{n}.tum")
        write_tum(files[-1], Trajectory(times, slam.world_T_rigs[n::2]))
    poses = np.concatenate([truth.world_T_rigs[0::2], truth.world_T_rigs[1::2]])
    return Home(
        folder,
        (images[0::2], images[1::2]),
        (files[0], files[1]),
        Trajectory(np.arange(2.0 * NUM), poses),
    )


def _times(folder: Path) -> None:
    rows = [f"{n:06d},{0.5 * n}" for n in range(NUM)]
    (folder / "timestamps.csv").write_text("\n".join(["name,timestamp", *rows, ""]))


def _panoramas(home: Home, which: int, width: int) -> Recording:
    folder = home.folder / f"stitched{which}at{width}"
    if not folder.exists():
        folder.mkdir()
        for n, path in enumerate(home.pictures[which]):
            if width == WIDTH:
                shutil.copy(path, folder / f"{n:06d}.jpg")
            else:
                size = (width, width // 2)
                small = cv2.resize(_read(path), size, interpolation=cv2.INTER_AREA)
                cv2.imwrite(str(folder / f"{n:06d}.jpg"), small)
        _times(folder)
    return Recording(folder, home.trajectories[which])


def _faces(home: Home) -> Recording:
    """The second recording as cube faces."""
    folder = home.folder / "faces"
    for n, path in enumerate(home.pictures[1]):
        for name, image in zip(FACES, cut(_read(path), CubeRig(128, np.pi / 2)), strict=True):
            (folder / name).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / name / f"{n:06d}.png"), image)
    _times(folder)
    return Recording(folder, home.trajectories[1])


def _fisheyes(home: Home) -> Recording:
    """The second recording as two raw fisheyes with one centre, and their calibration."""
    folder = home.folder / "raw"
    for name, lens in zip(("front", "back"), PAIR, strict=True):
        (folder / name).mkdir(parents=True)
        grid = np.stack(np.meshgrid(np.arange(240) + 0.5, np.arange(240) + 0.5), axis=-1)
        places = erp_from_bearings(unproject(lens, grid), WIDTH, WIDTH // 2) - 0.5 + 4
        u, v = np.moveaxis(places, -1, 0).astype(np.float32)
        far = np.hypot(*(np.moveaxis(grid, -1, 0) - 120)) > 73 * np.deg2rad(95)
        for n, path in enumerate(home.pictures[1]):
            shown = cv2.remap(around_sphere(_read(path), 4), u, v, cv2.INTER_CUBIC)
            shown[far] = 0
            cv2.imwrite(str(folder / name / f"{n:06d}.png"), shown)
    _times(folder)
    tree = calibration_json(PAIR, np.array([0.0, 0.0, 0.001]), "map", {})
    (home.folder / "raw.json").write_text(json.dumps(tree))
    return Recording(folder, home.trajectories[1], calibration=home.folder / "raw.json")


def _read(path: Path) -> np.ndarray:
    pixels = cv2.imread(str(path))
    assert pixels is not None
    return pixels


def _settings(**changes: object) -> RefineSettings:
    given = SETTINGS.model_dump()
    for stage, values in changes.items():
        given[stage] |= values
    return RefineSettings.model_validate(given)


def _error(result: RunResult, home: Home) -> float:
    assert len(result.maps) == 1
    assert result.reconstruction.num_maps == 1
    found = Trajectory(home.truth.timestamps, result.reconstruction.world_T_rigs)
    return evaluate(found, home.truth).ate.rmse


@pytest.fixture(scope="module")
def alike(home: Home) -> float:
    """Error of one camera for all."""
    recordings = [_panoramas(home, n, WIDTH) for n in range(2)]
    return _error(refine_recordings(recordings, home.folder / "alike", SETTINGS), home)


@pytest.fixture(scope="module")
def sizes(home: Home) -> RunResult:
    """A recording at 512 pixels and one at 384."""
    formats = {"formats": ("colmap", "colmap-erp", "nerfstudio", "metashape")}
    recordings = [_panoramas(home, 0, WIDTH), _panoramas(home, 1, SMALL)]
    return refine_recordings(recordings, home.folder / "sizes", _settings(export=formats))


def test_pictures_of_two_sizes_make_one_map(sizes: RunResult, alike: float, home: Home) -> None:
    assert [kind.width for kind in sizes.frames.formats] == [WIDTH, SMALL]
    assert _error(sizes, home) < 1.5 * alike
    _, frames = load_run(sizes.out)
    assert frames.camera_of_frame == (0,) * NUM + (1,) * NUM


def test_colmap_has_a_rig_for_each_camera(sizes: RunResult) -> None:
    model = pycolmap.Reconstruction(str(sizes.out / "colmap/sparse/0"))
    assert len(model.rigs) == 2 and len(model.cameras) == 12 and len(model.images) == 12 * NUM
    widths = {camera.width for camera in model.cameras.values()}
    assert widths == {WIDTH // 4, SMALL // 4}
    for image in model.images.values():
        pixels = _read(sizes.out / "colmap/images" / image.name)
        camera = model.cameras[image.camera_id]
        assert pixels.shape[:2] == (camera.height, camera.width)
        assert camera.width == (WIDTH if "/stitched0at512/" in image.name else SMALL) // 4
    errors = [point.error for point in model.points3D.values()]
    assert np.median(errors) < 1.0  # pixels
    configs = json.loads((sizes.out / "colmap/rig_config.json").read_text())
    prefixes = [camera["image_prefix"] for config in configs for camera in config["cameras"]]
    assert len(configs) == 2 and prefixes[6:7] == ["front/stitched1at384/"]
    assert all(sum(image.name.startswith(prefix) for prefix in prefixes) == 1
               for image in model.images.values())  # fmt: skip


def test_other_formats_state_the_size_of_each_image(sizes: RunResult) -> None:
    erp = pycolmap.Reconstruction(str(sizes.out / "colmap-erp/sparse/0"))
    assert sorted(camera.width for camera in erp.cameras.values()) == [SMALL, WIDTH]
    for name, key in (("transforms.json", 4), ("transforms_erp.json", 1)):
        tree = json.loads((sizes.out / "nerfstudio" / name).read_text())
        for entry in tree["frames"]:
            pixels = _read(sizes.out / "nerfstudio" / entry["file_path"])
            assert pixels.shape[1] == entry["w"] in (WIDTH // key, SMALL // key)
    tree = ET.parse(sizes.out / "metashape/cameras.xml").getroot()
    widths = {
        sensor.get("id"): int(sensor.find("resolution").get("width"))  # type: ignore[union-attr]
        for sensor in tree.iter("sensor")
    }
    assert sorted(widths.values()) == [SMALL, WIDTH]
    for camera in tree.iter("camera"):
        path = next((sizes.out / "metashape/images").rglob(f"{camera.get('label')}.jpg"))
        assert path.is_file()


def test_poses_and_the_report_have_all_frames(sizes: RunResult) -> None:
    with (sizes.out / "poses.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 2 * NUM
    assert (sizes.out / "report.html").is_file()


def test_stitched_panoramas_and_cube_faces_make_one_map(home: Home, alike: float) -> None:
    recordings = [_panoramas(home, 0, WIDTH), _faces(home)]
    settings = _settings(export={"formats": ("colmap-flat",)})
    result = refine_recordings(recordings, home.folder / "cube", settings)
    assert [kind.layout for kind in result.frames.formats] == ["erp", "cube"]
    assert _error(result, home) < 1.5 * alike
    model = pycolmap.Reconstruction(str(result.out / "colmap-flat/sparse/0"))
    assert len(model.images) == 12 * NUM
    with pytest.raises(GsbaError, match="needs panoramas"):
        given = _settings(export={"formats": ("colmap-erp",), "images": "panorama"})
        refine_recordings(recordings, home.folder / "cube", given)


def test_stitched_panoramas_and_raw_fisheyes_make_one_map(home: Home) -> None:
    recordings = [_panoramas(home, 0, WIDTH), _fisheyes(home)]
    settings = _settings(export={"formats": ("colmap",)})
    result = refine_recordings(recordings, home.folder / "fisheyes", settings)
    assert [kind.layout for kind in result.frames.formats] == ["erp", "fisheye"]
    # The raw pictures are coarser, and resampled twice: .0018 to .0020 with three seeds. One camera
    # for all scatters from .0006 to .0011, too widely for a ratio.
    assert _error(result, home) < 0.003
    model = pycolmap.Reconstruction(str(result.out / "colmap/sparse/0"))
    assert len(model.rigs) == 2 and len(model.frames) == 2 * NUM


def test_families_of_whole_pictures_are_refused_in_one_line(home: Home) -> None:
    recordings = [_panoramas(home, 0, WIDTH), _panoramas(home, 1, SMALL)]
    settings = RefineSettings.model_validate(
        SETTINGS.model_dump() | {"factors": ("bearing", "photometric")}
    )
    with pytest.raises(GsbaError, match="compares pictures of one size"):
        refine_recordings(recordings, home.folder / "refused", settings)
