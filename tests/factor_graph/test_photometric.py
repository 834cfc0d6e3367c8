"""Photometric family: Jacobians, block against reference factors, recovery of exact worlds."""

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from photometric_world import BallWorld, CodedImage, make_ball_world, planes_from, table_of
from synthetic import unit

from factors import RobustLoss, block_factor, jacobian_errors
from factors.patch_windows import PatchPixels, PatchTable, PatchViews, patch_axes
from factors.photometric import _MIN_THREAD_OBSERVATIONS, FAMILY, PhotometricBlock
from factors.photometric_factor import PhotometricFactor
from factors.sphere_image import SphereImage
from factors.threads import balanced_ranges
from gsba.bundle.optimizer import SolverOptions, optimize

SIGMA = 2.0
LOSS = RobustLoss("cauchy", 2.0)
TIGHT = SolverOptions(relative_tolerance=1e-10, max_iterations=100)
PLANE = 1000  # first key of a plane
STEP = 1e-6  # of differences: the spline has kinks in its third derivative


@cache
def small_world(seed: int, num_frames: int, num_patches: int, spread: float = 0.3) -> BallWorld:
    """A world that several tests read and none changes."""
    return make_ball_world(seed, num_frames, num_patches, spread=spread)


def block_of(world: BallWorld, loss: RobustLoss = LOSS, **options) -> PhotometricBlock:
    block = PhotometricBlock(range(len(world.world_T_rigs)), world.pixels, SIGMA, loss, **options)
    block.refresh(world.values())
    return block


def reference(world: BallWorld, patch: int, o: int, loss: RobustLoss, **options):
    """The same observation as a factor of its own."""
    table, size = world.pixels.table, len(world.pixels.table.grid)
    scaled = replace(loss, scale=loss.scale * np.sqrt(size))
    noise = scaled.noise_model(gtsam.noiseModel.Isotropic.Sigma(size, SIGMA))
    return PhotometricFactor(
        int(table.hosts[patch]), int(table.targets[o]), PLANE + patch,
        patch_axes(table.bearings_rig[patch : patch + 1])[0], table.grid,
        world.pixels.templates[patch].astype(float), CodedImage(world.images[table.targets[o]]),
        noise,
        **views_of(table, patch, o),
        **options,
    )  # fmt: skip


def views_of(table: PatchTable, patch: int, o: int) -> dict[str, np.ndarray]:
    if table.views is None:
        return {}
    hosts, targets = table.views.rig_T_hosts, table.views.rig_T_targets
    return {"rig_T_host": hosts[patch], "rig_T_target": targets[o]}


def through_lenses(world: BallWorld, seed: int = 0) -> BallWorld:
    """The same images, of rigs whose cameras each patch sees from beside the middle and turned."""
    rng, table = np.random.default_rng(seed), world.pixels.table

    def views(num: int) -> np.ndarray:
        steps = rng.normal(size=(num, 6)) * np.repeat([0.02, 0.05], 3)
        return np.array([gtsam.Pose3.Expmap(step).matrix() for step in steps])

    seen = PatchViews(views(len(table)), views(len(table.targets)))
    return world.of(replace(table, views=seen), margin=30.0)


def reference_graph(world: BallWorld, loss: RobustLoss) -> gtsam.NonlinearFactorGraph:
    table, graph = world.pixels.table, gtsam.NonlinearFactorGraph()
    for patch in range(len(table)):
        sigmas = gtsam.noiseModel.Diagonal.Sigmas(table.plane_sigmas[patch])
        graph.add(gtsam.PriorFactorPoint3(PLANE + patch, table.planes[patch], sigmas))
        for o in range(table.offsets[patch], table.offsets[patch + 1]):
            graph.add(reference(world, patch, o, loss))
    return graph


def moved(world: BallWorld, seed: int, rotation: float, translation: float) -> np.ndarray:
    """The poses but for the first, shifted at random."""
    rng = np.random.default_rng(seed)
    out = world.world_T_rigs.copy()
    for f in range(1, len(out)):
        step = np.r_[rotation * rng.normal(size=3), translation * rng.normal(size=3)]
        out[f] = gtsam.Pose3(out[f]).retract(step).matrix()
    return out


