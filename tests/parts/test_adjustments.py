"""Adjustments of a run in parts, beside the undivided ones: families, gates, resumed calls."""

import errno
import logging
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from dask_workers import some_workers
from gtsam.symbol_shorthand import X
from scipy.spatial.transform import Rotation
from synthetic import RIG, GivenFactors, make_world, tracks_of
from town_in_parts import NUM, SIGMA, town

from gsba import disk
from gsba.bundle import adjustment
from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.families import Bearings, Families, Family, Reprojections
from gsba.bundle.optimizer import SolverOptions
from gsba.bundle.trajectory_prior import GyroTurns, TrajectoryPrior
from gsba.camera.rig import owner_faces
from gsba.config import PriorSettings, RefineSettings
from gsba.disk import FullDiskError
from gsba.geometry import pose
from gsba.parts import DividedAdjustments
from gsba.parts import adjustments as parts_adjustments
from gsba.store.cluster import Cluster
from gsba.store.shards import Threads, Workers
from gsba.types import GyroConstraints, Keypoints, Solution, Tracks

GATES = (8.0, 4.0)


def town_map() -> tuple[np.ndarray, Keypoints, Tracks]:
    """Poses (F, 4, 4) to start from, keypoints sharper along one axis, and tracks of the town."""
    _, term, rows, _ = town()
    order = np.lexsort((term.points, term.frames))
    frames, points, bearings = term.frames[order], term.points[order], term.bearings_rig[order]
    starts = np.searchsorted(frames, np.arange(NUM + 1))
    faces = owner_faces(bearings)
    roots = np.tile(np.diag([1.0, 0.5]) / SIGMA, (len(frames), 1, 1))
    keypoints = Keypoints(
        starts, RIG.project(bearings, faces), faces, bearings, np.full(len(frames), SIGMA),
        np.zeros((len(frames), 3), np.uint8), roots, np.full((len(frames), 3), 1e-3),
    )  # fmt: skip
    tracks, _ = tracks_of(points, frames, starts)
    return pose(rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]), keypoints, tracks


def families(poses: np.ndarray, kind: str) -> Families:
    """Families of a run, and one that has factors of its own."""
    points = [Bearings(), Reprojections(RIG)][: 2 if kind == "reprojection" else 1]
    prior = TrajectoryPrior(poses, PriorSettings())
    turns = poses[:-1, :3, :3].transpose(0, 2, 1) @ poses[1:, :3, :3]
    sigmas = np.full(NUM - 1, 0.01)
    sigmas[::9] = np.nan
    turning = GyroConstraints(
        Rotation.from_matrix(turns).as_rotvec(), sigmas, np.zeros((NUM, 3)), 0.01
    )
    members: list[Family] = [*points, prior, GyroTurns(turning, 30.0, 2.0)]
    if kind == "python":
        noise = gtsam.noiseModel.Unit.Create(1)
        graph = gtsam.NonlinearFactorGraph()

        def height(factor, values, jacobians):  # type: ignore[no-untyped-def]
            if jacobians is not None:
                jacobians[0] = np.zeros((1, 6), order="F")
            return np.zeros(1)

        graph.add(gtsam.CustomFactor(noise, [X(0)], height))
        members.append(GivenFactors(graph))
    return Families(tuple(members), tuple(map(str, range(NUM))), np.arange(NUM, dtype=float))


def context(
    folder: Path,
    part_frames: int | None,
    poses: np.ndarray,
    kind: str = "bearing",
    workers: Workers | None = None,
    most: int = 50,
) -> AdjustmentContext:
    """Context of an adjustment in at most `most` iterations a round, whose maps are divided."""
    factors = ("bearing", "reprojection") if kind == "reprojection" else ("bearing",)
    settings = RefineSettings(factors=factors)
    solver = SolverOptions(most, relative_tolerance=1e-9, absolute_tolerance=None)
    workers = Threads(2) if workers is None else workers
    division = DividedAdjustments(folder / "parts", folder / "shards", workers, part_frames)
    return AdjustmentContext(families(poses, kind), RIG, settings, 1, solver, division=division)


def _adjusted(folder: Path) -> Solution:
    """The town adjusted in parts of 15 frames, in a few iterations."""
    poses, keypoints, tracks = town_map()
    here = context(folder, 15, poses, most=5)
    return adjustment.adjust(tracks, keypoints, Solution.without_points(poses), here, GATES)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Solution:
    """The town adjusted without any mishap."""
    return _adjusted(tmp_path_factory.mktemp("undisturbed"))


@pytest.mark.parametrize("kind", ["bearing", "reprojection"])
def test_rounds_in_parts_give_the_undivided_solution(kind: str, tmp_path: Path) -> None:
    poses, keypoints, tracks = town_map()
    whole, parts = (
        adjustment.adjust(
            tracks,
            keypoints,
            Solution.without_points(poses),
            context(tmp_path, part_frames, poses, kind),
            GATES,
        )
        for part_frames in (NUM, 15)
    )
    for one, other in zip(parts.rounds, whole.rounds, strict=True):
        assert (one.observations, one.points, one.support) == (
            other.observations,
            other.points,
            other.support,
        )
    assert np.abs(whole.world_T_rigs - poses).max() > 1e-2
    np.testing.assert_allclose(parts.world_T_rigs, whole.world_T_rigs, atol=1e-8)
    assert parts.noise == pytest.approx(whole.noise, rel=1e-6)
    expected, joint = adjustment.pose_covariances(
        whole, keypoints, context(tmp_path, NUM, poses, kind)
    )
    covariances, errors = adjustment.pose_covariances(
        whole, keypoints, context(tmp_path, 15, poses, kind)
    )
    scale = np.abs(expected).max()
    np.testing.assert_allclose(covariances, expected, atol=1e-8 * scale)
    np.testing.assert_allclose(errors.neighbours, joint.neighbours, atol=1e-8 * scale)


