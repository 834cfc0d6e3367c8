"""report.json and poses.csv of a small world whose numbers are known."""

import csv
import json
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from plain_records import frames_of, map_of
from synthetic import unit

from gsba.config import RefineSettings
from gsba.disk import write_json
from gsba.geometry import inverse, pose, rotation_from_quaternion
from gsba.report.report import (
    Findings,
    StageLog,
    angular_residuals,
    build_report,
    frame_quality,
    median_residual_deg,
    write_poses,
)
from gsba.store.store import StageRecord
from gsba.types import (
    CoarsePoses,
    Counts,
    FrameSet,
    PictureFormat,
    PoseSource,
    PoseStatus,
    Reconstruction,
)

NUM_FRAMES, NUM_POINTS, ERROR_DEG = 4, 20, 0.25


@dataclass(frozen=True)
class _Iteration:
    costs: dict[str, float]
    damping: float


def _world() -> tuple[FrameSet, CoarsePoses, Reconstruction]:
    """Frames 0..2 see all points, each bearing off by ERROR_DEG; frame 3 sees nothing."""
    rng = np.random.default_rng(1)
    wxyz = unit(rng.normal(size=(NUM_FRAMES, 4)))
    world_T_rigs = pose(rotation_from_quaternion(wxyz), rng.normal(size=(NUM_FRAMES, 3)))
    points_world = 5 * rng.normal(size=(NUM_POINTS, 3))
    observation_points = np.repeat(np.arange(NUM_POINTS), 3)
    observation_frames = np.tile(np.arange(3), NUM_POINTS)
    rig_T_worlds = inverse(world_T_rigs)[observation_frames]
    points_rig = np.einsum("oij,oj->oi", rig_T_worlds[:, :3, :3], points_world[observation_points])
    bearings = unit(points_rig + rig_T_worlds[:, :3, 3])
    sideways = unit(np.cross(bearings, rng.normal(size=bearings.shape)))
    angle = np.radians(ERROR_DEG)
    covariances = np.tile(np.diag([1e-6, 4e-6, 9e-6, 1.0, 4.0, 9.0]), (NUM_FRAMES, 1, 1))
    covariances[3] = np.nan
    turned = np.cos(angle) * bearings + np.sin(angle) * sideways
    known = {
        "pose_covariances": covariances,
        "pose_statuses": np.array([0, 0, 0, PoseStatus.UNREFINED], np.uint8),
        "point_errors": np.full(NUM_POINTS, angle),
    }
    seen = points_world, observation_points, observation_frames, turned
    reconstruction = map_of(world_T_rigs, *seen, **known)
    names = [f"{f:03d}, ä" for f in range(NUM_FRAMES)]
    paths, times = [(Path(name),) for name in names], np.arange(NUM_FRAMES) / 3
    frames = frames_of(PictureFormat("erp", 64, 32), paths, times, names)
    sources = np.array([0, PoseSource.INTERPOLATED, 0, 0], np.uint8)
    return frames, CoarsePoses(world_T_rigs, sources, 0.0), reconstruction


def test_quality_of_frames() -> None:
    quality = frame_quality(_world()[2])
    np.testing.assert_array_equal(quality.num_observations, [NUM_POINTS] * 3 + [0])
    np.testing.assert_allclose(quality.median_residuals_deg, [ERROR_DEG] * 3 + [np.nan], rtol=1e-9)
    np.testing.assert_allclose(quality.std_rotations_deg[0], np.degrees([1e-3, 2e-3, 3e-3]))
    np.testing.assert_allclose(quality.std_translations[0], [1, 2, 3])
    assert np.isnan(quality.std_translations[3]).all()


def test_residual_under_other_poses_places_the_points_anew() -> None:
    _, coarse, reconstruction = _world()
    same = median_residual_deg(reconstruction, coarse.world_T_rigs)
    assert 0 < same < ERROR_DEG  # each point absorbs a part of the errors of its three rays
    moved = coarse.world_T_rigs.copy()
    moved[:, :3, 3] = 3 * moved[:, :3, 3] + 1  # a similarity changes nothing
    assert median_residual_deg(reconstruction, moved) == pytest.approx(same, abs=1e-6)
    moved[1, :3, 3] += 6.0  # two units of the map as it was
    assert median_residual_deg(reconstruction, moved) > 10 * same


