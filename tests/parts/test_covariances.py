"""Covariances of a map in parts, beside those of the undivided map."""

from pathlib import Path

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, X
from town_in_parts import NUM, town

from factors import LandmarkBlock, RobustLoss
from gsba.bundle.optimizer import SolverOptions, marginal_covariances, optimize
from gsba.parts.divided_system import divided_covariances, optimize_divided
from gsba.parts.folder import PartsWriter, load_index, values_at
from gsba.store.shards import Threads

LOSS = RobustLoss("cauchy", 2.0)


def with_biases(graph: gtsam.NonlinearFactorGraph, poses: gtsam.Values) -> gtsam.Values:
    """Add a bias of positions that all frames share, and a variable of eight dimensions."""
    values = gtsam.Values()
    values.insert(B(0), np.zeros(3))
    values.insert(B(1), np.zeros(8))
    unit = gtsam.noiseModel.Isotropic.Sigma(3, 0.1)
    rng = np.random.default_rng(3)
    for frame in range(NUM):
        here = gtsam.Values()
        here.insert(X(frame), poses.atPose3(X(frame)))
        here.insert(B(0), np.zeros(3))
        by_pose = np.hstack([np.zeros((3, 3)), np.eye(3)])
        off = 0.05 * rng.normal(size=3) + 0.02
        rows = gtsam.JacobianFactor(X(frame), by_pose, B(0), -np.eye(3), off, unit)
        graph.add(gtsam.LinearContainerFactor(rows, here))
    for frame in (3, 60):
        here = gtsam.Values()
        here.insert(X(frame), poses.atPose3(X(frame)))
        here.insert(B(1), np.zeros(8))
        by_pose = rng.normal(size=(3, 6))
        rows = gtsam.JacobianFactor(
            X(frame), by_pose, B(1), rng.normal(size=(3, 8)), rng.normal(size=3), unit
        )
        graph.add(gtsam.LinearContainerFactor(rows, here))
    for key, dim in ((B(0), 3), (B(1), 8)):
        model = gtsam.noiseModel.Isotropic.Sigma(dim, 1.0)
        graph.add(gtsam.PriorFactorVector(key, np.zeros(dim), model))
    return values


@pytest.mark.parametrize("most", [15, 40, NUM + 2])
def test_parts_give_the_undivided_covariances(most: int, tmp_path: Path) -> None:
    points, term, rows, graph = town()
    values = values_at(range(NUM), rows)
    values.insert(with_biases(graph, values))
    writer = PartsWriter(tmp_path / "map")
    writer.tie(np.column_stack([np.arange(NUM - 1), np.arange(1, NUM)]))
    writer.add(points, [term], graph)
    writer.finish(values, NUM, writer.cut(values, NUM, most))
    keys = [X(f) for f in range(NUM)]
    block = LandmarkBlock(keys, points, [term], LOSS, num_threads=1)
    expected, joint = marginal_covariances(graph, [block], values, keys)
    found, between = divided_covariances(tmp_path / "map", Threads(2), LOSS, 3000, 1)
    assert np.isfinite(expected).all()
    assert (len(load_index(tmp_path / "map").num_kept) > 1) == (most < NUM)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, atol=1e-9 * scale)
    np.testing.assert_allclose(between.neighbours, joint.neighbours, atol=1e-9 * scale)
    sigmas = np.sqrt(np.einsum("fii->fi", expected))
    draws = between.draws / sigmas
    spread = np.einsum("dfi,dfi->fi", draws, draws) / len(draws)
    assert abs(spread.mean() - 1) < 0.05 and spread.min() > 0.8 and spread.max() < 1.25
    across = np.einsum("dfi,dfj->fij", draws[:, :-1], draws[:, 1:]) / len(draws)
    correlated = joint.neighbours / sigmas[:-1, :, None] / sigmas[1:, None, :]
    assert np.abs(across - correlated).max() < 0.12  # six deviations of 3,000 draws


