"""Priors of the factor graph, solved with stock gtsam."""

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import loop_walk

from factors.system_layout import is_hard_constraint
from gsba.bundle import pose_variables
from gsba.bundle.families import Families
from gsba.bundle.pose_variables import X
from gsba.bundle.trajectory_prior import GyroTurns, TrajectoryPrior
from gsba.config import PriorSettings
from gsba.geometry import inverse, pose, rotation_angle
from gsba.types import GyroConstraints, Solution

SETTINGS = PriorSettings()


def _factors(coarse: np.ndarray) -> gtsam.NonlinearFactorGraph:
    snapshot = Families().snapshot(Solution.without_points(coarse))
    return TrajectoryPrior(coarse, SETTINGS).graph(snapshot)


def _values(world_T_rigs: np.ndarray) -> gtsam.Values:
    values = gtsam.Values()
    for f, world_T_rig in enumerate(world_T_rigs):
        values.insert(X(f), gtsam.Pose3(world_T_rig))
    return values


def _solve(factors: gtsam.NonlinearFactorGraph, start: np.ndarray) -> np.ndarray:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    parameters.setMaxIterations(200)
    values = gtsam.LevenbergMarquardtOptimizer(factors, _values(start), parameters).optimize()
    return np.array([values.atPose3(X(f)).matrix() for f in range(len(start))])


def _shaken(world_T_rigs: np.ndarray, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    out = world_T_rigs.copy()
    turns = Rotation.from_rotvec(rng.normal(0, 0.02, (len(out), 3))).as_matrix()
    out[:, :3, :3] = out[:, :3, :3] @ turns
    out[:, :3, 3] += rng.normal(0, 0.1, (len(out), 3))
    return out


def test_alone_the_priors_give_the_trajectory_back() -> None:
    coarse = loop_walk(12)
    factors = _factors(coarse)
    assert factors.error(_values(coarse)) == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(_solve(factors, _shaken(coarse)), coarse, atol=1e-4)


def test_the_first_pose_is_fixed() -> None:
    """However hard another factor pulls at it."""
    coarse = loop_walk(6)
    factors = _factors(coarse)
    pulled = gtsam.Pose3(coarse[0]).compose(gtsam.Pose3.Expmap(np.full(6, 0.3)))
    factors.add(gtsam.PriorFactorPose3(X(0), pulled, gtsam.noiseModel.Isotropic.Sigma(6, 1e-2)))
    solved = _solve(factors, coarse)
    np.testing.assert_allclose(solved[0], coarse[0], atol=1e-4)


def test_every_pose_is_constrained() -> None:
    coarse = loop_walk(8)
    marginals = gtsam.Marginals(_factors(coarse), _values(coarse))
    for f in range(8):
        eigenvalues = np.linalg.eigvalsh(marginals.marginalCovariance(X(f)))
        assert eigenvalues.min() > 0 and np.isfinite(eigenvalues).all()


def _with_truth(coarse: np.ndarray, true: np.ndarray, gap: int) -> np.ndarray:
    """Solve the priors with images replaced by exact steps of the truth, none across `gap`."""
    factors = _factors(coarse)
    tight = gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)
    steps = inverse(true[:-1]) @ true[1:]
    for f, step in enumerate(steps):
        if f != gap:
            factors.add(gtsam.BetweenFactorPose3(X(f), X(f + 1), gtsam.Pose3(step), tight))
    across = inverse(true[0]) @ true[-1]  # a closed loop knows better than the jump
    factors.add(gtsam.BetweenFactorPose3(X(0), X(len(true) - 1), gtsam.Pose3(across), tight))
    return _solve(factors, coarse)


def test_a_jump_is_let_go() -> None:
    true = loop_walk(16)
    coarse = true.copy()
    jump = gtsam.Pose3.Expmap(np.array([0.0, 0.15, 0.0, 1.5, 0.2, 0.5])).matrix()
    coarse[8:] = coarse[7] @ jump @ inverse(coarse[7]) @ coarse[8:]
    solved = _with_truth(coarse, true, gap=7)
    # The images' 1e-3 a step, in spite of a jump of 17 sigmas in rotation and 10 in position.
    assert np.linalg.norm(solved[:, :3, 3] - true[:, :3, 3], axis=1).max() < 0.01
    assert rotation_angle(np.swapaxes(solved[:, :3, :3], 1, 2) @ true[:, :3, :3]).max() < 2e-3
    clean = _with_truth(true, true, gap=7)
    np.testing.assert_allclose(clean, true, atol=1e-6)


