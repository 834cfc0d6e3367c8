"""The whole line on bad trajectories: displaced frames, gaps, none at all."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny_run import PLAIN, Case

from gsba import refine
from gsba.bundle import triangulation
from gsba.evaluate.trajectory import evaluate
from gsba.geometry import pose
from gsba.log import GsbaError
from gsba.pipeline import RunResult
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import PoseStatus, Trajectory

PATCHED = 1 / 3  # error with patches, a share of that without


@pytest.fixture
def plain(case: Case, plain_run: Path) -> Case:
    """The walk and its run without patches, as all runs of these tests are."""
    return replace(case, out=plain_run)


def _refine(case: Case, folder: Path, trajectory: Trajectory | None) -> RunResult:
    slam = None
    if trajectory is not None:
        slam = folder / "slam.tum"
        write_tum(slam, trajectory)
    return refine(case.frames, slam, folder / "run", PLAIN)


def test_a_displaced_frame_is_named_and_repaired(plain: Case, tmp_path: Path) -> None:
    slam = read_trajectory(plain.slam)
    poses = slam.world_T_rigs.copy()
    turn = Rotation.from_rotvec([0, np.deg2rad(15), 0]).as_matrix()
    poses[4] = poses[4] @ pose(turn, np.array([0.4, 0.3, 0.0]))
    result = _refine(plain, tmp_path, Trajectory(slam.timestamps, poses))
    assert result.report["trajectory"]["false_frames"] == ["000004"]
    assert any("000004" in note and "not used" in note for note in result.report["notes"])
    plain.assert_as_good(tmp_path / "run", PATCHED)


def test_no_trajectory_will_do(plain: Case, tmp_path: Path) -> None:
    result = _refine(plain, tmp_path, None)
    assert (result.reconstruction.pose_statuses == PoseStatus.REFINED).all()
    assert result.report["gauge"].startswith("no trajectory")
    assert any(note.startswith("started from pairs") for note in result.report["notes"])
    plain.assert_as_good(tmp_path / "run", PATCHED)


@pytest.mark.slow
def test_two_poses_carry_the_rest(plain: Case, tmp_path: Path) -> None:
    slam = read_trajectory(plain.slam)
    _refine(plain, tmp_path, Trajectory(slam.timestamps[:2], slam.world_T_rigs[:2]))
    plain.assert_as_good(tmp_path / "run", PATCHED)


def test_a_trajectory_in_other_axes_is_refused(plain: Case, tmp_path: Path) -> None:
    slam = read_trajectory(plain.slam)
    flip = np.diag([1.0, -1, -1, 1])
    with pytest.raises(GsbaError, match="--trajectory-format right-up-back"):
        _refine(plain, tmp_path, Trajectory(slam.timestamps, flip @ slam.world_T_rigs @ flip))
    assert not (tmp_path / "run/trajectory.tum").exists()


def test_a_clock_that_is_off_is_set_right(plain: Case, tmp_path: Path) -> None:
    slam = read_trajectory(plain.slam)
    shifted = Trajectory(0.7 + 1.01 * slam.timestamps, slam.world_T_rigs)
    result = _refine(plain, tmp_path, shifted)
    clock = result.report["trajectory"]["clock"]
    assert clock["verdict"] == "corrected" and clock["note"] in result.report["notes"]
    assert clock["offset_s"] == pytest.approx(0.7, abs=0.05)  # a tenth of the frames' interval
    plain.assert_as_good(tmp_path / "run", PATCHED)


def test_the_truth_needs_no_repair(plain: Case, tmp_path: Path) -> None:
    result = _refine(plain, tmp_path, plain.truth)
    judgement = result.report["trajectory"]
    assert not any(judgement[name] for name in ("false_frames", "false_steps", "unseen_steps"))
    assert judgement["clock"]["verdict"] != "corrected" and judgement["clock"]["offset_s"] == 0
    assert evaluate(read_trajectory(tmp_path / "run/trajectory.tum"), plain.truth).ate.rmse < 0.02


def test_a_map_without_points_is_refused_at_once(
    plain: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing can be registered against it, and trying takes minutes."""
    monkeypatch.setattr(triangulation, "_MIN_TRACK_LENGTH", 200)
    with pytest.raises(GsbaError, match="no scene point is seen from enough frames"):
        refine(plain.frames, plain.slam, tmp_path / "run", PLAIN)