@pytest.mark.parametrize("dim", [6, 7, 14])
def test_a_part_may_own_a_variable_of_several_nodes(dim: int, tmp_path: Path) -> None:
    """As the similarity of a small map with GPS: nodes behind it are no rows of the keys."""
    points, term, rows, graph = town()
    values, here = values_at(range(NUM), rows), gtsam.Values()
    here.insert(X(3), values.atPose3(X(3)))
    for some in (here, values):
        some.insert(B(1), np.zeros(dim))
    unit, rng = gtsam.noiseModel.Isotropic.Sigma(3, 0.1), np.random.default_rng(3)
    by_pose, by_vector = rng.normal(size=(3, 6)), rng.normal(size=(3, dim))
    linear = gtsam.JacobianFactor(X(3), by_pose, B(1), by_vector, np.zeros(3), unit)
    graph.add(gtsam.LinearContainerFactor(linear, here))
    model = gtsam.noiseModel.Isotropic.Sigma(dim, 1.0)
    graph.add(gtsam.PriorFactorVector(B(1), np.zeros(dim), model))
    writer = PartsWriter(tmp_path / "map")
    writer.tie(np.column_stack([np.arange(NUM - 1), np.arange(1, NUM)]))
    writer.add(points, [term], graph)
    writer.finish(values, NUM, writer.cut(values, NUM, 15))
    keys = [X(f) for f in range(NUM)]
    block = LandmarkBlock(keys, points, [term], LOSS, num_threads=1)
    expected, joint = marginal_covariances(graph, [block], values, keys)
    found, between = divided_covariances(tmp_path / "map", Threads(1), LOSS, 2, 1)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, atol=1e-9 * scale)
    np.testing.assert_allclose(between.neighbours, joint.neighbours, atol=1e-9 * scale)


@pytest.mark.parametrize("most", [15, NUM + 2])
def test_variables_that_all_share_move_as_undivided(most: int, tmp_path: Path) -> None:
    settings = SolverOptions(relative_tolerance=1e-10, absolute_tolerance=None, loss=LOSS)
    points, term, rows, graph = town()
    values = values_at(range(NUM), rows)
    values.insert(with_biases(graph, values))
    writer = PartsWriter(tmp_path / "map")
    writer.add(points, [term], graph)
    writer.finish(values, NUM, writer.cut(values, NUM, most))
    keys = [X(f) for f in range(NUM)]
    block = LandmarkBlock(keys, points, [term], LOSS, num_threads=1)
    expected = optimize(graph, values, [block], settings)
    found = optimize_divided(tmp_path / "map", Threads(1), settings)
    assert found.cost == pytest.approx(expected.cost, rel=1e-9)
    for key in (B(0), B(1)):
        moved = expected.values.atVector(key)
        assert np.linalg.norm(moved) > 1e-2
        np.testing.assert_allclose(found.values.atVector(key), moved, atol=1e-7)


def test_what_nothing_constrains_is_not_a_number(tmp_path: Path) -> None:
    points, term, rows, graph = town()
    lonely = values_at(range(NUM + 1), np.vstack([rows, rows[:1]]))
    writer = PartsWriter(tmp_path / "map")
    writer.tie(np.column_stack([np.arange(NUM), np.arange(1, NUM + 1)]))
    writer.add(points, [term], graph)
    writer.finish(lonely, NUM + 1, writer.cut(lonely, NUM + 1, 30))
    found, joint = divided_covariances(tmp_path / "map", Threads(1), LOSS, 2, 1)
    assert np.isnan(found[NUM]).all() and np.isfinite(found[:NUM]).all()
    assert np.isnan(joint.neighbours[-1]).all() and np.isfinite(joint.neighbours[:-1]).all()
    assert np.isnan(joint.draws[:, NUM]).all() and np.isfinite(joint.draws[:, :NUM]).all()