def test_a_stopped_adjustment_goes_on_in_another_call(
    undisturbed: Solution, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    solve, calls = parts_adjustments.optimize_divided, []

    def stop(*args, **options):  # type: ignore[no-untyped-def]
        calls.append(args)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return solve(*args, **options)

    monkeypatch.setattr(parts_adjustments, "optimize_divided", stop)
    with pytest.raises(KeyboardInterrupt):
        _adjusted(tmp_path)
    found = _adjusted(tmp_path)
    assert len(calls) == 3  # the first round was not solved again
    np.testing.assert_array_equal(found.world_T_rigs, undisturbed.world_T_rigs)
    counts = [[len(one.iterations) for one in each.rounds] for each in (found, undisturbed)]
    assert counts[0] == counts[1]


def test_a_full_disk_ends_an_adjustment_in_one_line_and_costs_nothing_else(
    undisturbed: Solution, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twice in one adjustment, the second time after more files."""
    rename, left = os.replace, 0

    def fill(*args: Any, **options: Any) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        rename(*args, **options)

    for left in (3, 60):  # noqa: B007 (`fill` counts it down)
        with monkeypatch.context() as patched:
            patched.setattr(disk.os, "replace", fill)
            with pytest.raises(FullDiskError) as caught:
                _adjusted(tmp_path)
        assert len(str(caught.value).splitlines()) == 1
    found = _adjusted(tmp_path)
    np.testing.assert_array_equal(found.world_T_rigs, undisturbed.world_T_rigs)


@pytest.mark.slow
@pytest.mark.parametrize("num", [1, 2])
def test_workers_adjust_to_the_same_bytes(num: int, tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="needs the extra cluster")
    poses, keypoints, tracks = town_map()
    start = Solution.without_points(poses)
    here = context(tmp_path / "threads", 15, poses)
    expected = adjustment.adjust(tracks, keypoints, start, here, GATES)
    covariances = adjustment.pose_covariances(expected, keypoints, here)
    there = tmp_path / "workers"
    (there / "shards").mkdir(parents=True)
    with some_workers(num) as client:
        workers = Cluster(client, there / "shards", tmp_path)
        away = context(there, 15, poses, workers=workers)
        found = adjustment.adjust(tracks, keypoints, start, away, GATES)
        elsewhere = adjustment.pose_covariances(found, keypoints, away)
        assert workers.spent().cpu_seconds > 0
    np.testing.assert_array_equal(found.world_T_rigs, expected.world_T_rigs)
    np.testing.assert_array_equal(elsewhere[0], covariances[0])
    np.testing.assert_array_equal(elsewhere[1].draws, covariances[1].draws)
    assert not list((there / "shards").iterdir())


def test_factors_written_in_python_are_adjusted_undivided(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    poses, keypoints, tracks = town_map()
    here = context(tmp_path, 15, poses, "python")
    with caplog.at_level(logging.INFO):
        found = adjustment.adjust(tracks, keypoints, Solution.without_points(poses), here, GATES)
    assert found.rounds[-1].accepted
    told = [message for message in caplog.messages if "adjusted undivided" in message]
    assert len(told) == 1 and "written in Python" in told[0]


def test_a_map_whose_frames_all_see_one_another_is_adjusted_undivided(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    world = make_world(0)  # a loop of 20 frames around one place
    start = Solution.without_points(world.world_T_rigs)
    found = []
    for part_frames in (20, 5):
        here = context(tmp_path, part_frames, world.world_T_rigs)
        here = replace(here, families=here.families.with_members([Bearings()]))
        with caplog.at_level(logging.INFO):
            found.append(adjustment.adjust(world.tracks, world.keypoints, start, here, GATES))
    np.testing.assert_array_equal(found[0].world_T_rigs, found[1].world_T_rigs)
    assert [m for m in caplog.messages if "more than half of the frames" in m]
    assert not list((tmp_path / "parts").glob("*"))


def test_memory_decides_where_nothing_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    poses, keypoints, tracks = town_map()
    monkeypatch.setattr(parts_adjustments, "_FRAMES", 15)
    asked: list[int] = []
    monkeypatch.setattr(
        parts_adjustments.DividedAdjustments,
        "_digest",
        lambda self, map_, most, purpose: asked.append(most),
    )
    start = Solution.without_points(poses)
    for memory in (1 << 40, 1 << 20):
        monkeypatch.setattr(parts_adjustments, "total_memory_bytes", lambda memory=memory: memory)
        adjustment.adjust(tracks, keypoints, start, context(tmp_path, None, poses), GATES[:1])
        assert asked == ([] if memory > 1 << 30 else [15])