@pytest.mark.parametrize("most", [1, 7, 30])
def test_observations_some_at_a_time(monkeypatch: pytest.MonkeyPatch, most: int) -> None:
    """Points keep their observations together, whatever fits: nothing changes."""
    _, coarse, whole = _world()
    moved = coarse.world_T_rigs.copy()
    moved[1, :3, 3] += 6.0
    residuals, under = angular_residuals(whole), median_residual_deg(whole, moved)
    monkeypatch.setattr("gsba.types.records.AT_ONCE", most)
    pieces = list(whole.pieces())
    assert len(pieces) > 1
    assert max(len(one.observation_points) for one in pieces) <= max(most, 3)
    for before, after in pairwise(pieces):
        assert before.observation_points[-1] < after.observation_points[0]
    np.testing.assert_array_equal(angular_residuals(whole), residuals)
    assert median_residual_deg(whole, moved) == pytest.approx(under, rel=1e-12)


def test_report_is_valid_json(tmp_path: Path) -> None:
    frames, coarse, reconstruction = _world()
    stage = StageRecord("verify", "key", False, 1.5, 2.5, 300.0)
    report = build_report(
        settings=RefineSettings(),
        frames=frames,
        coarse=coarse,
        reconstruction=reconstruction,
        stages=StageLog(
            [stage],
            {"verify": [Counts(10, 7, "pairs", {"too few inliers": 3})]},
            [(_Iteration({"bearing": np.float64(2.0), "priors": np.nan}, 1e-4),)],
        ),
        gauge="the world and scale of the trajectory",
        found=Findings(),
    )
    write_json(tmp_path / "report.json", report)
    text = (tmp_path / "report.json").read_text(encoding="utf-8")
    back = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert back["summary"]["refined"] == 3 and back["summary"]["frames"] == 4
    assert back["summary"]["median_residual_deg"] == pytest.approx(ERROR_DEG)
    assert back["stages"][0]["seconds"] == 1.5
    assert back["stages"][0]["counts"][0]["dropped"] == {"too few inliers": 3}
    assert back["solver"][0][0]["costs"] == {"bearing": 2.0, "priors": None}
    assert back["frames"][3] == {
        "name": "003, ä",
        "status": "unrefined",
        "coarse_pose": "trajectory file",
        "observations": 0,
        "median_residual_deg": None,
        "std_rotation_deg": None,
        "std_translation": None,
    }
    assert back["settings"]["features"]["extractor"] == "sift"


def test_poses_read_back(tmp_path: Path) -> None:
    frames, coarse, reconstruction = _world()
    write_poses(tmp_path / "poses.csv", frames, coarse, reconstruction)
    with (tmp_path / "poses.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["frame"] for row in rows] == list(frames.names)
    assert [float(row["timestamp"]) for row in rows] == list(frames.timestamps)
    wxyz = np.array([[float(row[f"q{axis}"]) for axis in "wxyz"] for row in rows])
    # 12 digits are written
    np.testing.assert_allclose(
        rotation_from_quaternion(wxyz), reconstruction.world_T_rigs[:, :3, :3], atol=1e-11
    )
    assert rows[1]["source"] == "interpolated" and rows[3]["status"] == "unrefined"
    assert float(rows[0]["cov_tz_tz"]) == 9.0 and float(rows[0]["cov_rx_ty"]) == 0.0
    assert float(rows[0]["std_tz"]) == 3.0
    assert rows[3]["cov_rx_rx"] == "" and rows[3]["median_residual_deg"] == ""
    assert sum(name.startswith("cov_") for name in rows[0]) == 21
    assert [row["map"] for row in rows] == ["1"] * NUM_FRAMES


def test_poses_name_the_map_of_each_frame(tmp_path: Path) -> None:
    frames, coarse, reconstruction = _world()
    components = np.array([1, 0, 0, 2], np.int32)  # the first and the last frame are alone
    reconstruction = replace(reconstruction, components=components)
    write_poses(tmp_path / "poses.csv", frames, coarse, reconstruction)
    with (tmp_path / "poses.csv").open(newline="", encoding="utf-8") as file:
        assert [row["map"] for row in csv.DictReader(file)] == ["", "1", "1", ""]
