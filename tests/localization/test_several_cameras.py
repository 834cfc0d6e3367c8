"""Pictures localised in runs of several cameras: each by the lenses of the camera of its size."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from cameras_home import (
    NUM,
    SMALL,
    WIDTH,
    Home,
    faces,
    fisheyes,
    panoramas,
    read,
    settings_with,
)
from typer.testing import CliRunner

from gsba import GsbaError, Localizer, refine_recordings
from gsba.cli import app
from gsba.store.finished import load_run


@pytest.fixture(scope="module")
def home(cameras_home: Home) -> Home:
    return cameras_home


@pytest.fixture(scope="module")
def sizes(two_sizes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of panoramas of two sizes."""
    return Path(shutil.copytree(two_sizes, tmp_path_factory.mktemp("localized") / "sizes"))


def _distance(run: Path, frame: int, pose: np.ndarray) -> float:
    own = load_run(run)[0].world_T_rigs[frame]
    return float(np.linalg.norm(pose[:3, 3] - own[:3, 3]))


@pytest.mark.parametrize("precise", [False, True])
def test_pictures_of_each_size_are_found_where_their_frames_are(
    precise: bool, sizes: Path, home: Home
) -> None:
    localizer = Localizer(sizes, precise=precise)
    for which, width in ((0, WIDTH), (1, SMALL)):
        path = Path(panoramas(home, which, width).frames) / "000004.jpg"
        assert localizer.cameras.of_panorama(width, width // 2, "x") == which
        found = localizer.localize(path)
        assert found.found, found.reason
        assert _distance(sizes, which * NUM + 4, found.world_T_rig) < 0.01


def test_a_size_of_no_camera_is_refused_unless_the_camera_is_named(
    sizes: Path, home: Home, tmp_path: Path
) -> None:
    small = tmp_path / "small.png"
    cv2.imwrite(str(small), cv2.resize(read(home.pictures[0][4]), (448, 224)))
    with pytest.raises(
        GsbaError, match=r"is 448x224; the run's cameras have erp 512x256 .*384x192"
    ):
        Localizer(sizes).localize(small)
    call = ["localize", str(sizes), str(small), "--out", str(tmp_path / "out")]
    assert "small: not localised: " in CliRunner().invoke(app, call).output
    named = CliRunner().invoke(app, [*call, "--camera-of", f"stitched0at{WIDTH}"])
    assert named.exit_code == 0, named.output
    (told,) = json.loads((tmp_path / "out/localized.json").read_text())["pictures"]
    assert _distance(sizes, 4, np.array(told["world_T_picture"])) < 0.02
    missing = CliRunner().invoke(app, [*call, "--camera-of", "attic"])
    assert missing.exit_code == 1 and "has no recording 'attic' in this map" in missing.output


def test_raw_fisheyes_and_faces_are_localised_beside_panoramas(home: Home, tmp_path: Path) -> None:
    out = tmp_path / "run"
    raw, cube = fisheyes(home), faces(home)
    recordings = [panoramas(home, 0, WIDTH), raw, cube]
    refine_recordings(recordings, out, settings_with(export={"formats": ()}))
    new = tmp_path / "new"
    for source, parts in ((raw, ("front", "back")), (cube, ("front", "left", "up"))):
        folder = new / Path(source.frames).name
        for name in (
            parts if source is raw else [p.name for p in Path(cube.frames).iterdir() if p.is_dir()]
        ):
            (folder / name).mkdir(parents=True)
            for frame in (3, 6):
                file = f"{frame:06d}.png"
                shutil.copy(Path(source.frames) / name / file, folder / name / file)
    for folder, first in ((new / "raw", NUM), (new / "faces", 2 * NUM)):
        call = ["localize", str(out), str(folder), "--out", str(tmp_path / folder.name)]
        result = CliRunner().invoke(app, call)
        assert result.exit_code == 0, result.output
        told = json.loads((tmp_path / folder.name / "localized.json").read_text())["pictures"]
        for frame, one in zip((3, 6), told, strict=True):
            assert _distance(out, first + frame, np.array(one["world_T_picture"])) < 0.02
