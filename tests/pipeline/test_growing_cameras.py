"""Finished runs that grow by panoramas of their cameras or of others, and are taken apart."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from accuracy import assert_as_accurate, predicted_error
from cameras_home import NUM, SMALL, WIDTH, Home, beginning, error_of, panoramas
from command import succeed
from growing_home import FIRST
from tiny_run import PLAIN

from factors.sphere_field import SphereField, num_harmonics
from gsba import Localizer, add_recordings, load_run, remove_recordings
from gsba.bundle.stitching import Stitching
from gsba.frames.scan import scan
from gsba.log import GsbaError
from gsba.pipeline.finished_run import FinishedRun
from gsba.pipeline.joint_cameras import as_read_by
from gsba.pipeline.refine import refine_each
from gsba.types import Counts, FrameSet

# Error that a run of the second recording at 384 pixels predicts; it scatters by a twentieth.
SMALL_ALONE = 0.00165


@pytest.fixture(scope="module")
def sizes(two_sizes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two recordings of two sizes, made at once."""
    return Path(shutil.copytree(two_sizes, tmp_path_factory.mktemp("two") / "sizes"))


def _widths(run: Path) -> dict[str, int]:
    """Width of the pictures of each recording, as frames are stored."""
    frames = load_run(run)[1]
    return {name: frames.format_of(int(rows[0])).width for name, rows in frames.recordings.items()}


@pytest.fixture(scope="module")
def grown(single_run: Path, home: Home) -> Path:
    """The second recording added to the first one's run from the command line."""
    out, small = home.folder / "grown", panoramas(home, 1, SMALL)
    words = ["add", str(single_run), str(small.frames), str(small.trajectory), "--out", str(out)]
    succeed("--quiet", *words)
    return out


def test_a_run_grows_by_a_camera_of_its_own(grown: Path, sizes: Path, home: Home) -> None:
    assert _widths(grown) == {FIRST: WIDTH, "stitched1at384": SMALL}
    assert_as_accurate(grown, error_of(grown, home), sizes, 1.25)
    cameras = json.loads((grown / "report.json").read_text())["cameras"]
    assert [one["recordings"] for one in cameras] == [[FIRST], ["stitched1at384"]]
    path = Path(panoramas(home, 1, SMALL).frames) / "000003.jpg"
    found, own = Localizer(grown).localize(path), load_run(grown)[0].world_T_rigs[NUM + 3]
    assert found.found and np.linalg.norm(found.world_T_rig[:3, 3] - own[:3, 3]) < 0.02


def test_recordings_join_the_cameras_that_a_run_has(
    sizes: Path, home: Home, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    result = add_recordings(sizes, [panoramas(home, 1, WIDTH)], out)
    assert result.frames.camera_of_frame == (0,) * NUM + (1,) * NUM + (0,) * NUM
    # A run of all three at once predicts 0.75 of the error of two: 1.25 times as much is allowed.
    assert_as_accurate(out, error_of(out, home), sizes, 0.94)
    assert (out / "colmap-flat/images").is_dir()


@pytest.mark.slow
def test_a_camera_goes_with_its_recordings(
    grown: Path, single_run: Path, home: Home, tmp_path: Path
) -> None:
    names = list(_widths(grown))
    runs = [tmp_path / f"without{gone}" for gone in range(2)]
    for gone, alone in enumerate((SMALL_ALONE, predicted_error(single_run))):
        remove_recordings(grown, [names[gone]], runs[gone])
        assert _widths(runs[gone]) == {names[1 - gone]: (SMALL, WIDTH)[gone]}
        assert "cameras" not in json.loads((runs[gone] / "report.json").read_text())
        predicted = predicted_error(runs[gone])
        assert predicted < 1.25 * alone and error_of(runs[gone], home) < 4 * predicted
    # The remaining run grows again: its features were extracted beside those of another camera.
    again = tmp_path / "again"
    add_recordings(runs[0], [panoramas(home, 0, WIDTH)], again)
    assert_as_accurate(again, error_of(again, home), grown, 1.25)


def test_a_run_with_a_field_of_stitching_errors_takes_no_other_camera(
    single_run: Path, home: Home
) -> None:
    run = FinishedRun.load(single_run)
    field = SphereField(np.full(num_harmonics(2), 1e-4))
    found = Stitching(field, run.map.solution, run.map.observed, 2, np.ones(4), Counts(1, 1, "o"))
    bent = replace(run, map=replace(run.map, stitching=found))
    small, same = (scan(Path(panoramas(home, 1, width).frames)) for width in (SMALL, WIDTH))
    with pytest.raises(GsbaError, match="corrects errors of stitching by a field"):
        as_read_by(bent, {"small": small}, {"small": None})
    ((frames, _),) = as_read_by(bent, {"same": same}, {"same": None}).values()
    assert frames is same


def test_recordings_of_two_models_have_two_cameras(home: Home, tmp_path: Path) -> None:
    run, num = tmp_path / "run", 6
    first, second = (
        beginning(panoramas(home, n, WIDTH), num, tmp_path / f"recording{n}") for n in range(2)
    )
    camera = PLAIN.camera.model_copy(update={"name": "insta360-x3"})
    refine_each([first], run, PLAIN.model_copy(update={"camera": camera}))
    call = f"{second.frames},trajectory={second.trajectory},camera=gopro-max"
    succeed("--quiet", "add", run, "--recording", call)
    frames: FrameSet = load_run(run)[1]
    assert frames.camera_of_frame == (0,) * num + (1,) * num
    names = [one.name for one in FinishedRun.load(run).camera_settings]
    assert names == ["insta360-x3", "gopro-max"]