def held(world: BallWorld) -> gtsam.NonlinearFactorGraph:
    """The first pose where it is, and the second one's position: the gauge."""
    graph = gtsam.NonlinearFactorGraph()
    for f, sigmas in ((0, [1e-6] * 6), (1, [1.0] * 3 + [1e-6] * 3)):
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.array(sigmas))
        graph.add(gtsam.PriorFactorPose3(f, gtsam.Pose3(world.world_T_rigs[f]), noise))
    return graph


def pose_errors(world: BallWorld, values: gtsam.Values) -> tuple[float, float]:
    """Largest rotation (radians) and position error (units)."""
    errors = [
        gtsam.Pose3.Logmap(gtsam.Pose3(truth).between(values.atPose3(f)))
        for f, truth in enumerate(world.world_T_rigs)
    ]
    array = np.array(errors)
    return float(np.abs(array[:, :3]).max()), float(np.abs(array[:, 3:]).max())


@pytest.mark.parametrize(
    "bearing",
    [(0, 0, 1), (0, 0.01, -1), (0.02, 1, 0.03), (0.01, -1, 0), (0.6, 0.5, -0.6)],
    ids=["centre", "seam", "below", "above", "anywhere"],
)
@pytest.mark.parametrize("spread", [0.3, 1e-4], ids=["parallax", "no parallax"])
def test_jacobians(bearing: tuple[float, ...], spread: float) -> None:
    world = small_world(1, 2, 1, spread)
    table = table_of(
        world.world_T_rigs, np.array([0]), unit(np.array([bearing], dtype=float)), 512, 9
    )
    world = world.of(table)
    values = world.values()
    values.insert(PLANE, table.planes[0] * [1.02, 1.0, 1.0])
    factor = reference(world, 0, 0, RobustLoss())
    assert max(jacobian_errors(factor, values, STEP).values()) < 1e-5
    depth = gtsam.Values(world.values())
    depth.insert(PLANE, float(table.planes[0, 0]))
    slopes = table.planes[0, 1:] / table.planes[0, 0]
    factor = reference(world, 0, 0, RobustLoss(), slopes=slopes)
    assert max(jacobian_errors(factor, depth, STEP).values()) < 1e-5


def test_jacobians_through_lenses() -> None:
    world = through_lenses(make_ball_world(1, 2, 8))
    values, table = world.values(), world.pixels.table
    for patch in range(len(table)):
        values.insert(PLANE + patch, table.planes[patch])
        factor = reference(world, patch, int(table.offsets[patch]), RobustLoss())
        assert max(jacobian_errors(factor, values, STEP).values()) < 1e-5


@pytest.mark.parametrize("lenses", [False, True])
def test_block_costs_what_the_reference_factors_do(lenses: bool) -> None:
    world = small_world(2, 3, 8)
    world = through_lenses(world) if lenses else world
    block = block_of(world)
    assert block.counted.all() and not any(block.dropped.values())
    values = world.values(moved(world, 0, 3e-3, 0.01))
    apart = gtsam.Values(values)
    for patch, plane in enumerate(block.planes):
        apart.insert(PLANE + patch, plane)
    expected = reference_graph(world, LOSS).error(apart)
    assert block.costs(values)[FAMILY] == pytest.approx(expected, rel=1e-5)  # float32 templates
    assert block.linearize(values).costs[FAMILY] == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("lenses", [False, True])
def test_gradient_is_that_of_the_eliminated_cost(lenses: bool) -> None:
    world = small_world(3, 3, 12)
    world = through_lenses(world) if lenses else world
    block = block_of(world, RobustLoss())
    poses = moved(world, 1, 1e-3, 4e-3)
    block.polish(world.values(poses), 100)
    system = block.linearize(world.values(poses))
    planes = block.planes.copy()
    for f in range(3):
        for k in range(6):
            costs = []
            for sign in (1, -1):
                there = poses.copy()
                there[f] = gtsam.Pose3(poses[f]).retract(sign * 1e-6 * np.eye(6)[k]).matrix()
                block.planes = planes.copy()
                costs.append(block.polish(world.values(there), 100))
            numerical = (costs[0] - costs[1]) / 2e-6
            assert system.gradient[f, k] == pytest.approx(
                numerical, abs=2e-4 * np.abs(system.gradient).max()
            )


