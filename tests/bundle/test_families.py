"""Families of residuals: their variables in the graph, the gauge they fix, and what is refused."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from refusals import refused
from synthetic import RIG, World, drifted, make_world

from factors import Block, Term, block_factor
from factors.block import PoseSystem
from gsba import Family, MapSnapshot, PointObservations, X
from gsba.bundle import adjustment, gauge
from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.families import Bearings, Families, kept, restored
from gsba.bundle.optimizer import SolverOptions, optimize
from gsba.bundle.trajectory_prior import TrajectoryPrior
from gsba.config import RefineSettings
from gsba.log import GsbaError
from gsba.similarity import Sim3
from gsba.types import Solution

B = gtsam.symbol("B", 0)
SETTINGS = RefineSettings()
MOVE = Sim3(2.5, gtsam.Rot3.Expmap(np.array([0.4, -1.1, 0.3])).matrix(), np.array([3.0, -1.0, 7.0]))


class Sideways(Family):
    """A position along x for each frame, all off by one unknown bias."""

    name, digest = "sideways", "1"

    def __init__(self, measured: np.ndarray, sigma: float = 0.01, key: int = B) -> None:
        self.measured, self.sigma, self.key = measured, sigma, key

    def variables(self, snapshot: MapSnapshot) -> gtsam.Values:
        values = gtsam.Values()
        values.insert(self.key, np.zeros(1))
        return values

    def graph(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
        graph, noise = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Isotropic.Sigma(1, self.sigma)
        for f, x in enumerate(self.measured.tolist()):
            graph.add(gtsam.CustomFactor(noise, [X(f), self.key], self._error_of(x)))
        return graph

    def _error_of(self, x: float):
        def error(factor, values, jacobians):
            pose, bias = values.atPose3(factor.keys()[0]), values.atVector(self.key)
            if jacobians is not None:
                jacobians[0] = np.append(np.zeros(3), pose.rotation().matrix()[0])[None]
                jacobians[1] = np.ones((1, 1))
            return np.array([pose.x() + bias[0] - x])

        return error


class SidewaysInOneBlock(Sideways):
    """The same held as arrays, on keys of six and of one dimension."""

    name = "sideways_block"

    def graph(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
        return gtsam.NonlinearFactorGraph()

    def blocks(self, snapshot: MapSnapshot) -> tuple[Block, ...]:
        return (_SidewaysBlock(self),)


class _SidewaysBlock:
    def __init__(self, family: Sideways) -> None:
        num = len(family.measured)
        self.keys = [*(X(f) for f in range(num)), family.key]
        self.pairs = np.column_stack([np.arange(num), np.full(num, num)])
        self._family = family

    def refresh(self, values: gtsam.Values) -> None: ...

    def accept(self) -> None: ...

    def _residuals(self, values: gtsam.Values) -> np.ndarray:
        xs = np.array([values.atPose3(key).x() for key in self.keys[:-1]])
        return (xs + values.atVector(self.keys[-1]) - self._family.measured) / self._family.sigma

    def linearize(self, values: gtsam.Values) -> PoseSystem:
        residuals, num = self._residuals(values), len(self.keys)
        by = np.zeros((num, 6))
        for f, key in enumerate(self.keys[:-1]):
            by[f, 3:] = values.atPose3(key).rotation().matrix()[0] / self._family.sigma
        by[-1, 0] = 1 / self._family.sigma
        diagonal = np.einsum("fi,fj->fij", by, by)
        diagonal[-1] *= num - 1
        gradient = by * np.append(residuals, residuals.sum())[:, None]
        off = np.einsum("fi,j->fij", by[:-1], by[-1])
        return PoseSystem(diagonal, off, gradient, self.costs(values))

    def products(self) -> None:
        return None

    def propose(self, values: gtsam.Values, steps: np.ndarray) -> float:
        return 0.5 * float(np.sum(self._residuals(values) ** 2))

    def costs(self, values: gtsam.Values) -> dict[str, float]:
        return {"sideways": self.propose(values, np.zeros((len(self.keys), 6)))}


class Where(Family):
    """Poses of some frames in a world of their own."""

    name, digest, fixes_gauge = "where", "1", True

    def __init__(self, poses: dict[int, np.ndarray]) -> None:
        self.poses = poses

    def graph(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
        graph, noise = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Isotropic.Sigma(6, 0.01)
        for f, pose in self.poses.items():
            graph.add(gtsam.PriorFactorPose3(X(f), gtsam.Pose3(pose), noise))
        return graph


class Ranges(Family):
    """Distances between neighbours alone: the scale."""

    name, digest, fixes_gauge = "ranges", "1", True

    def __init__(self, lengths: np.ndarray) -> None:
        self.lengths = lengths

    def graph(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
        graph, noise = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Isotropic.Sigma(1, 0.01)
        for f, length in enumerate(self.lengths.tolist()):
            graph.add(gtsam.RangeFactorPose3(X(f), X(f + 1), length, noise))
        return graph


def _adjusted(world: World, *members: Family) -> tuple[Solution, AdjustmentContext]:
    """The synthetic world from a drifting start, with families."""
    coarse = drifted(world.world_T_rigs, np.random.default_rng(0))
    every = Bearings(), TrajectoryPrior(coarse, SETTINGS.priors), *members
    families = Families(every, tuple(map(str, range(len(coarse)))), np.arange(float(len(coarse))))
    problem = AdjustmentContext(families, RIG, SETTINGS, 1)
    start = Solution.without_points(coarse)
    gates = (200.0, 60.0, 20.0, 8.0, 8.0)
    return adjustment.adjust(world.tracks, world.keypoints, start, problem, gates), problem


@pytest.fixture(scope="module")
def world() -> World:
    return make_world(0)


def _measured(world: World, bias: float = 5.0) -> np.ndarray:
    noise = np.random.default_rng(1).normal(0, 0.01, len(world.world_T_rigs))
    return world.world_T_rigs[:, 0, 3] + bias + noise


def test_own_variables_are_solved_with_the_poses(world: World) -> None:
    solved, problem = _adjusted(world, Sideways(_measured(world)))
    bias = problem.families.snapshot(solved).variables.atVector(B)[0]
    off = world.world_T_rigs[0, 0, 3] - solved.world_T_rigs[0, 0, 3]
    assert bias + off == pytest.approx(5.0, abs=0.05)


def test_a_joint_solve_agrees_with_gtsam(world: World) -> None:
    solved, problem = _adjusted(world, Sideways(_measured(world)))
    block = adjustment.landmark_block(solved.landmarks, world.keypoints, solved.noise, problem)
    tight = SolverOptions(relative_tolerance=1e-12, absolute_tolerance=1e-8, max_iterations=100)
    terms = problem.terms(solved)
    ours = optimize(terms.graph, terms.values, [block], tight)
    graph = gtsam.NonlinearFactorGraph(terms.graph)
    graph.add(block_factor(block))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-13)
    theirs = gtsam.LevenbergMarquardtOptimizer(graph, ours.values, parameters).optimize()
    assert graph.error(theirs) == pytest.approx(graph.error(ours.values), rel=1e-7)
    assert theirs.atVector(B)[0] == pytest.approx(ours.values.atVector(B)[0], abs=1e-5)


def test_a_block_on_a_small_variable_is_the_same_as_its_factors(world: World) -> None:
    one, _ = _adjusted(world, Sideways(_measured(world)))
    other, _ = _adjusted(world, SidewaysInOneBlock(_measured(world)))
    np.testing.assert_allclose(one.world_T_rigs, other.world_T_rigs, atol=1e-6)
    np.testing.assert_allclose(one.variables.data, other.variables.data, atol=1e-6)


def test_covariances_know_of_own_variables(world: World) -> None:
    solved, problem = _adjusted(world)
    without, _ = adjustment.pose_covariances(solved, world.keypoints, problem)
    solved, problem = _adjusted(world, Sideways(_measured(world), sigma=1e-5))
    found, _ = adjustment.pose_covariances(solved, world.keypoints, problem)
    x = solved.world_T_rigs[:, 0, :3]
    spread = [np.einsum("fi,fij,fj->f", x, c[:, 3:, 3:], x)[1:] for c in (without, found)]
    assert np.median(spread[1]) < 0.1 * np.median(spread[0])


@pytest.mark.parametrize("block", [False, True])
def test_the_gauge_of_a_family_is_found_from_afar(world: World, block: bool) -> None:
    poses = MOVE.poses(world.world_T_rigs)
    members: list[Family] = [Where({0: poses[0], 7: poses[7], 12: poses[12]})]
    if block:
        measured = poses[:, 0, 3] + 5.0
        members.append(type("Fixing", (SidewaysInOneBlock,), {"fixes_gauge": True})(measured))
    start = Solution.without_points(world.world_T_rigs)
    found = gauge.align(Families(tuple(members)), start)
    np.testing.assert_allclose(found.moved(start, None).world_T_rigs, poses, atol=1e-4)


def test_a_scale_alone_leaves_the_world(world: World) -> None:
    lengths = 3 * np.linalg.norm(np.diff(world.world_T_rigs[:, :3, 3], axis=0), axis=1)
    start = Solution.without_points(world.world_T_rigs)
    found = gauge.align(Families((Ranges(lengths),)), start).moves[0]
    assert found.scale == pytest.approx(3.0, rel=1e-5)
    np.testing.assert_allclose(found.rotation, np.eye(3), atol=1e-6)


def test_each_map_has_a_gauge_of_its_own(world: World) -> None:
    maps = (np.arange(len(world.world_T_rigs)) >= 10).astype(np.int64)
    poses = MOVE.poses(world.world_T_rigs)
    poses[maps == 0] = world.world_T_rigs[maps == 0]
    known = {f: poses[f] for f in (0, 4, 9, 10, 15, 19)}
    start = Solution.without_points(world.world_T_rigs)
    found = gauge.align(Families((Where(known),)), start, maps)
    np.testing.assert_allclose(found.moved(start, maps).world_T_rigs, poses, atol=1e-4)


def test_variables_of_every_type_are_stored() -> None:
    rng, values = np.random.default_rng(0), gtsam.Values()
    turn = gtsam.Rot3.Expmap(rng.normal(size=3))
    numbers = [rng.normal(size=n) for n in (2, 3, 7)]
    others = [
        1.5,
        turn,
        gtsam.Pose3(turn, rng.normal(size=3)),
        gtsam.Unit3(rng.normal(size=3)),
        gtsam.Similarity3(turn, rng.normal(size=3), 2.5),
        gtsam.imuBias.ConstantBias(rng.normal(size=3), rng.normal(size=3)),
    ]
    for n, value in enumerate([*numbers, *others]):
        values.insert(gtsam.symbol("B", n), value)
    assert restored(kept(values, list(values.keys()))).equals(values, 1e-12)
    values.insert(gtsam.symbol("B", 99), gtsam.Cal3_S2())
    refused("B99 is of a type", kept, values, list(values.keys()))


def test_what_cannot_be_solved_is_refused(world: World) -> None:
    start, measured = Solution.without_points(world.world_T_rigs), _measured(world)
    with pytest.raises(GsbaError, match=r"variable b0: .* capital letter"):
        Families((Sideways(measured, key=gtsam.symbol("b", 0)),)).terms(start)
    refused("two families are named sideways", Families, (Sideways(measured), Sideways(measured)))
    with pytest.raises(GsbaError, match="B0 belongs to another family"):
        Families((Sideways(measured), SidewaysInOneBlock(measured))).terms(start)
    with pytest.raises(GsbaError, match="factor 20 is about variable x20, which has no value"):
        Families((Sideways(np.append(measured, 0)),)).terms(start)

    class Hard(Sideways):
        def graph(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
            graph, hard = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Constrained.All(6)
            graph.add(gtsam.PriorFactorPose3(X(1), gtsam.Pose3(), hard))
            return graph

    class Forgetful(Sideways):
        def graph(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
            super().graph(snapshot)

    refused("family sideways: factor 0 is a hard", Families((Hard(measured),)).terms, start)
    refused(r"graph\(\) returns NoneType", Families((Forgetful(measured),)).terms, start)


class _Nameless(Family):
    digest = "1"


class _Misspelt(Family):
    name, digest = "misspelt", "1"

    def graphs(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
        return gtsam.NonlinearFactorGraph()


class _Unasked(Family):
    name, digest = "unasked", "1"

    def landmark_terms(self, observed: PointObservations) -> list[Term]:
        return []


def test_a_family_that_could_not_take_part_is_refused() -> None:
    refused("_Misspelt'> is no object of a subclass of gsba.Family", Families, (_Misspelt,))
    refused("family _Nameless has no name", Families, (_Nameless(),))
    refused("family misspelt has no residuals: define graph", Families, (_Misspelt(),))
    refused("family unasked: .* observes_points = True", Families, (_Unasked(),))


def test_values_so_far_are_shown_to_families(world: World) -> None:
    seen = list[float]()

    class Curious(Sideways):
        def variables(self, snapshot: MapSnapshot) -> gtsam.Values:
            if snapshot.variables.exists(B):
                seen.append(snapshot.variables.atVector(B)[0])
            return super().variables(snapshot)

    solved, problem = _adjusted(world, Curious(_measured(world)))
    assert seen and seen[-1] == pytest.approx(5.0, abs=0.3)
    assert problem.terms(replace(solved, variables=None)).own.values.atVector(B)[0] == 0
