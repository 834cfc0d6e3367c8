"""`gsba demo --video`: a filmed walk, refined without a trajectory."""

import sys
from pathlib import Path

import numpy as np
import pytest
from command import fails, run_gsba, succeed

from gsba.demo.walk import FPS, WHOLE_WALK, walk_poses
from gsba.trajectory.files import read_trajectory


def test_a_denser_walk_sways_as_fast() -> None:
    """Four poses in the time of one: every fourth is the same."""
    sparse = walk_poses("rectangle", "locked", 60, 3)
    dense = walk_poses("rectangle", "locked", 240, 3, 8.0)
    np.testing.assert_allclose(dense.timestamps[::4], sparse.timestamps)
    turned = sparse.world_T_rigs[:, :3, :3]
    np.testing.assert_allclose(dense.world_T_rigs[::4, :3, :3], turned, atol=1e-12)


def test_steps_are_as_short_as_odometry_needs() -> None:
    positions = walk_poses("rectangle", "locked", WHOLE_WALK, 0, FPS).world_T_rigs[:, :3, 3]
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1).max() < 0.15


def test_a_video_is_filmed_and_refined_without_a_trajectory(tmp_path: Path) -> None:
    pytest.importorskip("av", reason="PyAV is not installed")
    out = tmp_path / "demo"
    small = ["-q", "demo", "--video", "--frames", "14", "--width", "384", "--out", str(out)]
    result = succeed(*small)
    rows = {line.split()[0]: line.split() for line in result.stdout.splitlines()}
    assert rows["odometry"][1] == "14/14" and float(rows["odometry"][2]) < 0.02
    count, of = rows["refined"][1].split("/")
    assert count == of and float(rows["refined"][2]) < 0.005
    assert f"{of} of 14 frames of the video were refined" in result.stdout
    truth = read_trajectory(out / "walk/groundtruth.tum")
    np.testing.assert_allclose(truth.timestamps, np.arange(14) / FPS)
    assert sorted(path.name for path in (out / "walk").iterdir()) == ["groundtruth.tum", "walk.mp4"]
    assert (out / "run/report.html").is_file() and (out / "run/colmap").is_dir()


def test_what_cannot_be_filmed_is_refused_in_one_line(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    for options, said in (
        (["--mesh", "scene.glb"], "leave out --mesh"),
        (["--frames", "2"], "2 frames"),
        (["--camera", "nonsense"], "'nonsense'"),
    ):
        fails(run_gsba("demo", "--video", "--out", out, *options), said)
    assert not out.exists()


def test_without_pyav_a_line_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)  # as if it were not installed
    result = run_gsba("demo", "--video", "--out", tmp_path / "demo")
    fails(result, "pip install 'gsba[video]'")
    assert not (tmp_path / "demo").exists()