def test_block_its_factor_and_stock_gtsam_end_at_one_optimum() -> None:
    world = make_ball_world(4, 3, 40)
    start = moved(world, 2, 2e-3, 0.008)
    prior = held(world)
    fast = optimize(prior, world.values(start), [block_of(world)], TIGHT)

    grouped = gtsam.NonlinearFactorGraph(prior)
    grouped.add(block_factor(block_of(world)))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-10)
    slow = gtsam.LevenbergMarquardtOptimizer(grouped, world.values(start), params)
    slow_values = slow.optimize()

    apart = gtsam.NonlinearFactorGraph(prior)
    apart.push_back(reference_graph(world, LOSS))
    values = world.values(start)
    for patch, plane in enumerate(world.pixels.table.planes):
        values.insert(PLANE + patch, plane)
    plain = gtsam.LevenbergMarquardtOptimizer(apart, values, params)
    plain_values = plain.optimize()

    assert fast.cost == pytest.approx(slow.error(), rel=1e-4)
    assert fast.cost == pytest.approx(plain.error(), rel=1e-4)
    for f in range(3):
        pose = fast.values.atPose3(f)
        assert pose.equals(slow_values.atPose3(f), 1e-5)
        assert pose.equals(plain_values.atPose3(f), 1e-5)


def test_exact_world_is_recovered() -> None:
    world = make_ball_world(6, 4, 150)
    start = moved(world, 4, 4e-3, 0.02)  # a third of a pixel in rotation, 0.4 in parallax
    assert pose_errors(world, world.values(start))[1] > 0.02
    result = optimize(held(world), world.values(start), [block_of(world)], TIGHT)
    rotation, position = pose_errors(world, result.values)
    # patches are flat, the ball is not: 0.01 px of a 512 px panorama are 1.2e-4 rad
    assert rotation < 1.5e-4 and position < 1e-3


def test_gain_and_offset_change_nothing() -> None:
    plain = make_ball_world(7, 3, 60)
    toned = make_ball_world(
        7, 3, 60, gains=np.array([1.0, 0.8, 1.2]), offsets=np.array([0, 12.0, -15.0])
    )
    start = moved(plain, 5, 2e-3, 0.01)
    results = [
        optimize(held(world), world.values(start), [block_of(world)], TIGHT)
        for world in (plain, toned)
    ]
    for f in range(3):
        first, second = (result.values.atPose3(f) for result in results)
        # clipping aside (none here), only the fixed point of the coefficients differs
        assert first.equals(second, 5e-5)


def test_threads_change_nothing() -> None:
    world = make_ball_world(8, 3, 200)
    assert len(balanced_ranges(world.pixels.table.offsets, _MIN_THREAD_OBSERVATIONS)) > 2
    one, two = (block_of(world, num_threads=n).linearize(world.values()) for n in (1, 2))
    assert np.array_equal(one.diagonal, two.diagonal)
    assert np.array_equal(one.off_diagonal, two.off_diagonal)


def test_planes_of_normals() -> None:
    rng = np.random.default_rng(9)
    bearings, normals = unit(rng.normal(size=(2, 20, 3)))
    distances = rng.uniform(1, 5, 20)
    planes = planes_from(bearings, distances, normals)
    axes, xy = patch_axes(bearings), 0.1 * rng.normal(size=(20, 2))
    rays = axes[:, 0] + xy[:, :1] * axes[:, 1] + xy[:, 1:] * axes[:, 2]
    points = rays / (planes[:, :1] + np.einsum("pk,pk->p", planes[:, 1:], xy)[:, None])
    off = np.einsum("pi,pi->p", normals, points - distances[:, None] * bearings)
    assert np.abs(off / np.linalg.norm(points, axis=1)).max() < 1e-9


def test_textureless_and_saturated_frames_stay_finite() -> None:
    world = make_ball_world(10, 4, 60)
    blank = {1: np.zeros((256, 512)), 2: np.full((256, 512), 255.0)}
    world = world.of(world.pixels.table, blank)
    block = block_of(world)
    system = block.linearize(world.values())
    for array in (system.diagonal, system.off_diagonal, system.gradient):
        assert np.isfinite(array).all()
    assert block.dropped["no contrast"] > 0
    result = optimize(held(world), world.values(moved(world, 6, 1e-3, 3e-3)), [block])
    assert np.isfinite(result.cost) and np.isfinite(block.planes).all()


