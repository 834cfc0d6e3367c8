"""Recordings of one place by different cameras in one run: sizes, layouts, calibrations."""

import csv
import json
import shutil
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from accuracy import assert_as_accurate, predicted_error
from cameras_home import NUM, SMALL, WIDTH, Home, error_of, faces, panoramas, read
from tiny_run import SETTINGS, exporting

from gsba import RunResult, refine_recordings
from gsba.config import RefineSettings
from gsba.log import GsbaError
from gsba.store.finished import load_run

# Error that a run of both recordings at 384 pixels predicts; it scatters by a twentieth.
COARSER = 0.00083


@pytest.fixture(scope="module")
def sizes(two_sizes: Path, home: Home, tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """A recording at 512 pixels and one at 384, in several formats."""
    out = Path(shutil.copytree(two_sizes, tmp_path_factory.mktemp("several") / "sizes"))
    settings = exporting("colmap", "colmap-erp", "nerfstudio", "metashape")
    recordings = [panoramas(home, 0, WIDTH), panoramas(home, 1, SMALL)]
    return refine_recordings(recordings, out, settings)


def test_pictures_of_two_sizes_make_one_map(sizes: RunResult, home: Home) -> None:
    assert [kind.width for kind in sizes.frames.formats] == [WIDTH, SMALL]
    error, predicted = error_of(sizes.out, home), predicted_error(sizes.out)
    assert predicted < 1.25 * COARSER and error < 4 * predicted
    _, frames = load_run(sizes.out)
    assert frames.camera_of_frame == (0,) * NUM + (1,) * NUM


def test_colmap_has_a_rig_for_each_camera(sizes: RunResult) -> None:
    model = pycolmap.Reconstruction(str(sizes.out / "colmap/sparse/0"))
    assert len(model.rigs) == 2 and len(model.cameras) == 12 and len(model.images) == 12 * NUM
    widths = {camera.width for camera in model.cameras.values()}
    assert widths == {WIDTH // 4, SMALL // 4}
    for image in model.images.values():
        pixels = read(sizes.out / "colmap/images" / image.name)
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
            pixels = read(sizes.out / "nerfstudio" / entry["file_path"])
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


def test_stitched_panoramas_and_cube_faces_make_one_map(
    home: Home, faces_run: Path, two_sizes: Path, tmp_path: Path
) -> None:
    assert [kind.layout for kind in load_run(faces_run)[1].formats] == ["erp", "cube"]
    assert_as_accurate(faces_run, error_of(faces_run, home), two_sizes, 1.25)
    model = pycolmap.Reconstruction(str(faces_run / "colmap-flat/sparse/0"))
    assert len(model.images) == 12 * NUM - 3  # 15 faces of three held-out frames beside 102 others
    with pytest.raises(GsbaError, match="needs panoramas"):
        given = exporting("colmap-erp", images="panorama")
        recordings = [panoramas(home, 0, WIDTH), faces(home)]
        refine_recordings(recordings, shutil.copytree(faces_run, tmp_path / "run"), given)


def test_stitched_panoramas_and_raw_fisheyes_make_one_map(home: Home, fisheyes_run: Path) -> None:
    assert [kind.layout for kind in load_run(fisheyes_run)[1].formats] == ["erp", "fisheye"]
    # The raw pictures are coarser, and resampled twice: .0018 to .0020 with three seeds. One camera
    # for all scatters from .0006 to .0011, too widely for a ratio.
    assert error_of(fisheyes_run, home) < 0.003
    assert (fisheyes_run / "calibration@raw.json").is_file()
    model = pycolmap.Reconstruction(str(fisheyes_run / "colmap/sparse/0"))
    assert len(model.rigs) == 2 and len(model.frames) == 2 * NUM


def test_families_of_whole_pictures_are_refused_in_one_line(home: Home) -> None:
    recordings = [panoramas(home, 0, WIDTH), panoramas(home, 1, SMALL)]
    settings = RefineSettings.model_validate(
        SETTINGS.model_dump() | {"factors": ("bearing", "photometric")}
    )
    with pytest.raises(GsbaError, match="compares pictures of one size"):
        refine_recordings(recordings, home.folder / "refused", settings)
