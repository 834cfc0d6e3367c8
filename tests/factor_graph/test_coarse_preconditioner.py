"""Landmarks kept as products: against the system written out, and its inverse."""

import gtsam
import numpy as np
import pytest
from dense_system import dense
from gtsam.symbol_shorthand import X

from factors import (
    BearingTerm,
    LandmarkBlock,
    RobustLoss,
    coarse_preconditioner,
    direct_system,
    iterative_system,
)
from factors._terms import pose_rows
from factors.block import QuadraticBlock
from factors.coarse_preconditioner import Groups, covisible_groups
from factors.direct_system import DirectSystem, reduced_system
from factors.iterative_system import IterativeSystem
from factors.reduced_camera_system import ReducedSystem
from factors.schur_complement import GROUP_DIM
from factors.system_layout import SystemLayout
from gsba.bundle.optimizer import SolverOptions, optimize

NUM_FRAMES, NUM_POINTS, SIGMA = 30, 300, 1e-3


class World:
    """Three laps of ten frames among points that each sees near it; steps known roughly."""

    def __init__(self) -> None:
        rng = np.random.default_rng(3)
        angles = 2 * np.pi * np.arange(NUM_FRAMES) / 10
        places = np.column_stack(
            [5 * np.cos(angles), rng.normal(size=NUM_FRAMES) / 5, np.sin(angles)]
        )
        self.truth = [
            gtsam.Pose3(gtsam.Rot3.Ypr(*(0.3 * rng.normal(size=3))), place) for place in places
        ]
        points = rng.uniform([-8, -3, -4], [8, 3, 4], (NUM_POINTS, 3))
        near = np.linalg.norm(points[None] - places[:, None], axis=2) < 4.5
        near &= rng.random(near.shape) < 0.8
        near[:, near.sum(axis=0) < 4] = False  # what few rays tell is lost in rounding
        self.frames, self.owners = np.nonzero(near)
        seen = [
            self.truth[f].transformTo(points[j])
            for f, j in zip(self.frames, self.owners, strict=True)
        ]
        bearings = np.array(seen) + SIGMA * rng.normal(size=(len(seen), 3))
        self.bearings = bearings / np.linalg.norm(bearings, axis=1, keepdims=True)
        self.points = points + 0.02 * rng.normal(size=points.shape)
        self.keys = [X(f) for f in range(NUM_FRAMES)]
        self.values, self.graph = gtsam.Values(), gtsam.NonlinearFactorGraph()
        for key, pose in zip(self.keys, self.truth, strict=True):
            self.values.insert(key, pose.retract(0.01 * rng.normal(size=6)))
        fixed = gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)
        self.graph.add(gtsam.PriorFactorPose3(self.keys[0], self.truth[0], fixed))
        loose = gtsam.noiseModel.Isotropic.Sigma(6, 0.2)
        for f in range(NUM_FRAMES - 1):
            step = self.truth[f].between(self.truth[f + 1])
            self.graph.add(gtsam.BetweenFactorPose3(self.keys[f], self.keys[f + 1], step, loose))

    def block(self, **options) -> LandmarkBlock:
        term = BearingTerm(self.frames, self.owners, self.bearings, SIGMA)
        return LandmarkBlock(self.keys, self.points, [term], RobustLoss("cauchy", 2.0), **options)

    def system(self, **options) -> ReducedSystem:
        system = reduced_system(self.graph, [self.block(**options)], self.values)
        system.linearize(self.values)
        return system


@pytest.fixture(scope="module")
def world() -> World:
    return World()


@pytest.fixture
def held(monkeypatch) -> None:
    """Nothing is written out, groups are small."""
    monkeypatch.setattr(direct_system, "_MAX_OPERATIONS", 0)
    monkeypatch.setattr(direct_system, "_MAX_INVERSE_OPERATIONS", 0)


def of_landmarks(world: World) -> np.ndarray:
    """The landmarks' part of H (6 F, 6 F), written out."""
    block = world.block()
    return dense(block.linearize(world.values), block.pairs)[0]


