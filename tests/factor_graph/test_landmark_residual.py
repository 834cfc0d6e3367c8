"""Residuals of landmarks that others write, beside gsba's own and GTSAM."""

from collections.abc import Callable
from functools import cache

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X
from numba import njit

from factors import (
    BearingTerm,
    LandmarkBlock,
    LandmarkResidual,
    LandmarkTerm,
    RobustLoss,
    jacobian_errors,
)

LOSS = RobustLoss("cauchy", 2.0)
NUM_FRAMES, NUM_POINTS = 5, 30


def _bearing(measured, vector, residual, jacobian):
    """`factors.bearing` anew, for angles that are not small."""
    mx, my, mz = measured
    sign = 1.0 if mz >= 0 else -1.0
    a = -1.0 / (sign + mz)
    b = mx * my * a
    first = (1 + sign * mx * mx * a, sign * b, -sign * mx)
    second = (b, sign + my * my * a, -my)
    x = first[0] * vector[0] + first[1] * vector[1] + first[2] * vector[2]
    y = second[0] * vector[0] + second[1] * vector[1] + second[2] * vector[2]
    z = mx * vector[0] + my * vector[1] + mz * vector[2]
    s, n2 = np.sqrt(x * x + y * y), x * x + y * y + z * z
    if s <= 0.0:
        return False
    f = np.arctan2(s, z) / s
    k = (z / n2 - f) / (s * s)
    residual[0], residual[1] = f * x, f * y
    for c in range(3):
        along = measured[c] / n2
        jacobian[0, c] = (f + k * x * x) * first[c] + k * x * y * second[c] - x * along
        jacobian[1, c] = k * x * y * first[c] + (f + k * y * y) * second[c] - y * along
    return True


def _depth_and_height(measured, vector, residual, jacobian):
    """A distance, and a height below the camera; seen in front only."""
    if vector[2] <= 0.0:
        residual[0] = residual[1] = 50.0
        return False
    distance = np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    residual[0], residual[1] = distance - measured[0], vector[1] - measured[1]
    for c in range(3):
        jacobian[0, c], jacobian[1, c] = vector[c] / distance, 1.0 if c == 1 else 0.0
    return True


_residual = cache(LandmarkResidual)  # compiled by the tests, not by each worker that collects them


def _world() -> tuple[np.ndarray, gtsam.Values, np.ndarray, np.ndarray, np.ndarray]:
    """Points, poses, and observations: frames, points, vectors in the rig frame."""
    rng = np.random.default_rng(4)
    values, points = gtsam.Values(), rng.normal(size=(NUM_POINTS, 3)) * 6
    poses = np.empty((NUM_FRAMES, 4, 4))
    for f in range(NUM_FRAMES):
        pose = gtsam.Pose3(gtsam.Rot3.Expmap(0.3 * rng.normal(size=3)), rng.normal(size=3))
        values.insert(X(f), pose)
        poses[f] = pose.matrix()
    frames, owners = (part.ravel() for part in np.indices((NUM_FRAMES, NUM_POINTS)))
    away = points[owners] - poses[frames, :3, 3]
    return points, values, frames, owners, np.einsum("oji,oj->oi", poses[frames, :3, :3], away)


def _noisy_bearings(vectors: np.ndarray) -> np.ndarray:
    noisy = vectors + 0.05 * np.random.default_rng(5).normal(size=vectors.shape)
    return noisy / np.linalg.norm(noisy, axis=1, keepdims=True)


def test_a_block_of_it_is_the_block_of_gsbas_own() -> None:
    points, values, frames, owners, vectors = _world()
    rng, bearings = np.random.default_rng(6), _noisy_bearings(vectors)
    roots = np.eye(2) * 90 + 10 * rng.normal(size=(len(frames), 2, 2))
    origins = 0.1 * rng.normal(size=vectors.shape)
    keys = [X(f) for f in range(NUM_FRAMES)]
    given = {"sqrt_infos": roots, "origins_rig": origins}
    own = LandmarkTerm(frames, owners, bearings, _residual(_bearing), **given)
    terms = BearingTerm(frames, owners, bearings, **given), own
    blocks = [LandmarkBlock(keys, points, [term], LOSS, 2) for term in terms]
    for block in blocks:
        block.polish(values)
    np.testing.assert_allclose(blocks[0].points_world, blocks[1].points_world, atol=1e-9)
    systems = [block.linearize(values) for block in blocks]
    for part in ("diagonal", "off_diagonal", "gradient"):
        mine, theirs = (getattr(system, part) for system in systems)
        np.testing.assert_allclose(theirs, mine, rtol=1e-7, atol=1e-7 * np.abs(mine).max())
    steps = 1e-3 * rng.normal(size=(NUM_FRAMES, 6))
    moved = values.retract(_stacked(keys, steps))
    costs = [block.propose(moved, steps) for block in blocks]
    assert costs[1] == pytest.approx(costs[0], rel=1e-9)


