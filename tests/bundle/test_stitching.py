"""The field of directions: found where it is, left alone where it is not, handed on to frames."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from synthetic import RIG, World, make_world

from factors import RobustLoss
from factors.sphere_field import SphereField, num_harmonics
from gsba.bundle import adjustment, stitching
from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.families import Bearings, Families
from gsba.bundle.optimizer import SolverOptions, optimize
from gsba.bundle.shared_parameters import PARTS, ObservedRays, SharedModel, parts_of, whole_model
from gsba.bundle.stitching import Stitching, corrected, with_noise_of
from gsba.bundle.trajectory_prior import TrajectoryPrior
from gsba.camera.sphere import erp_directions
from gsba.camera.straighten import straightened
from gsba.config import RefineSettings
from gsba.similarity import pose_similarity
from gsba.types import Counts, Keypoints, Landmarks, Sighted, Solution, Tracks

SIGMA = 2e-4  # radians
SETTINGS = RefineSettings.model_validate({"solver": {"num_threads": 1}})


@pytest.fixture(autouse=True)
def _few_degrees(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stitching, "_MAX_DEGREE", 5)


def _bent(world: World, field: SphereField) -> Keypoints:
    keypoints = world.keypoints
    bearings = field.observed(keypoints.bearings_rig)
    return replace(keypoints, bearings_rig=bearings)


def _true_field() -> SphereField:
    """0.1 degrees, smooth: of degrees 2 and 3."""
    drawn = np.random.default_rng(3).normal(size=num_harmonics(3))
    drawn[:3] = 0
    return SphereField(np.deg2rad(0.1) * np.sqrt(4 * np.pi) * drawn / np.linalg.norm(drawn))


@cache
def _found(bent: bool) -> tuple[World, Solution, Keypoints, Stitching]:
    """World, the map solved without a field, keypoints, and what was found."""
    world = make_world(0, num_frames=16, num_points=900, sigma_rad=SIGMA, false_share=0.02)
    keypoints = _bent(world, _true_field() if bent else SphereField.none())
    sighted = Sighted(
        keypoints, np.ones(len(keypoints.faces), bool), world.tracks, Counts(0, 0, "observations")
    )
    priors = TrajectoryPrior(world.world_T_rigs, SETTINGS.priors)
    start = Solution.without_points(world.world_T_rigs)
    problem = AdjustmentContext(Families((Bearings(), priors)), RIG, SETTINGS, 1)
    solved, calibrated = adjustment.adjust_sighted(sighted, start, problem, (30.0, 6.0))
    found = stitching.estimate(sighted, calibrated, solved, SphereField.none(), problem)
    return world, solved, keypoints, found


def _errors(world: World, solved: Solution) -> tuple[float, float]:
    """Root mean square error of positions, and of rotations in radians, after Sim(3)."""
    poses, true = solved.world_T_rigs, world.world_T_rigs
    placed = pose_similarity(poses, true).poses(poses)
    off, turned = placed[:, :3, 3] - true[:, :3, 3], placed[:, :3, :3] - true[:, :3, :3]
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1)))), float(
        np.sqrt(np.mean(np.sum(turned**2, axis=(1, 2))) / 2)
    )


def test_a_bent_camera_is_straightened() -> None:
    """Noise of 16 bearings a point and degree of freedom leaves less than a tenth of the field."""
    world, before, keypoints, found = _found(True)
    assert np.all(found.part_gains > 0.2)
    truth = _true_field().displacements(keypoints.bearings_rig)
    off = found.field.displacements(keypoints.bearings_rig) - truth
    off -= _turned(keypoints.bearings_rig, off)
    shape = np.sqrt(np.mean(np.sum(truth**2, axis=1)))
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 0.2 * shape
    assert found.adjustment.noise * found.keypoints.sigmas_rad[0] < 1.2 * SIGMA
    assert before.noise * found.keypoints.sigmas_rad[0] > 0
    positions, rotations = _errors(world, found.adjustment)
    old_positions, old_rotations = _errors(world, before)
    assert positions < 0.5 * old_positions and rotations < 0.5 * old_rotations


def _turned(bearings: np.ndarray, tangents: np.ndarray) -> np.ndarray:
    """The part of tangents (N, 3) that is a rotation: poses take it up."""
    turns = np.stack([np.cross(axis, bearings) for axis in np.eye(3)], axis=-1)
    amounts = np.linalg.lstsq(turns.reshape(-1, 3), tangents.ravel(), rcond=None)[0]
    return turns @ amounts


def test_a_straight_camera_is_left_alone() -> None:
    _, before, _, found = _found(False)
    assert not found.field and found.adjustment is before
    assert abs(found.part_gains.sum()) < 0.03


def test_parts_do_not_share_points() -> None:
    _, before, _, _ = _found(False)
    parts = parts_of(before.landmarks)
    assert len(parts) == PARTS
    assert sum(part.tracks.num_points for part in parts) == before.landmarks.tracks.num_points
    means = [np.mean(part.tracks.frames) for part in parts]
    assert np.all(np.diff(means) > 0)


def test_too_little_is_left_alone() -> None:
    world, before, keypoints, _ = _found(False)
    few = before.landmarks.tracks.points < 40
    tracks = before.landmarks.tracks
    some = Tracks(tracks.points[few], tracks.frames[few], tracks.keypoints[few], 40)
    landmarks = replace(
        before.landmarks, points_world=before.landmarks.points_world[:40], tracks=some
    )
    small = replace(before, landmarks=landmarks)
    sighted = Sighted(keypoints, np.ones(len(keypoints.faces), bool), some, Counts(0, 0, "o"))
    priors = TrajectoryPrior(world.world_T_rigs, SETTINGS.priors)
    problem = AdjustmentContext(Families((Bearings(), priors)), RIG, SETTINGS, 1)
    found = stitching.estimate(sighted, keypoints, small, SphereField.none(), problem)
    assert not found.field and found.adjustment is small


def test_model_predicts_the_cost() -> None:
    """Gain of the quadratic model against what bundle adjustment with the field really gains."""
    world = make_world(1, num_frames=10, num_points=300, sigma_rad=SIGMA, false_share=0)
    keypoints = _bent(world, _true_field())
    plain = SolverOptions(relative_tolerance=1e-9, loss=RobustLoss())
    priors = TrajectoryPrior(world.world_T_rigs, SETTINGS.priors)
    problem = AdjustmentContext(Families((Bearings(), priors)), RIG, SETTINGS, 1, plain)
    landmarks = Landmarks(world.points_world, world.tracks, Counts(0, 0, "tracks"))

    def solved(field: SphereField) -> tuple[Solution, float]:
        there = corrected(keypoints, field, RIG)
        block = adjustment.landmark_block(landmarks, there, 1.0, problem)
        terms = problem.terms(Solution.without_points(world.world_T_rigs))
        result = optimize(terms.graph, terms.values, [block], plain)
        poses = adjustment.poses_of(result.values, len(world.world_T_rigs))
        return Solution(poses, landmarks, 1.0, ()), block.error(result.values)

    def modelled(field: SphereField, solution: Solution) -> SharedModel:
        there = corrected(keypoints, field, RIG)
        by_field = stitching._by_field(keypoints, there, 3)
        around = replace(solution, landmarks=landmarks)
        model = whole_model(ObservedRays(around, there, problem), [], by_field)
        assert model is not None
        return model.around(field.coefficients)

    before, cost = solved(SphereField.none())
    system = modelled(SphereField.none(), before)
    assert system.cost == pytest.approx(cost, rel=0.02)  # poses are at their best already
    field = SphereField(stitching._fitted([system], 3, 1e-2))
    after, least = solved(field)
    assert system.gain(field.coefficients) == pytest.approx(cost - least, rel=0.02)
    assert least < 0.1 * cost
    again = modelled(field, after)
    assert again.cost == pytest.approx(cost, rel=0.05)  # extrapolated back to no field


def test_noise_carries_over() -> None:
    keypoints = _found(True)[2]
    roots = np.tile(np.eye(2), (len(keypoints.faces), 1, 1))
    shaped = replace(keypoints, sqrt_infos=roots)
    louder = replace(shaped, sigmas_rad=2 * shaped.sigmas_rad, sqrt_infos=roots / 2)
    back = with_noise_of(shaped, corrected(louder, _true_field(), RIG))
    np.testing.assert_allclose(back.sigmas_rad, louder.sigmas_rad)
    assert back.sqrt_infos is not None and louder.sqrt_infos is not None
    np.testing.assert_allclose(back.sqrt_infos, louder.sqrt_infos)


def test_panoramas_are_straightened() -> None:
    """Brightness that depends on the observed direction must come to lie on the true one."""
    width = 512
    rays = erp_directions(width)
    field = SphereField(8 * _true_field().coefficients)  # 0.8 degrees, more than a pixel

    def shade(directions: np.ndarray) -> np.ndarray:
        return 128 + 60 * np.sin(7 * directions[..., 0] + 5 * directions[..., 1]) * np.cos(
            9 * directions[..., 2]
        )

    captured = np.rint(shade(field.corrected(rays))).astype(np.uint8)
    correction = tuple(field.coefficients.tolist())
    off = straightened(captured, correction).astype(float) - shade(rays)
    assert np.abs(off).max() < 2.0  # rounding twice, and bicubic offsets
    assert np.abs(captured - shade(rays)).max() > 5
    mask = straightened(captured > 128, correction)
    assert mask.dtype == bool and np.mean(mask == (shade(rays) > 128)) > 0.97
