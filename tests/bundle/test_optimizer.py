"""Blocks against reference factors against native ones; the loop against stock optimizers."""

import gtsam
import numpy as np
import pytest
from dense_system import dense
from gtsam.symbol_shorthand import L, X
from refusals import refused

import gsba
from factors import (
    BearingFactor,
    BearingTerm,
    FaceCameras,
    LandmarkBlock,
    ReprojectionFactor,
    ReprojectionTerm,
    RobustLoss,
    block_factor,
    landmarks,
)
from factors.direct_system import DirectSystem
from factors.system_layout import SystemLayout
from gsba.bundle.optimizer import SolverOptions, marginal_covariances, optimize

SIGMA_RAD, SIGMA_PX = 1e-3, 0.5
LOSS = RobustLoss("cauchy", 2.0)
CAMERAS = FaceCameras(
    rig_R_faces=np.array([gtsam.Rot3.Ry(i * np.pi / 2).matrix() for i in range(4)]),
    focals=np.full(4, 250.0),
    principals=np.full((4, 2), 256.0),
)
PRIOR = gtsam.noiseModel.Isotropic.Sigma(6, 0.02)
TIGHT = SolverOptions(relative_tolerance=1e-12, absolute_tolerance=1e-6, max_iterations=200)


class World:
    """Frames on a line among landmarks; bearings of all, pixels of some."""

    def __init__(self, num_frames: int = 8, num_points: int = 40) -> None:
        rng = np.random.default_rng(0)
        self.truth = [
            gtsam.Pose3(gtsam.Rot3.Ypr(*(0.3 * rng.normal(size=3))), np.array([0.5 * f, 0, 0.1]))
            for f in range(num_frames)
        ]
        points = rng.uniform([-2, -4, -4], [6, 4, 4], (num_points, 3))
        f, j = (a.ravel() for a in np.meshgrid(np.arange(num_frames), np.arange(num_points)))
        keep = rng.random(len(f)) < 0.8
        self.frames, self.owners = f[keep], j[keep]
        local = np.array(
            [self.truth[f].transformTo(points[j]) for f, j in zip(f[keep], j[keep], strict=True)]
        )
        self.bearings = local / np.linalg.norm(local, axis=1, keepdims=True)
        self.bearings += SIGMA_RAD * rng.normal(size=local.shape)
        self.bearings[::30] += 0.05 * rng.normal(size=self.bearings[::30].shape)  # outliers
        self.bearings /= np.linalg.norm(self.bearings, axis=1, keepdims=True)
        faces = np.argmax(local @ CAMERAS.rig_R_faces[:, :, 2].T, axis=1)
        on_face = np.einsum("nji,nj->ni", CAMERAS.rig_R_faces[faces], local)
        pixels = 250 * on_face[:, :2] / on_face[:, 2:] + 256
        pixels += SIGMA_PX * rng.normal(size=pixels.shape)
        some = (np.abs(on_face[:, 1]) < on_face[:, 2]) & (rng.random(len(faces)) < 0.5)
        self.pixel_rows, self.pixels, self.faces = np.flatnonzero(some), pixels[some], faces[some]
        self.start_points = points + 0.05 * rng.normal(size=points.shape)
        self.values = gtsam.Values()
        self.graph = gtsam.NonlinearFactorGraph()
        for f, pose in enumerate(self.truth):
            self.values.insert(X(f), pose.retract(0.02 * rng.normal(size=6)))
            self.graph.add(gtsam.PriorFactorPose3(X(f), pose, PRIOR))
        self.keys = [X(f) for f in range(num_frames)]

    def block(self, **options) -> LandmarkBlock:
        rows = self.pixel_rows
        terms = [
            BearingTerm(self.frames, self.owners, self.bearings, SIGMA_RAD),
            ReprojectionTerm(
                self.frames[rows], self.owners[rows], self.pixels, self.faces, CAMERAS, SIGMA_PX
            ),
        ]
        return LandmarkBlock(self.keys, self.start_points, terms, LOSS, **options)

    def reference(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """The same problem in single factors, landmarks as variables."""
        graph, values = gtsam.NonlinearFactorGraph(self.graph), gtsam.Values(self.values)
        noise = LOSS.noise_model(gtsam.noiseModel.Isotropic.Sigma(2, SIGMA_RAD))
        for f, j, bearing in zip(self.frames, self.owners, self.bearings, strict=True):
            graph.add(BearingFactor(X(f), L(j), bearing, noise))
        noise = LOSS.noise_model(gtsam.noiseModel.Isotropic.Sigma(2, SIGMA_PX))
        for row, pixel, face in zip(self.pixel_rows, self.pixels, self.faces, strict=True):
            f, j = self.frames[row], self.owners[row]
            graph.add(ReprojectionFactor(X(f), L(j), pixel, int(face), CAMERAS, noise))
        for j, point in enumerate(self.start_points):
            values.insert(L(j), point)
        return graph, values


@pytest.fixture(scope="module")
def world() -> World:
    return World()


@pytest.fixture(scope="module")
def solved(world):
    """The fast door's result and its block."""
    block = world.block()
    return optimize(world.graph, world.values, [block], TIGHT), block


def stock(graph, values) -> gtsam.Values:
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-12)
    params.setAbsoluteErrorTol(1e-12)
    params.setMaxIterations(300)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()