@pytest.mark.parametrize("num_right", [1, 5])
def test_products_are_those_of_the_system_written_out(world, num_right) -> None:
    block, H = world.block(), of_landmarks(world)
    complement, gradient, costs = block.eliminate(world.values)
    x = np.random.default_rng(0).normal(size=(NUM_FRAMES, 6, num_right))
    expected = (H @ x.reshape(len(H), -1)).reshape(x.shape)
    assert np.allclose(complement.times(x), expected, atol=1e-9 * np.abs(expected).max())
    system = block.linearize(world.values)
    assert np.allclose(complement.diagonal, system.diagonal, rtol=1e-9, atol=1e-6)
    assert np.allclose(gradient, system.gradient, rtol=1e-9, atol=1e-6)
    assert costs == pytest.approx(dict(system.costs))


def test_groups_feel_what_their_frames_feel_together(world, held) -> None:
    system = world.system()
    found = system._groups
    assert 1 < found.num < NUM_FRAMES
    damped = system._written + 0.1 * np.eye(6)
    given = system._off_diagonal, system._pairs, system._complements, found, system._bases
    coarse = coarse_preconditioner.coarse_system(damped, *given)
    H = of_landmarks(world).reshape(NUM_FRAMES, 6, NUM_FRAMES, 6)
    for f, diagonal in enumerate(damped):
        H[f, :, f] += diagonal
    for (f, g), off in zip(system._pairs, system._off_diagonal, strict=True):
        H[f, :, g] += off
        H[g, :, f] += off.T
    Z = coarse.motion.toarray()
    lower = np.tril(coarse.lower)
    still = np.diag(~Z.any(axis=0))  # one frame alone does not stretch
    felt = Z.T @ H.reshape(len(Z), -1) @ Z + still
    assert np.allclose(felt, lower @ lower.T, atol=1e-8)
    force = np.random.default_rng(1).normal(size=(NUM_FRAMES, 6, 2))
    expected = Z @ np.linalg.solve(lower @ lower.T, Z.T @ force.reshape(len(Z), -1))
    assert np.allclose(coarse.solve(force).reshape(len(Z), -1), expected, rtol=1e-6, atol=1e-12)


def test_a_step_is_that_of_a_factorization(world, held, monkeypatch) -> None:
    monkeypatch.setattr(iterative_system, "STEP_TOLERANCE", 1e-10)
    iterated = world.system()
    monkeypatch.setattr(direct_system, "_MAX_OPERATIONS", np.inf)
    direct = world.system()
    assert isinstance(iterated, IterativeSystem) and isinstance(direct, DirectSystem)
    for damping in (1e-3, 1e-6):  # the second one by the groups' system of the first
        steps, exact = iterated.solve(damping), direct.solve(damping)
        assert steps is not None and exact is not None and np.allclose(steps, exact, atol=1e-8)
        expected = direct.predicted_decrease()
        assert iterated.predicted_decrease() == pytest.approx(expected, rel=1e-8)


def test_blocks_without_products_are_written_out_beside_those_with(
    world, held, monkeypatch
) -> None:
    monkeypatch.setattr(iterative_system, "STEP_TOLERANCE", 1e-10)
    other = world.block()
    written = QuadraticBlock(other.keys, other.pairs, other.linearize(world.values))
    assert written.products() is None
    args = world.graph, [written, world.block()], world.values
    only = reduced_system(world.graph, [written], world.values)
    joint = reduced_system(*args, [(X(0), X(1))])  # draws know no errors of a written block
    assert isinstance(only, DirectSystem) and isinstance(joint, DirectSystem)
    iterated, direct = reduced_system(*args), DirectSystem(SystemLayout(*args))
    assert isinstance(iterated, IterativeSystem)
    costs = [system.linearize(world.values) for system in (iterated, direct)]
    assert costs[0] == pytest.approx(costs[1])
    steps, exact = iterated.solve(1e-3), direct.solve(1e-3)
    assert steps is not None and exact is not None and np.allclose(steps, exact, atol=1e-8)