def test_what_cannot_be_seen_is_left_out_and_counted() -> None:
    world = make_ball_world(11, 3, 80)
    poses = world.world_T_rigs.copy()
    poses[1, :3, 3] = [0, 0, 9]  # outside the ball: sees it from behind
    poses[2, :3, :3] = poses[2, :3, :3] @ gtsam.Rot3.Ry(1.0).matrix()  # beyond its windows
    block = block_of(world)
    block.refresh(world.values(poses))
    assert block.dropped["grazing"] > 0 and block.dropped["outside its window"] > 0
    system = block.linearize(world.values(poses))
    assert np.isfinite(system.diagonal).all() and np.isfinite(system.gradient).all()


def test_no_step_takes_a_plane_behind_its_host() -> None:
    world = make_ball_world(12, 2, 30)
    block = block_of(world)
    block.linearize(world.values())
    steps = np.zeros((2, 6))
    steps[1, 3:] = 30.0  # absurdly far
    assert np.isfinite(block.propose(world.values(), steps))
    block.accept()
    assert (block.planes[:, 0] > 0).all()


def test_a_frame_can_be_weighted_down() -> None:
    world = make_ball_world(13, 4, 80)
    turned = {3: np.roll(world.grey[3], 2, axis=1)}  # by two pixels
    block = block_of(world.of(world.pixels.table, turned))
    full = block.linearize(world.values()).diagonal[3].copy()
    block.weigh(np.array([1, 1, 1, 0.01]))
    block.refresh(world.values())
    left = block.linearize(world.values()).diagonal[3]
    # not by 100 exactly: priors on the planes keep their weight
    assert 0.005 < np.trace(left) / np.trace(full) < 0.03


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"hosts": np.array([5])}, "out of range"),
        ({"targets": np.array([0])}, "its host"),
        ({"planes": np.array([[-1.0, 0, 0]])}, "positive"),
        ({"planes": np.array([[np.nan, 0, 0]])}, "finite"),
        ({"bearings_rig": np.array([[0.0, 0, 2]])}, "length one"),
        ({"offsets": np.array([0, 2])}, "offsets end"),
        ({"plane_sigmas": np.zeros((1, 3))}, "positive"),
        ({"planes": np.zeros((2, 3))}, "must be"),
    ],
)
def test_wrong_tables_are_refused(change: dict, message: str) -> None:
    world = small_world(14, 2, 1)
    table = replace(world.pixels.table, hosts=np.array([0]), targets=np.array([1]))
    with pytest.raises(ValueError, match=message):
        PatchPixels(replace(table, **change), world.world_T_rigs, 512)


def test_wrong_sigmas_and_weights_are_refused() -> None:
    world = make_ball_world(15, 2, 4)
    with pytest.raises(ValueError, match="sigmas"):
        PhotometricBlock(range(2), world.pixels, 0.0)
    with pytest.raises(ValueError, match="weights"):
        PhotometricBlock(range(2), world.pixels, 1.0, weights=np.full(4, -1.0))
    with pytest.raises(ValueError, match="expected"):
        world.pixels.take(0, SphereImage.of(np.zeros((64, 128))))
    with pytest.raises(RuntimeError, match="linearize"):
        PhotometricBlock(range(2), world.pixels, 1.0).propose(world.values(), np.zeros((2, 6)))


def test_no_patches_are_no_cost() -> None:
    world = make_ball_world(16, 2, 1)
    table = world.pixels.table
    empty = replace(
        table, hosts=table.hosts[:0], bearings_rig=table.bearings_rig[:0],
        planes=table.planes[:0], plane_sigmas=table.plane_sigmas[:0],
        offsets=np.zeros(1, np.int64), targets=table.targets[:0],
    )  # fmt: skip
    block = PhotometricBlock(range(2), PatchPixels(empty, world.world_T_rigs, 512), 1.0)
    block.refresh(world.values())
    assert block.linearize(world.values()).costs == {FAMILY: 0.0}
    assert block.propose(world.values(), np.zeros((2, 6))) == 0.0