def distance(a: gtsam.Values, b: gtsam.Values, keys) -> float:
    return max(np.abs(a.atPose3(k).localCoordinates(b.atPose3(k))).max() for k in keys)


def test_block_costs_what_its_reference_factors_cost(world):
    graph, values = world.reference()
    costs = world.block().costs(world.values)
    assert set(costs) == {"bearing", "reprojection"}
    expected = graph.error(values) - world.graph.error(values)
    assert sum(costs.values()) == pytest.approx(expected, rel=1e-10)


def test_reduced_system_is_the_schur_complement_of_the_reference_factors(world):
    graph, values = world.reference()
    priors = world.graph.size()
    only = gtsam.NonlinearFactorGraph()
    for i in range(priors, graph.size()):
        only.add(graph.at(i))
    order = gtsam.Ordering()
    for key in [*world.keys, *(L(j) for j in range(len(world.start_points)))]:
        order.push_back(key)
    H, minus_g = only.linearize(values).hessian(order)
    num = 6 * len(world.keys)
    eliminate = H[:num, num:] @ np.linalg.inv(H[num:, num:])
    expected_H = H[:num, :num] - eliminate @ H[num:, :num]
    expected_g = -(minus_g[:num] - eliminate @ minus_g[num:])
    block = world.block()
    found_H, found_g = dense(block.linearize(world.values), block.pairs)
    # the elimination damps each landmark by 1e-12 of its trace
    assert np.abs(found_H - expected_H).max() < 1e-7 * np.abs(expected_H).max()
    assert np.abs(found_g - expected_g).max() < 1e-7 * np.abs(expected_g).max()


def test_reference_factors_a_block_and_its_factor_agree(world, solved):
    result, _ = solved
    assert result.converged
    graph, values = world.reference()
    reference = stock(graph, values)
    assert result.cost == pytest.approx(graph.error(reference), rel=1e-8)
    # cost is flat at the optimum: 1e-8 of it is 1e-4 sigmas, and a sigma of a pose about 1e-3
    assert distance(result.values, reference, world.keys) < 1e-6
    again = world.block()
    grouped = gtsam.NonlinearFactorGraph(world.graph)
    grouped.add(block_factor(again))
    hosted = stock(grouped, world.values)
    assert grouped.error(hosted) == pytest.approx(result.cost, rel=1e-8)
    assert distance(result.values, hosted, world.keys) < 1e-5


def test_a_plain_graph_ends_where_gtsam_ends():
    """Poses and points to 1e-9, of our single factors and GTSAM's priors, without any block."""
    world = World(8, 15)
    graph, values = world.reference()
    exact = SolverOptions(relative_tolerance=1e-15, absolute_tolerance=1e-15, max_iterations=200)
    ours = gsba.optimize(graph, values, options=exact).values
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(0)
    params.setAbsoluteErrorTol(0)
    theirs = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    assert distance(ours, theirs, world.keys) < 1e-9
    points = [L(j) for j in range(len(world.start_points))]
    assert max(np.abs(ours.atPoint3(k) - theirs.atPoint3(k)).max() for k in points) < 1e-9


