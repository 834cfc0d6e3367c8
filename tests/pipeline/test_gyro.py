"""A run with the readings of a gyro that rode along, and with readings of something else."""

import json
import shutil
from pathlib import Path

import insta360_files as made
import numpy as np
import pytest
from command import run_gsba
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline
from tiny_run import PLAIN, Case, computed_stages

from gsba.imu.readings import Readings
from gsba.log import GsbaError
from gsba.pipeline.inputs import read_gyro
from gsba.types import Trajectory

IMU_R_RIG = Rotation.from_rotvec([0.4, 2.0, -0.8]).as_matrix()
OFFSET_S, BIAS = -41.3, np.array([0.01, -0.02, 0.015])  # of its clock; rad/s


def _write(path: Path, on: Trajectory, seed: int = 0) -> Path:
    """A table of readings on a smooth way through poses, and for a while before and after."""
    np.savetxt(path, _readings(on, seed), delimiter=",", fmt="%.9g")
    return path


def _readings(on: Trajectory, seed: int = 0) -> np.ndarray:
    """Times, rates and forces (n, 7), as `_write` writes them."""
    rng, times = np.random.default_rng(seed), on.timestamps
    fine = np.arange(times[0] - 1, times[-1] + 1, 0.01)
    inside = np.clip(fine, times[0], times[-1])
    turned = RotationSpline(times, Rotation.from_matrix(on.world_T_rigs[:, :3, :3]))
    rates = turned(inside, 1) * ((fine > times[0]) & (fine < times[-1]))[:, None]
    moved = CubicSpline(times, on.world_T_rigs[:, :3, 3])(inside, 2)
    forces = turned(inside).inv().apply(moved - np.array([0, 9.80665, 0]))  # y is down
    rates = rates @ IMU_R_RIG.T + BIAS + rng.normal(0, 1e-3, rates.shape)
    return np.column_stack([fine + OFFSET_S, rates, forces @ IMU_R_RIG.T])


def test_a_gyro_is_aligned_and_frames_turn_as_it_says(
    case: Case, plain_run: Path, tmp_path: Path
) -> None:
    out = Path(shutil.copytree(plain_run, tmp_path / "run"))
    readings = _write(tmp_path / "imu.csv", case.truth)
    result = case.refine(out, PLAIN, imu=readings)
    report = json.loads((out / "report.json").read_text())
    said = report["gyro"]
    assert said["taken"] and said["steps_used"] == 1 and said["during_readout"] is None
    assert said["offset_s"] == pytest.approx(OFFSET_S, abs=0.01)
    np.testing.assert_allclose(np.deg2rad(said["bias_deg_per_s"]), BIAS, atol=2e-3)
    off = Rotation.from_matrix(np.array(said["rig_R_imu"]) @ IMU_R_RIG).magnitude()
    assert np.rad2deg(off) < 2
    assert any("the gyro agrees with 100 %" in note for note in report["notes"])
    assert "the gyro agrees with 100 %" in (out / "report.html").read_text()
    turned = [case.errors(run).rpe_rotation_deg.rmse for run in (out, plain_run)]
    assert turned[0] < 0.9 * turned[1]
    vertical, found = result.reconstruction.vertical, result.reconstruction.world_T_rigs
    # It walks off from rest, as the spline has it: on average that looks like a slope of a degree.
    true = case.truth.world_T_rigs[0, :3, :3] @ found[0, :3, :3].T @ vertical
    assert true @ [0, -1, 0] > np.cos(np.deg2rad(3))
    again = case.refine(out, PLAIN, imu=readings)
    assert not computed_stages(again)


