"""Pictures localised in runs of several cameras: each by the lenses of the camera of its size."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from cameras_home import NUM, SMALL, WIDTH, Home, faces, fisheyes, panoramas, read
from command import run_gsba, succeed

from gsba import GsbaError, Localizer
from gsba.store.finished import load_run


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
    assert "small: not localised: " in run_gsba(*call).output
    succeed(*call, "--camera-of", f"stitched0at{WIDTH}")
    (told,) = json.loads((tmp_path / "out/localized.json").read_text())["pictures"]
    assert _distance(sizes, 4, np.array(told["world_T_picture"])) < 0.02
    missing = run_gsba(*call, "--camera-of", "attic")
    assert missing.exit_code == 1 and "has no recording 'attic' in this map" in missing.output


@pytest.mark.parametrize("kind", ["fisheyes", "faces"])
def test_raw_fisheyes_and_faces_are_localised_beside_panoramas(
    kind: str, home: Home, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    out = Path(shutil.copytree(request.getfixturevalue(f"{kind}_run"), tmp_path / "run"))
    source = Path((fisheyes if kind == "fisheyes" else faces)(home).frames)
    for path in source.glob("*/00000[36].png"):
        (tmp_path / "new" / path.parent.name).mkdir(parents=True, exist_ok=True)
        shutil.copy(path, tmp_path / "new" / path.parent.name)
    call = ["localize", str(out), str(tmp_path / "new"), "--out", str(tmp_path / "found")]
    succeed(*call)
    told = json.loads((tmp_path / "found/localized.json").read_text())["pictures"]
    for frame, one in zip((3, 6), told, strict=True):
        assert _distance(out, NUM + frame, np.array(one["world_T_picture"])) < 0.02