def test_a_blocks_factor_has_its_cost_with_and_without_derivatives(world):
    block = world.block()
    cost = block.polish(world.values)
    factor = block_factor(block)
    assert factor.error(world.values) == pytest.approx(cost, rel=1e-6)
    zero = world.values.zeroVectors()
    assert factor.linearize(world.values).error(zero) == pytest.approx(cost, rel=1e-6)


def test_covariances_agree_with_marginals(world, solved):
    result, block = solved
    graph, values = world.reference()
    for key in world.keys:
        values.update(key, result.values.atPose3(key))
    for j, point in enumerate(block.points_world):
        values.update(L(j), point)
    marginals = gtsam.Marginals(graph, values)
    covariances, joint = marginal_covariances(world.graph, [block], result.values, world.keys)
    for key, covariance in zip(world.keys, covariances, strict=True):
        expected = marginals.marginalCovariance(key)
        assert np.abs(covariance - expected).max() < 1e-5 * np.abs(expected).max()
    for first, second, covariance in zip(
        world.keys, world.keys[1:], joint.neighbours, strict=False
    ):
        expected = marginals.jointMarginalCovariance([first, second]).at(first, second)
        assert np.abs(covariance - expected).max() < 1e-5 * np.abs(expected).max()


def test_result_does_not_depend_on_threads_or_order(world, solved):
    result, _ = solved
    block = world.block(num_threads=3)
    other = optimize(world.graph, world.values, [block], TIGHT)
    assert distance(result.values, other.values, world.keys) < 1e-6
    assert other.cost == pytest.approx(result.cost, rel=1e-9)


def test_residuals_come_back_in_the_terms_order(world):
    block = world.block()
    (bearing, pixel), (valid, in_front) = block.residuals(world.values)
    assert len(bearing) == len(world.frames) and len(pixel) == len(world.pixels)
    assert valid.all() and in_front.all()
    row = 17
    factor = BearingFactor(
        X(world.frames[row]),
        L(world.owners[row]),
        world.bearings[row],
        gtsam.noiseModel.Isotropic.Sigma(2, SIGMA_RAD),
    )
    expected = factor.error(world.reference()[1])
    assert 0.5 * bearing[row] @ bearing[row] == pytest.approx(expected, rel=1e-9)


def test_square_root_information_weighs_directions(world):
    root = np.array([[2.0, 0.7], [0.0, 0.5]]) / SIGMA_RAD
    turned = gtsam.Rot2(0.8).matrix() @ root  # another root of the same information
    args = (world.frames, world.owners, world.bearings)
    costs = [
        LandmarkBlock(
            world.keys,
            world.start_points,
            [BearingTerm(*args, sqrt_infos=np.tile(r, (len(world.frames), 1, 1)))],
        ).error(world.values)
        for r in (root, turned)
    ]
    graph, values = gtsam.NonlinearFactorGraph(), world.reference()[1]
    noise = gtsam.noiseModel.Gaussian.SqrtInformation(root)
    for f, j, bearing in zip(*args, strict=True):
        graph.add(BearingFactor(X(f), L(j), bearing, noise))
    assert costs == pytest.approx([graph.error(values)] * 2, rel=1e-9)


@pytest.mark.parametrize("kind", ["none", "huber", "cauchy", "geman_mcclure"])
def test_losses_are_gtsams(kind):
    loss = RobustLoss(kind, 1.7)
    model = loss.noise_model(gtsam.noiseModel.Unit.Create(2))
    for norm in (0.0, 0.5, 1.7, 9.0):
        whitened = np.array([0.6, 0.8]) * norm
        prior = gtsam.PriorFactorPoint2(0, np.zeros(2), model)
        values = gtsam.Values()
        values.insert(0, whitened)
        assert loss.rho(np.array([norm**2]))[0] == pytest.approx(prior.error(values), abs=1e-12)


def test_degenerate_landmarks_and_idle_frames_stay_finite(world):
    points = np.array([[1.0, 0, 3], [1, 0, 3], [5, 5, 5], world.truth[0].translation()])
    frames, owners = np.array([0, 1, 1, 2, 0]), np.array([0, 1, 1, 1, 3])  # one ray; none; centre
    bearings = np.tile([0.0, 0.0, 1.0], (5, 1))
    block = LandmarkBlock(world.keys, points, [BearingTerm(frames, owners, bearings, 0.01)])
    result = optimize(world.graph, world.values, [block])
    assert np.isfinite(result.cost) and np.isfinite(block.points_world).all()
    covariances, _ = marginal_covariances(world.graph, [block], result.values, world.keys)
    assert np.isfinite(covariances).all()
    assert np.array_equal(block.points_world[2], points[2])