def _stacked(keys: list[int], steps: np.ndarray) -> gtsam.VectorValues:
    delta = gtsam.VectorValues()
    for key, step in zip(keys, steps, strict=True):
        delta.insert(key, step)
    return delta


def test_families_of_several_residuals_cost_what_gtsam_says() -> None:
    points, values, frames, owners, vectors = _world()
    bearings, keys = _noisy_bearings(vectors), [X(f) for f in range(NUM_FRAMES)]
    depths = np.column_stack([np.linalg.norm(vectors, axis=1) + 0.1, vectors[:, 1:]])
    angle, depth = _residual(_bearing), _residual(_depth_and_height)
    terms = [
        LandmarkTerm(frames, owners, bearings, angle, 0.02, name="angles"),
        LandmarkTerm(frames[:70], owners[:70], depths[:70], depth, 0.3, name="depths"),
        LandmarkTerm(frames[70:], owners[70:], depths[70:], depth, 0.3, name="depths"),
    ]
    block = LandmarkBlock(keys, points, terms, RobustLoss(), 2)
    for j, point in enumerate(points):
        values.insert(L(j), point)
    wanted = {"angles": 0.0, "depths": 0.0}
    for term in terms:
        noise = gtsam.noiseModel.Isotropic.Sigma(2, float(term.sigmas))
        for f, j, measured in zip(term.frames, term.points, term.measured, strict=True):
            factor = term.kind.factor(X(f), L(j), measured, noise)
            wanted[term.name] += factor.error(values)
    assert block.costs(values) == pytest.approx(wanted, rel=1e-12)
    residuals, valid = block.residuals(values)
    assert valid[0].all()
    behind = vectors[:70, 2] <= 0
    assert behind.any() and np.array_equal(valid[1], ~behind)
    np.testing.assert_allclose(residuals[1][behind], 50.0 / 0.3)


@pytest.mark.parametrize("function", [_bearing, _depth_and_height])
def test_its_factor_shows_whether_the_jacobian_is_right(function: Callable[..., bool]) -> None:
    pose = gtsam.Pose3(gtsam.Rot3.Expmap(np.array([0.1, -0.2, 0.3])), np.array([1.0, 2.0, 0.5]))
    values = gtsam.Values()
    values.insert(X(0), pose)
    values.insert(L(0), pose.transformFrom(np.array([0.5, -1.0, 4.0])))
    measured = np.array([0.3, -0.2, np.sqrt(1 - 0.13)])
    factor = _residual(function).factor(
        X(0), L(0), measured, gtsam.noiseModel.Isotropic.Sigma(2, 0.1)
    )
    assert max(jacobian_errors(factor, values).values()) < 1e-8


def _pinhole(measured, vector, residual, jacobian):
    """Pixels of a pinhole, everything written."""
    residual[:], jacobian[:] = 0.0, 0.0
    return _sparse_pinhole(measured, vector, residual, jacobian)


@njit
def _sparse_pinhole(measured, vector, residual, jacobian):
    """The same, which leaves zeros of the Jacobian to the caller, and all where it is invisible."""
    if vector[2] <= 0.0:
        return False
    for c in range(2):
        residual[c] = vector[c] / vector[2] - measured[c]
        jacobian[c, c] = 1.0 / vector[2]
        jacobian[c, 2] = -vector[c] / vector[2] ** 2
    return True


def test_what_a_residual_does_not_write_is_zero() -> None:
    points, values, frames, owners, vectors = _world()
    keys, measured = [X(f) for f in range(NUM_FRAMES)], np.zeros((len(frames), 3))
    blocks = [
        LandmarkBlock(keys, points, [LandmarkTerm(frames, owners, measured, _residual(function))])
        for function in (_pinhole, _sparse_pinhole.py_func)
    ]
    (wanted,), (seen,) = blocks[0].residuals(values)
    assert np.array_equal(seen, vectors[:, 2] > 0)
    np.testing.assert_array_equal(blocks[1].residuals(values)[0][0], wanted)
    systems = [block.linearize(values) for block in blocks]
    np.testing.assert_array_equal(systems[1].diagonal, systems[0].diagonal)


def _says_nothing(measured, vector, residual, jacobian):
    """A residual that does not say whether its point is seen."""
    residual[0] = vector[0] - measured[0]


def test_a_residual_says_whether_its_point_is_seen() -> None:
    with pytest.raises(TypeError, match="_says_nothing must return True or False on every path"):
        LandmarkResidual(_says_nothing)