def test_the_optimum_is_the_same(world, held, monkeypatch) -> None:
    tight = SolverOptions(relative_tolerance=1e-12, max_iterations=200)
    iterated = optimize(world.graph, world.values, [world.block()], tight)
    monkeypatch.setattr(direct_system, "_MAX_OPERATIONS", np.inf)
    direct = optimize(world.graph, world.values, [world.block()], tight)
    assert iterated.cost == pytest.approx(direct.cost, rel=1e-9)
    for key in world.keys:
        pose = direct.values.atPose3(key)
        assert np.abs(pose.localCoordinates(iterated.values.atPose3(key))).max() < 1e-5


def test_threads_change_nothing(world, held, monkeypatch) -> None:
    monkeypatch.setattr("factors.landmarks._MAX_VISITS_AT_ONCE", 100)  # several runs
    one, three = (world.system(num_threads=n) for n in (1, 3))
    assert len(one._complements[0][0].runs) > 3
    assert one.solve(1e-3).tobytes() == three.solve(1e-3).tobytes()


def test_errors_that_are_drawn_spread_as_the_inverse_says(world, held, monkeypatch) -> None:
    pairs = [(X(f), X(f + 1)) for f in range(NUM_FRAMES - 1)]
    iterated = reduced_system(world.graph, [world.block()], world.values, pairs)
    monkeypatch.setattr(direct_system, "_MAX_INVERSE_OPERATIONS", np.inf)
    direct = reduced_system(world.graph, [world.block()], world.values, pairs)
    assert isinstance(iterated, IterativeSystem) and isinstance(direct, DirectSystem)
    found, expected = [], []
    for system, out, num in ((iterated, found, 4000), (direct, expected, 2)):
        system.linearize(world.values)
        answer = system.covariances(num, np.random.default_rng(0))
        assert answer is not None
        out.extend(answer)
    assert found[2].shape == (4000, NUM_FRAMES, 6)
    sigmas, true = (np.sqrt(np.einsum("nii->ni", some[0])) for some in (found, expected))
    assert np.allclose(sigmas / true, 1, atol=0.08)  # seven standard deviations of a spread's
    for p in range(len(pairs)):  # errors of steps, which are far smaller
        steps = []
        for inverse, between, _ in (found, expected):
            across = between[p] + between[p].T
            steps.append(np.diagonal(inverse[p] + inverse[p + 1] - across))
        assert np.allclose(np.sqrt(steps[0] / steps[1]), 1, atol=0.08)


def test_a_group_moves_as_one(world) -> None:
    labels = np.arange(NUM_FRAMES) % 3 - 1  # those of -1 stay
    poses = pose_rows(world.values, world.keys)
    bases = Groups(labels, 2).bases(poses)
    move = 1e-6 * np.array([0.3, -0.2, 0.5, 0.7, -0.4, 0.1, 0.9])
    turn = gtsam.Rot3.Expmap(move[:3])
    for f in range(NUM_FRAMES):
        if labels[f] < 0:
            assert not bases[f].any()
            continue
        middle = poses[labels == labels[f], 9:].mean(axis=0)
        pose = world.values.atPose3(world.keys[f])
        arm = pose.translation() - middle
        there = middle + (1 + move[6]) * turn.rotate(arm) + move[3:6]
        moved = gtsam.Pose3(turn.compose(pose.rotation()), there)
        expected = pose.localCoordinates(moved)
        assert np.allclose(bases[f] @ move, expected, atol=1e-10)


def test_groups_hold_what_shares_the_most(monkeypatch) -> None:
    monkeypatch.setattr(coarse_preconditioner, "_MIN_GROUP_SIZE", 3)
    rows = np.array([[0, 1], [1, 2], [0, 2], [2, 3], [3, 4], [4, 5], [5, 3], [6, 7]])
    shared = np.array([9, 9, 9, 1, 9, 9, 9, 5])
    found = covisible_groups(9, [(rows, shared)])
    assert found.num == 3
    assert len(set(found.labels[:3])) == len(set(found.labels[3:6])) == 1
    assert found.labels[6] == found.labels[7] and found.labels[8] == -1
    assert found.labels.max() == 2 and GROUP_DIM == 7