def test_covariance_of_an_idle_pose_is_nan_and_spoils_no_other(world):
    graph = gtsam.NonlinearFactorGraph(world.graph)
    graph.remove(7)
    seen = world.frames != 7
    term = BearingTerm(world.frames[seen], world.owners[seen], world.bearings[seen], SIGMA_RAD)
    block = LandmarkBlock(world.keys, world.start_points, [term], LOSS)
    result = optimize(graph, world.values, [block])
    assert result.values.atPose3(X(7)).equals(world.values.atPose3(X(7)), 1e-12)
    covariances, joint = marginal_covariances(graph, [block], result.values, world.keys, 3)
    assert np.isnan(covariances[7]).all() and np.isfinite(covariances[:7]).all()
    assert np.isnan(joint.neighbours[6]).all() and np.isfinite(joint.neighbours[:6]).all()
    assert np.isnan(joint.draws[:, 7]).all() and np.isfinite(joint.draws[:, :7]).all()
    free, joint = marginal_covariances(
        gtsam.NonlinearFactorGraph(), [block], result.values, world.keys, 3
    )
    assert free.shape == (8, 6, 6)  # nothing fixes the gauge: no exception
    assert joint.neighbours.shape == (7, 6, 6) and joint.draws.shape == (3, 8, 6)


