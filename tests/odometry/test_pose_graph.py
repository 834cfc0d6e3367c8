"""The pose graph over similarities: drift of scale taken out, false loops left out, covariances."""

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factors.check import jacobian_errors
from gsba.geometry import inverse, pose
from gsba.odometry.closing import moved
from gsba.odometry.pose_graph import (
    Constraint,
    carried_covariances,
    close_loops,
    covariances_of,
    factor_of,
    similarity3,
)
from gsba.similarity import Sim3

STEP = np.diag(np.square([0.002] * 3 + [0.003] * 3 + [0.004]))  # covariance of a step
LOOP = np.diag(np.square([0.002] * 3 + [0.003] * 3 + [0.004]))
NUM = 40


def _circle() -> np.ndarray:
    """Once around, back to where it began."""
    angles = np.linspace(0, 2 * np.pi, NUM)
    turns = Rotation.from_rotvec(angles[:, None] * [0.0, 1.0, 0.0]).as_matrix()
    places = 3 * np.column_stack([1 - np.cos(angles), 0.1 * np.sin(2 * angles), np.sin(angles)])
    return pose(turns, places)


def _tracked(truth: np.ndarray, scales: np.ndarray) -> tuple[np.ndarray, list[Constraint]]:
    """Poses and steps of an odometry whose unit changes by `scales` (K,), on the way to each."""
    steps, poses = [], [truth[0]]
    for k in range(1, len(truth)):
        step = inverse(truth[k - 1]) @ truth[k]
        step[:3, 3] /= scales[k]
        poses.append(poses[-1] @ step)
        steps.append(Constraint(k - 1, k, Sim3.of(1.0, step), STEP))
    return np.array(poses), steps


def _loop(truth: np.ndarray, scales: np.ndarray, first: int, second: int) -> Constraint:
    between = inverse(truth[first]) @ truth[second]
    between[:3, 3] /= scales[first]
    return Constraint(first, second, Sim3.of(scales[second] / scales[first], between), LOOP)


def _off(poses: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1).max())


def test_factors_are_in_our_tangent_and_their_jacobians_right() -> None:
    rng = np.random.default_rng(0)
    one = Sim3(1.3, Rotation.from_rotvec([0.4, -1.0, 0.7]).as_matrix(), rng.normal(size=3))
    tangent = 1e-5 * rng.normal(size=7)
    expected = similarity3(moved(one, tangent)).matrix()
    np.testing.assert_allclose(similarity3(one).retract(tangent).matrix(), expected, atol=1e-9)
    between = Sim3(0.8, Rotation.from_rotvec([-0.2, 0.5, 0.9]).as_matrix(), rng.normal(size=3))
    factor = factor_of(Constraint(0, 1, between, LOOP))
    values = (
        gtsam.Values()
    )  # consistent: farther off GTSAM leaves out the derivative of the logarithm
    first, second = similarity3(one), similarity3(one) * similarity3(between)
    for key, value in zip(factor.keys(), (first, second), strict=True):
        values.insert(key, value)
    assert max(jacobian_errors(factor, values).values()) < 1e-5


def test_a_loop_takes_out_drift_of_scale() -> None:
    truth, scales = _circle(), np.exp(0.004 * np.arange(NUM))
    poses, steps = _tracked(truth, scales)
    closed = close_loops(poses, steps, [_loop(truth, scales, 0, NUM - 1)])
    assert closed.kept.all()
    assert _off(closed.world_T_keys, truth) < 0.2 * _off(poses, truth)
    assert closed.scales[-1] == pytest.approx(scales[-1], rel=0.02)
    np.testing.assert_allclose(closed.world_T_keys[0], truth[0], atol=1e-4)


def test_a_loop_that_bends_the_path_further_than_it_can_have_drifted_is_left_out() -> None:
    truth, scales = _circle(), np.exp(0.001 * np.arange(NUM))
    poses, steps = _tracked(truth, scales)
    elsewhere = _loop(truth, scales, 0, NUM // 2)
    false = Constraint(0, NUM // 2, Sim3(), elsewhere.covariance)
    closed = close_loops(poses, steps, [_loop(truth, scales, 0, NUM - 1), false])
    np.testing.assert_array_equal(closed.kept, [True, False])
    alone = close_loops(poses, steps, [_loop(truth, scales, 0, NUM - 1)])
    np.testing.assert_allclose(closed.world_T_keys, alone.world_T_keys, atol=1e-3)


def test_covariances_are_those_of_random_steps() -> None:
    truth = _circle()[:16]
    rng, draws = np.random.default_rng(0), 400
    _, steps = _tracked(truth, np.ones(16))
    found = covariances_of(truth, np.ones(16), steps)
    far = int(np.argmax(np.linalg.norm(truth[:, :3, 3], axis=1)))
    length = np.linalg.norm(truth[far, :3, 3])
    errors = np.empty((draws, 16, 3))
    for draw in errors:
        walk = [similarity3(Sim3())]
        for step in steps:
            noise = rng.multivariate_normal(np.zeros(7), STEP)
            walk.append(walk[-1] * similarity3(moved(step.first_T_second, noise)))
        places = np.array([one.scale() * one.translation() for one in walk])
        places *= length / np.linalg.norm(places[far])
        draw[:] = np.einsum("kij,ki->kj", truth[:, :3, :3], places - truth[:, :3, 3])
    measured = np.sqrt(np.mean(np.sum(errors**2, axis=2), axis=0))
    claimed = np.sqrt(np.trace(found[:, 3:, 3:], axis1=1, axis2=2))
    np.testing.assert_allclose(claimed[1:], measured[1:], rtol=0.15)  # 400 draws: 4 % each
    assert claimed[0] < 1e-4


def test_frames_get_the_covariance_of_their_keyframe() -> None:
    rng = np.random.default_rng(0)
    half = rng.normal(size=(6, 6))
    covariance = half @ half.T
    key_T_rig = pose(Rotation.from_rotvec([1.0, 0.3, -0.7]).as_matrix(), rng.normal(size=3))
    found = carried_covariances(covariance[None], key_T_rig[None], np.zeros(1))[0]
    adjoint = gtsam.Pose3(inverse(key_T_rig)).AdjointMap()
    expected = adjoint @ covariance @ adjoint.T
    off = found - expected
    np.testing.assert_allclose(off[3:], 0, atol=1e-9)
    assert (np.diag(off)[:3] > 0).all()  # what is each frame's own
