"""Finished runs of panoramas and of raw fisheyes that grow by one another, and are merged."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from accuracy import assert_as_accurate
from cameras_home import NUM, Home, error_of, fisheyes
from tiny_run import BARE

from gsba import add_recordings, load_run, merge_runs
from gsba.frames.scan import scan
from gsba.pipeline.finished_run import FinishedRun
from gsba.pipeline.joint_cameras import as_read_by
from gsba.pipeline.refine import refine_each


@pytest.mark.slow
def test_fixed_poses_of_a_run_of_several_cameras_stay(
    two_sizes: Path, home: Home, tmp_path: Path
) -> None:
    sizes = Path(shutil.copytree(two_sizes, tmp_path / "sizes"))
    out = tmp_path / "run"
    add_recordings(sizes, [fisheyes(home)], out, fixed=True)
    before, after = load_run(sizes)[0], load_run(out)[0]
    assert after.world_T_rigs[: 2 * NUM].tobytes() == before.world_T_rigs.tobytes()
    assert after.pose_covariances[: 2 * NUM].tobytes() == before.pose_covariances.tobytes()
    kept = "trajectories/stitched0at512.tum"
    assert (out / kept).read_bytes() == (sizes / kept).read_bytes()
    assert after.num_maps == 1
    assert [kind.layout for kind in load_run(out)[1].formats] == ["erp", "erp", "fisheye"]
    assert_as_accurate(out, error_of(out, home), sizes, 1.25)


@pytest.fixture(scope="module")
def raw(home: Home) -> Path:
    """A run of the second recording as raw fisheyes."""
    out = home.folder / "raw_run"
    refine_each([fisheyes(home)], out, BARE)
    return out


@pytest.mark.slow
def test_raw_fisheyes_grow_by_recordings_of_their_calibration(
    raw: Path, home: Home, tmp_path: Path
) -> None:
    """Without a calibration of their own they are read by that of the run."""
    run, given, out = FinishedRun.load(raw), fisheyes(home, 0), tmp_path / "run"
    result = add_recordings(raw, [replace(given, calibration=None)], out)
    (kind,) = result.frames.formats  # they share the camera
    assert kind.layout == "fisheye" and kind.fisheyes == run.frames.format.fisheyes
    assert error_of(out, home) < 0.003
    assert (out / "calibration.json").is_file()
    folder = Path(given.frames)
    found = {"with": scan(folder, calibration=given.calibration), "without": scan(folder)}
    read = as_read_by(run, found, dict.fromkeys(found))
    assert read["with"][0].formats == read["without"][0].formats == (kind,)
    assert read["with"][1] == read["without"][1]


@pytest.mark.slow
def test_runs_of_different_cameras_are_merged(
    single_run: Path, raw: Path, home: Home, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    merge_runs([single_run, raw], out)
    assert [kind.layout for kind in load_run(out)[1].formats] == ["erp", "fisheye"]
    assert error_of(out, home) < 0.003  # as of one solution, see test_several_cameras.py
    assert (out / "calibration@raw.json").is_file()