def test_covariances_of_poses_that_nothing_ties(world):
    """Between such poses they are zero, and asking for them changes no other."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    for key in world.keys[:3]:
        graph.add(gtsam.PriorFactorPose3(key, gtsam.Pose3(), noise))
        values.insert(key, gtsam.Pose3())
    covariances, joint = marginal_covariances(graph, [], values, world.keys[:3])
    np.testing.assert_allclose(covariances, np.tile(0.01 * np.eye(6), (3, 1, 1)))
    np.testing.assert_array_equal(joint.neighbours, np.zeros((2, 6, 6)))


def test_variables_of_other_types_join(world):
    """A scalar and a nine-parameter camera beside the poses, moved by native factors."""
    graph, values = gtsam.NonlinearFactorGraph(world.graph), gtsam.Values(world.values)
    scalar = gtsam.symbol("s", 0)
    values.insert(scalar, 2.0)
    graph.add(gtsam.PriorFactorDouble(scalar, 5.0, gtsam.noiseModel.Isotropic.Sigma(1, 0.1)))
    camera, wanted = gtsam.symbol("k", 0), gtsam.Cal3DS2(300, 310, 0, 1, 2, 0.1, 0.2, 0.3, 0.4)
    values.insert(camera, gtsam.Cal3DS2(200, 200, 0, 0, 0, 0, 0, 0, 0))
    graph.add(gtsam.PriorFactorCal3DS2(camera, wanted, gtsam.noiseModel.Isotropic.Sigma(9, 1.0)))

    def tied(_factor, values, jacobians):
        pose = values.atPose3(X(0))
        if jacobians is not None:
            jacobians[0] = np.array([[-1.0]])
            row = np.zeros((1, 6))
            row[:, 3:] = pose.rotation().matrix()[:1]
            jacobians[1] = row
        return np.array([pose.x() + 3.0 - values.atDouble(scalar)])

    graph.add(gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(1, 0.01), [scalar, X(0)], tied))
    ours = optimize(graph, values, [world.block()], TIGHT)
    grouped = gtsam.NonlinearFactorGraph(graph)
    grouped.add(block_factor(world.block()))
    theirs = stock(grouped, values)
    assert ours.values.atDouble(scalar) == pytest.approx(theirs.atDouble(scalar), abs=1e-6)
    assert np.allclose(ours.values.atCal3DS2(camera).vector(), wanted.vector())
    assert set(ours.history[-1].costs) == {"bearing", "reprojection", "graph"}


def test_bad_steps_are_refused_and_bad_starts_reported(world):
    """A factor that turns NaN away from the start: the loop stays where the cost is a number."""
    key = gtsam.symbol("s", 0)
    values = gtsam.Values(world.values)
    values.insert(key, 1.0)

    def root(_factor, values, jacobians):
        x = values.atDouble(key)
        if jacobians is not None:
            jacobians[0] = np.array([[1.0]])
        return np.array([np.log(x) + 5 if x > 0 else np.nan])

    graph = gtsam.NonlinearFactorGraph(world.graph)
    graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [key], root))
    result = optimize(graph, values, [world.block()])
    assert np.isfinite(result.cost) and result.cost <= result.history[0].cost
    assert not all(step.accepted for step in result.history)
    values.update(key, -1.0)
    refused("graph is not finite", optimize, graph, values, [world.block()])


def _pulled(jacobian):
    """A factor on x0 with this Jacobian."""

    def error(_factor, _values, jacobians):
        if jacobians is not None:
            jacobians[0] = jacobian
        return np.ones(1)

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [X(0)], error)


def test_a_jacobian_that_is_not_finite_is_named(world):
    for bad in (np.nan, np.inf):
        graph, row = gtsam.NonlinearFactorGraph(world.graph), np.eye(6)[:1]
        row[0, 3] = bad
        graph.add(_pulled(row))
        refused("the Jacobian of the factor on x0 is not finite", optimize, graph, world.values)


def test_a_jacobian_of_the_wrong_sign_does_not_converge(world):
    def height(sign):
        def error(_factor, values, jacobians):
            pose = values.atPose3(X(0))
            if jacobians is not None:
                row = np.append(np.zeros(3), pose.rotation().matrix()[1])
                jacobians[0] = sign * row[None]
            return np.array([pose.y() - 1.0])

        graph = gtsam.NonlinearFactorGraph(world.graph)
        noise = gtsam.noiseModel.Isotropic.Sigma(1, 1e-3)
        graph.add(gtsam.CustomFactor(noise, [X(0)], error))
        return graph

    assert optimize(height(1.0), world.values).converged
    result = optimize(height(-1.0), world.values)
    assert not result.converged and "as the Jacobians predict" in result.reason


def test_hard_constraints_are_refused(world):
    hard = gtsam.noiseModel.Constrained.All(6)
    for factor in (
        gtsam.PriorFactorPose3(X(3), world.truth[3], hard),
        gtsam.NonlinearEqualityPose3(X(3), world.truth[3]),
    ):
        graph = gtsam.NonlinearFactorGraph(world.graph)
        graph.add(factor)
        refused("the factor on x3 is a hard constraint", optimize, graph, world.values)


def test_nothing_is_solved_at_once(world):
    result = optimize(gtsam.NonlinearFactorGraph(), world.values)
    assert result.converged and result.cost == 0 and result.values.equals(world.values, 0.0)


def test_interrupt_passes_through(world):
    def stop(_iteration, _values):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        optimize(world.graph, world.values, [world.block()], callback=stop)


def test_bad_terms_are_named(world):
    one = np.array([0])
    with pytest.raises(ValueError, match="frame index"):
        LandmarkBlock(
            world.keys, np.zeros((1, 3)), [BearingTerm(np.array([8]), one, np.eye(3)[:1])]
        )
    with pytest.raises(ValueError, match="finite"):
        LandmarkBlock(
            world.keys, np.zeros((1, 3)), [BearingTerm(one, one, np.full((1, 3), np.nan))]
        )
    with pytest.raises(ValueError, match="positive"):
        LandmarkBlock(world.keys, np.zeros((1, 3)), [BearingTerm(one, one, np.eye(3)[:1], 0.0)])
    refused("no value", optimize, world.graph, gtsam.Values())


def test_what_would_be_taken_for_something_else_is_refused(world):
    """Inputs of a plausible type and shape that would give another problem without a word."""
    one, ray, points = np.array([0]), np.eye(3)[:1], np.ones((2, 3))

    def block(frames=one, rays=ray, keys=world.keys, points_world=points):
        LandmarkBlock(keys, points_world, [BearingTerm(frames, one, rays, SIGMA_RAD)])

    block()
    for message, given in {
        "of length one": {"rays": 2 * ray},
        "integers": {"frames": np.array([0.5])},
        "once": {"keys": [X(0), X(0)]},
        r"\(J, 3\), not \(3, 2\)": {"points_world": points.T},
    }.items():
        with pytest.raises(ValueError, match=message):
            block(**given)
    noise = gtsam.noiseModel.Unit.Create(2)
    for bad in (2 * ray[0], np.full(3, np.nan), ray):
        with pytest.raises(ValueError, match="of length one"):
            BearingFactor(X(0), L(0), bad, noise)
    for face in (-1, 4):
        with pytest.raises(ValueError, match="out of range"):
            ReprojectionFactor(X(0), L(0), np.zeros(2), face, CAMERAS, noise)
    for focals in (np.zeros(4), np.full(4, np.nan), np.ones(3)):
        with pytest.raises(ValueError, match="focal lengths"):
            FaceCameras(CAMERAS.rig_R_faces, focals, CAMERAS.principals)


def test_factors_keep_their_measurement(world):
    """The caller's array may be filled anew for the next factor."""
    values, noise = gtsam.Values(world.values), gtsam.noiseModel.Unit.Create(2)
    values.insert(L(0), world.truth[0].transformFrom(np.array([0.2, 0.1, 3.0])))
    ray, pixel = np.array([0.0, 0.0, 1.0]), np.array([250.0, 260.0])
    factors = [
        BearingFactor(X(0), L(0), ray, noise),
        ReprojectionFactor(X(0), L(0), pixel, 0, CAMERAS, noise),
    ]
    before = [factor.error(values) for factor in factors]
    ray[:], pixel[:] = [0.0, 1.0, 0.0], 0.0
    assert [factor.error(values) for factor in factors] == before