@pytest.mark.parametrize("still", ["all", "some"])
def test_a_standing_camera_gives_no_nan(still: str) -> None:
    coarse = loop_walk(10)
    if still == "all":
        coarse[:] = coarse[0]
    else:
        coarse[3:8] = coarse[3]
    factors = _factors(coarse)
    error = factors.error(_values(_shaken(coarse)))
    assert np.isfinite(error) and error > 0
    np.testing.assert_allclose(_solve(factors, _shaken(coarse)), coarse, atol=1e-4)
    marginals = gtsam.Marginals(factors, _values(coarse))
    assert np.isfinite(marginals.marginalCovariance(X(9))).all()


def test_images_may_move_a_camera_that_slam_thought_still() -> None:
    coarse = np.stack([np.eye(4)] * 5)
    factors = _factors(coarse)
    moved = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 0.1]))
    tight = gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)
    for f in range(4):
        factors.add(gtsam.BetweenFactorPose3(X(f), X(f + 1), moved, tight))
    solved = _solve(factors, coarse)
    np.testing.assert_allclose(solved[:, 2, 3], 0.1 * np.arange(5), atol=0.01)


def test_step_noise_scales_with_the_map() -> None:
    """The same walk in other units costs the same, where it stands still too."""
    coarse = loop_walk(10)
    coarse[2:9] = coarse[2]  # most of the time
    off = _shaken(coarse)
    errors = []
    for scale in (1.0, 50.0):
        bigger, bigger_off = coarse.copy(), off.copy()
        bigger[:, :3, 3] *= scale
        bigger_off[:, :3, 3] *= scale
        bigger_off[0] = bigger[0]  # the gauge is not at issue
        errors.append(_factors(bigger).error(_values(bigger_off)))
    assert errors[1] == pytest.approx(errors[0], rel=1e-9)


def test_fixed_scale_holds_the_extent() -> None:
    coarse = loop_walk(10)
    held = pose_variables.fixed_scale(coarse)
    bigger = coarse.copy()
    bigger[:, :3, 3] = coarse[0, :3, 3] + 1.01 * (coarse[:, :3, 3] - coarse[0, :3, 3])
    assert held.error(_values(coarse)) == pytest.approx(0, abs=1e-9)
    assert held.error(_values(bigger)) == pytest.approx(0.5 * 1e4**2, rel=1e-6)
    assert pose_variables.fixed_scale(np.stack([np.eye(4)] * 3)).size() == 0


def test_a_frame_alone_and_tiny_maps_are_no_hard_constraints() -> None:
    poses = loop_walk(5)
    poses[2:, :3, 3] *= 1e-4
    held = pose_variables.fixed_scale(poses, np.array([0, 0, 1, 1, 2]))
    assert held.size() == 4
    assert not any(is_hard_constraint(held.at(n)) for n in range(4))


def test_turns_of_a_gyro_hold_rotations_and_nothing_else() -> None:
    """Steps it knows cost what they are off, whatever lies between the frames."""
    rng = np.random.default_rng(0)
    steps = rng.normal(0, 0.3, (3, 3))
    rotations = [Rotation.from_rotvec(rng.normal(size=3))]
    for step in steps:
        rotations.append(rotations[-1] * Rotation.from_rotvec(step))
    sigmas = np.array([1e-3, np.inf, 2e-3])
    turning = GyroConstraints(steps, sigmas, np.full((4, 3), np.nan), 0.0)
    values, start = gtsam.Values(), Solution.without_points(np.tile(np.eye(4), (4, 1, 1)))
    graph = GyroTurns(turning, 5.0, 2.0).graph(Families().snapshot(start))
    for f, rotation in enumerate(rotations):
        values.insert(X(f), gtsam.Pose3(pose(rotation.as_matrix(), rng.normal(size=3))))
    assert graph.size() == 2 and graph.error(values) < 1e-8
    turned = values.atPose3(X(3)) * gtsam.Pose3(gtsam.Rot3.Rx(2e-3), np.zeros(3))
    values.update(X(3), turned)  # by one standard deviation
    assert graph.error(values) == pytest.approx(2.0 * np.log1p(1 / 4), rel=1e-3)