def test_a_camera_s_own_readings_are_aligned(case: Case, plain_run: Path, tmp_path: Path) -> None:
    """In the trailer of an Insta360, as whole numbers, on a clock from the first frame."""
    table = _readings(case.truth)
    begin_us = 7_000_000
    ticks = np.rint(1e6 * (table[:, 0] - OFFSET_S - case.truth.timestamps[0])).astype(int)
    record = made.raw_gyro(begin_us + ticks, table[:, 1:4], table[:, 4:] / 9.80665)
    path, out = tmp_path / "v.insv", Path(shutil.copytree(plain_run, tmp_path / "run"))
    metadata = made.metadata(first_frame=begin_us)
    path.write_bytes(made.trailer(((0, made.GYRO, record), (1, made.METADATA, metadata))))
    case.refine(out, PLAIN, imu=path)
    said = json.loads((out / "report.json").read_text())["gyro"]
    assert said["taken"]
    assert said["offset_s"] == pytest.approx(-case.truth.timestamps[0], abs=0.01)
    np.testing.assert_allclose(np.deg2rad(said["bias_deg_per_s"]), BIAS, atol=2e-3)
    off = Rotation.from_matrix(np.array(said["rig_R_imu"]) @ IMU_R_RIG).magnitude()
    assert np.rad2deg(off) < 2
    turned = [case.errors(run).rpe_rotation_deg.rmse for run in (out, plain_run)]
    assert turned[0] < 0.9 * turned[1]


def test_readings_of_another_walk_change_nothing(
    case: Case, plain_run: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    poses = case.truth.world_T_rigs.copy()
    turns = np.random.default_rng(0).normal(0, 0.03, (len(poses), 3))
    poses[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    out = tmp_path / "run"
    case.refine(
        out, PLAIN, imu=_write(tmp_path / "imu.csv", Trajectory(case.truth.timestamps, poses))
    )
    said = json.loads((out / "report.json").read_text())["gyro"]
    assert not said["taken"] and said["reason"]
    assert f"the gyro was not used: {said['reason']}" in caplog.text
    for name in ("trajectory.tum", "poses.csv", "points.ply"):
        assert (out / name).read_bytes() == (plain_run / name).read_bytes()


def test_readings_that_cannot_be_used_are_refused_before_anything_is_written(
    case: Case, tmp_path: Path
) -> None:
    imu, out = tmp_path / "imu.csv", tmp_path / "run"
    imu.write_text("t,gyro_x,gyro_y\n0,1,2\n")
    asked = ["refine", case.frames, case.slam, "--out", out, "--imu", imu]
    result = run_gsba(*asked)
    assert result.exit_code == 1
    assert (
        result.output.strip()
        .splitlines()[-1]
        .endswith("no column is gyro_z: name them t, gyro_x, gyro_y, gyro_z, acc_x, acc_y, acc_z")
    )
    assert not out.exists()


def test_a_raw_video_gives_its_own_readings_or_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Of two files the first lens's holds them."""
    asked, found = [], Readings(np.arange(10) / 100, np.zeros((10, 3)))

    def read(path: Path, lasting_s: float | None) -> Readings:
        assert lasting_s is None  # these are no videos
        asked.append(path.name)
        if "_00_" not in path.name:
            raise GsbaError(f"{path}: no gyro in it")
        return found

    monkeypatch.setattr("gsba.pipeline.inputs.read_telemetry", read)
    names = "walk_00_1.insv", "walk_10_1.insv", "other.insv", "stitched.mp4"
    for name in (*names, "GS010001.360", "GPFR0001.MP4", "GPBK0001.MP4"):
        (tmp_path / name).write_bytes(b"")
    caplog.set_level("INFO")
    assert read_gyro(None, tmp_path / "walk_10_1.insv") is found
    assert read_gyro(None, tmp_path / "other.insv") is None
    assert "no gyro: " in caplog.text and "no gyro in it" in caplog.text
    assert read_gyro(None, tmp_path / "stitched.mp4") is None
    assert read_gyro(None, tmp_path) is None
    assert read_gyro(None, tmp_path / "GS010001.360") is None
    assert read_gyro(None, tmp_path / "GPBK0001.MP4") is None
    fusion = ["GPFR0001.MP4", "GPBK0001.MP4"]  # either may hold it
    assert asked == ["walk_00_1.insv", "other.insv", "GS010001.360", *fusion]
