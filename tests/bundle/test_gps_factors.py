"""GPS factors: carried into the map, robust, worth what they claim, and mute on other walks."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from lasting_errors import fixes_at, lasting_errors
from scipy.spatial.transform import Rotation
from synthetic import RIG, World, drifted, make_world

from gsba.bundle import adjustment, gps_factors
from gsba.bundle.adjustment import AdjustmentContext, values_of
from gsba.bundle.families import Bearings, Families, Family, MapSnapshot
from gsba.bundle.gps_factors import FrameFixes, GpsFactors
from gsba.bundle.trajectory_prior import TrajectoryPrior
from gsba.config import RefineSettings
from gsba.geometry import furthest, inverse
from gsba.report.findings import notes_on_gps
from gsba.similarity import Sim3, pose_similarity
from gsba.types import Solution

METRES = 25.0  # per unit of the synthetic world: its loop is 630 m long
TIMES = np.arange(24) * 25.0  # seconds
LEVEL = Sim3(METRES, Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix(), np.array([30.0, -9, 4]))
GATES = (200.0, 60.0, 20.0, 8.0)


def _fixes(world: World, seed: int, noise: float = 1.0) -> FrameFixes:
    level = LEVEL.points(world.world_T_rigs[:, :3, 3])
    rng = np.random.default_rng([seed, 1])
    return fixes_at(level + noise * lasting_errors(TIMES, rng), TIMES)


def _problem(coarse: np.ndarray, poses: np.ndarray, fixes: FrameFixes | None) -> AdjustmentContext:
    """As `gsba.pipeline.state.State.adjustment_context` has it."""
    settings = RefineSettings()
    prior = TrajectoryPrior(coarse, settings.priors, first=poses[0])
    members: list[Family] = [Bearings(), prior]
    members += [] if fixes is None else [GpsFactors(fixes)]
    families = Families(tuple(members)).fitted(Solution.without_points(poses))
    return AdjustmentContext(families, RIG, settings, 1)


def _solve(world: World, coarse: np.ndarray, fixes: FrameFixes | None) -> Solution:
    solved = Solution.without_points(coarse)
    for gates in (GATES, GATES[-1:]):
        problem = _problem(coarse, solved.world_T_rigs, fixes)
        start = replace(solved, noise=1.0)
        solved = adjustment.adjust(world.tracks, world.keypoints, start, problem, gates)
    return solved


def test_exact_fixes_are_carried_to_where_the_poses_are() -> None:
    world = make_world(0, 24)
    anchors = gps_factors.anchor(world.world_T_rigs, _fixes(world, 0, 0.0))
    assert anchors is not None and anchors.used.all()
    np.testing.assert_allclose(anchors.positions, world.world_T_rigs[:, :3, 3], atol=1e-9)
    assert anchors.level_from_map[0].scale == pytest.approx(METRES)
    graph = gps_factors.factors(anchors)
    assert graph.size() == 24
    assert graph.error(values_of(world.world_T_rigs)) == pytest.approx(0, abs=1e-9)
    # The noise keeps its axes: five parts up are in the map where up is.
    up = LEVEL.rotation.T @ [0, 0, 1]
    heights = np.einsum("i,aij,j->a", up, anchors.covariances, up)
    traces = np.trace(anchors.covariances, axis1=1, axis2=2)
    np.testing.assert_allclose(heights / traces, 25 / (25 + 9 + 9), rtol=1e-6)


def test_false_fixes_are_left_out_and_others_elsewhere_have_no_say() -> None:
    world, rng = make_world(0, 24), np.random.default_rng(5)
    fixes = _fixes(world, 1)
    wild = np.array([2, 11, 17])
    fixes.positions[wild] += 50 * np.eye(3)
    anchors = gps_factors.anchor(world.world_T_rigs, fixes)
    assert not anchors.used[wild].any() and anchors.used.sum() == 21
    assert np.array_equal(anchors.frames, np.setdiff1d(np.arange(24), wild))
    still = fixes_at(rng.normal(0, 3, (24, 3)), TIMES)
    assert gps_factors.anchor(world.world_T_rigs, still) is None
    few = _fixes(world, 1).taken(np.arange(24) < 4)
    assert gps_factors.anchor(world.world_T_rigs, few) is None


def test_each_map_has_a_similarity_of_its_own() -> None:
    world = make_world(0, 24)
    poses, maps = world.world_T_rigs.copy(), np.repeat([0, 1], 12)
    moved = Sim3(0.3, Rotation.from_rotvec([0.2, 2.0, 0.1]).as_matrix(), np.array([50.0, 0, 0]))
    poses[12:] = moved.poses(poses[12:])
    anchors = gps_factors.anchor(poses, _fixes(world, 0, 0.0), maps)
    assert anchors is not None and list(anchors.level_from_map) == [0, 1]
    np.testing.assert_allclose(anchors.positions, poses[:, :3, 3], atol=1e-8)
    assert anchors.level_from_map[1].scale == pytest.approx(METRES / 0.3)
    some = _fixes(world, 0, 0.0).taken(np.arange(24) < 12)
    anchors = gps_factors.anchor(poses, some, maps)
    assert anchors is not None and list(anchors.level_from_map) == [0]


def test_fixes_of_maps_that_they_do_not_place_are_not_called_false() -> None:
    world, maps = make_world(0, 24), np.repeat([0, 1], [20, 4])
    nothing = Solution.without_points(world.world_T_rigs).landmarks
    names = tuple(map(str, range(24)))
    given = names, TIMES, world.world_T_rigs, maps, nothing, gtsam.Values()
    fixes = _fixes(world, 1)
    fixes.positions[7] += 50.0
    said = GpsFactors(fixes).report(MapSnapshot(*given))
    assert said["false_fixes"] == ["7"] and said["used"] == 19 and said["fixes_elsewhere"] == 4
    (note,) = notes_on_gps(said, 24)
    assert "1 fixes are outliers: 7" in note and "4 positions are of maps" in note
    few = GpsFactors(fixes.taken(np.arange(24) >= 16)).report(MapSnapshot(*given))
    assert not few["taken"] and "maps of which none has 5" in notes_on_gps(few, 24)[0]


def _far_off(world_T_rigs: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Errors (F, 3) of positions with the first pose and the distance furthest from it equal."""
    far, length = furthest(world_T_rigs[:, :3, 3])
    found, wanted = inverse(world_T_rigs[0]) @ world_T_rigs, inverse(true[0]) @ true
    wanted[:, :3, 3] *= length / np.linalg.norm(wanted[far, :3, 3])
    return found[:, :3, 3] - wanted[:, :3, 3]