def test_landmarks_are_eliminated_in_runs_of_any_length(world, monkeypatch):
    whole = world.block().linearize(world.values)
    monkeypatch.setattr(landmarks, "_MAX_VISITS_AT_ONCE", 7)
    block = world.block()
    assert len(block._visits) > 20
    parts = block.linearize(world.values)
    for name in ("diagonal", "off_diagonal", "gradient"):
        assert np.allclose(getattr(parts, name), getattr(whole, name), rtol=1e-10, atol=1e-6)
    assert parts.costs == pytest.approx(whole.costs, rel=1e-12)


def test_steps_by_iterations_are_those_of_a_factorization(world):
    def system() -> DirectSystem:
        out = DirectSystem(SystemLayout(world.graph, [world.block()], world.values))
        out.linearize(world.values)
        return out

    direct, iterated = system(), system()
    assert direct._max_iterations == 0  # eight frames are solved faster than that
    iterated._max_iterations = 100
    assert iterated.solve(1.0) is not None  # factorizes, which is far off as a preconditioner
    before = iterated._cholesky._fronts[0].lower.copy()
    exact, steps = direct.solve(1e-4), iterated.solve(1e-4)
    np.testing.assert_array_equal(iterated._cholesky._fronts[0].lower, before)  # not renewed
    assert 0 < np.abs(steps - exact).max() < 0.1 * np.abs(exact).max()
    # an inexact step gains less, hardly so, and says it itself
    assert 0.999 < iterated.predicted_decrease() / direct.predicted_decrease() < 1
    iterated._max_iterations = 1  # that is not enough: a factorization of this very system
    np.testing.assert_array_equal(iterated.solve(1e-4), exact)


def test_weak_modes_settle_beside_a_large_cost_that_stays() -> None:
    """A long chain that its last pose bends, and two claims whose contradiction costs far more."""
    num, rigid = 200, gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def at(x: float, y: float = 0.0) -> gtsam.Pose3:
        return gtsam.Pose3(gtsam.Rot3(), np.array([x, y, 0]))

    for f in range(num):
        values.insert(X(f), at(f))
        if f:
            graph.add(gtsam.BetweenFactorPose3(X(f - 1), X(f), at(1), rigid))
    for claim in (at(0), at(3)):  # 2.25e6 remain, whatever X(0) is
        graph.add(gtsam.PriorFactorPose3(X(0), claim, rigid))
    aside = gtsam.noiseModel.Isotropic.Sigma(6, 0.5)
    graph.add(gtsam.PriorFactorPose3(X(num - 1), at(num - 1, 3), aside))
    result = optimize(graph, values, options=SolverOptions())
    best = optimize(graph, result.values, options=TIGHT)
    assert result.converged and result.cost - best.cost < 0.05
