"""Worlds far from their origin (ECEF, UTM): shifted at every door, and exact in float32."""

import dataclasses
import json
from pathlib import Path

import export_scene as scene
import numpy as np
import pytest
from walk_on_earth import frame_set, walk_result

from gsba.config import PlacementSettings, RefineSettings
from gsba.export import ExportFormat, export
from gsba.geometry import local_origin
from gsba.pipeline import inputs
from gsba.placement.placement import place
from gsba.placement.world import Placement
from gsba.similarity import Sim3
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory

ECEF = np.array([2_511_673.6174896946, 1_438_633.7145349307, 5_664_733.7249137033])
UTM = np.array([500_123.25, 4_649_776.5, 250.0])


def _error_in_float32(world: np.ndarray, local: np.ndarray, offset: np.ndarray) -> float:
    """Largest error of local coordinates in float32, part of the extent."""
    written = local.astype(np.float32).astype(np.float64) + offset
    return float(np.abs(written - world).max() / np.ptp(world, axis=0).max())


@pytest.mark.parametrize("far", [ECEF, UTM])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 300.0])
def test_the_origin_is_near_the_positions(far: np.ndarray, scale: float) -> None:
    near = scale * walk_result().world_T_rigs[:, :3, 3]
    origin = local_origin(near + far)
    assert _error_in_float32(near + far, near + far - origin, origin) < 1e-6
    assert local_origin(near) is None and local_origin(np.tile(far, (5, 1))) is None


@pytest.mark.parametrize("far", [ECEF, UTM])
def test_a_trajectory_comes_in_near_the_origin(far: np.ndarray) -> None:
    frames, poses = frame_set(40), walk_result().world_T_rigs.copy()
    poses[:, :3, 3] += far
    (near,) = inputs.timed([Trajectory(frames.timestamps, poses)], frames)
    assert np.abs(near.world_T_rigs[:, :3, 3]).max() < 30
    np.testing.assert_allclose(
        near.world_T_rigs[:, :3, 3] + near.origin, poses[:, :3, 3], atol=2e-9
    )
    coarse = inputs.coarse_poses(frames, [near], RefineSettings())
    np.testing.assert_array_equal(coarse.origin, near.origin)
    (same,) = inputs.timed([Trajectory(frames.timestamps, walk_result().world_T_rigs)], frames)
    assert same.origin is None


def test_exports_state_the_offset(tmp_path: Path) -> None:
    run = dataclasses.replace(scene.reconstruction(), origin=ECEF)
    world = run.world_T_rigs[:, :3, 3] + ECEF
    frames = scene.panoramas(tmp_path / "frames")
    for to in (ExportFormat.TUM, ExportFormat.NERFSTUDIO):
        export(run, frames, tmp_path / to.value, to)
        said = json.loads((tmp_path / to.value / "transform.json").read_text())
        np.testing.assert_array_equal(said["offset"], ECEF)
    local = read_trajectory(tmp_path / "tum/trajectory.tum").world_T_rigs[:, :3, 3]
    np.testing.assert_allclose(local + ECEF, world, atol=2e-9)
    document = json.loads((tmp_path / "nerfstudio/transforms.json").read_text())
    first = np.array(document["frames"][0]["transform_matrix"])[:3, 3]
    assert np.abs(first + ECEF - world[0]).max() < 1e-8


def test_upright_and_scaled_worlds_keep_the_offset(monkeypatch: pytest.MonkeyPatch) -> None:
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    upright = Placement(Sim3(rotation=turn), up="-y")
    monkeypatch.setattr("gsba.placement.placement._upright", lambda *_: upright)
    run, frames = dataclasses.replace(walk_result(), origin=UTM), frame_set(40)
    settings = PlacementSettings(up="auto", length=2.0, between=("0,0,0", "1,0,0"))
    placed = place(run, frames, settings)
    world = 2 * (run.world_T_rigs[:, :3, 3] + UTM) @ turn.T
    found = placed.similarity.points(run.world_T_rigs[:, :3, 3]) + placed.offset
    np.testing.assert_allclose(found, world, atol=1e-8)


def test_true_poses_far_away_are_split_off(tmp_path: Path) -> None:
    result, frames = walk_result(), frame_set(40)
    true = Placement(Sim3(1.0, translation=ECEF)).apply(result).world_T_rigs
    write_tum(tmp_path / "truth.tum", Trajectory(frames.timestamps, true))
    placed = place(result, frames, PlacementSettings(align=str(tmp_path / "truth.tum")))
    local = placed.similarity.points(result.world_T_rigs[:, :3, 3])
    assert _error_in_float32(true[:, :3, 3], local, placed.offset) < 1e-6