def test_errors_are_as_covariances_claim() -> None:
    """Where images see little and are noisy, so that fixes matter; over draws of both."""
    ratios = []
    for seed in range(12):
        world = make_world(seed, 24, num_points=90, sigma_rad=8e-3, false_share=0.0)
        coarse = drifted(world.world_T_rigs, np.random.default_rng(seed), 2.0)
        fixes = _fixes(world, seed)
        solved = _solve(world, coarse, fixes)
        poses = solved.world_T_rigs
        problem = _problem(coarse, poses, fixes)
        claimed, _ = adjustment.pose_covariances(solved, world.keypoints, problem)
        off = _far_off(poses, world.world_T_rigs)[1:]
        sigmas = np.sqrt(np.einsum("fii->f", claimed[1:, 3:, 3:]))
        ratios.append(np.sqrt(np.mean(np.sum(off**2, axis=1) / sigmas**2)))
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.5


def test_fixes_do_not_move_what_images_know_better() -> None:
    world = make_world(3, 24)
    coarse = drifted(world.world_T_rigs, np.random.default_rng(3))
    alone, held = (_solve(world, coarse, fixes) for fixes in (None, _fixes(world, 3)))
    claimed, _ = adjustment.pose_covariances(
        alone, world.keypoints, _problem(coarse, alone.world_T_rigs, None)
    )
    moved = pose_similarity(held.world_T_rigs, alone.world_T_rigs).points(
        held.world_T_rigs[:, :3, 3]
    )
    off = np.sqrt(np.mean(np.sum((moved - alone.world_T_rigs[:, :3, 3]) ** 2, axis=1)))
    assert off < np.sqrt(np.mean(np.einsum("fii->f", claimed[1:, 3:, 3:])))


def test_images_contradict_fixes_that_bend_their_map() -> None:
    """A precise receiver's: right fixes pull as their noise says, stretched ones far more."""
    world = make_world(1, 24)
    coarse = drifted(world.world_T_rigs, np.random.default_rng(1))
    level = LEVEL.points(world.world_T_rigs[:, :3, 3])
    ratios = []
    for stretch in (1.0, 1.15):
        noisy = level * [stretch, 1, 1] + 0.01 * (_fixes(world, 1).positions - level)
        fixes = replace(_fixes(world, 1), positions=noisy)
        fixes = replace(fixes, sigmas=0.01 * fixes.sigmas)
        solved = _solve(world, coarse, fixes)
        problem = _problem(coarse, solved.world_T_rigs, None)
        _, joint = adjustment.pose_covariances(solved, world.keypoints, problem)
        snapshot = Families().snapshot(solved)
        family = GpsFactors(fixes)
        ratios.append(family.contradiction(snapshot, joint.draws))
        muted = replace(family, contradicted=True)
        assert muted.fitted(snapshot) is None and muted.digest != family.digest
    assert ratios[0] < 0.5 and ratios[1] > 5


def test_linear_factors_leave_the_gauge_free() -> None:
    """Any similar set of poses is as good: what moves all alike costs nothing."""
    world = make_world(0, 24)
    poses, fixes = world.world_T_rigs, _fixes(world, 2)
    anchors = gps_factors.anchor(poses, fixes)
    assert anchors is not None
    factors, values = gps_factors.linear_factors(anchors, poses)
    values.insert(values_of(poses))
    graph = factors.linearize(values)
    matrix = graph.hessian(gtsam.Ordering.ColamdGaussianFactorGraph(graph))[0]
    eigenvalues = np.linalg.eigvalsh(matrix)
    # Rotations of the frames, 3 * 24, say nothing, and neither do the 7 unknowns of the gauge.
    assert np.sum(eigenvalues < 1e-9 * eigenvalues[-1]) == 3 * 24 + 7
