"""The camera as variables of the graph: their covariances beside the poses'."""

from dataclasses import replace
from unittest.mock import MagicMock

import gtsam
import numpy as np
import pytest
from lens_world import motion, placed, problem_of, seen_through, solved_with, times
from synthetic import GivenFactors, loop_walk

from factors import PoseSystem
from factors.bearing import bearing_residuals
from factors.block import QuadraticBlock
from factors.direct_system import reduced_system
from gsba import Family, MapSnapshot, X
from gsba.bundle import adjustment
from gsba.bundle.adjustment import values_of
from gsba.bundle.camera_adjustment import CameraSystem, CameraView, solve_with_camera
from gsba.bundle.camera_adjustment import _settled as _settle_camera
from gsba.bundle.camera_variables import CameraUnknowns
from gsba.bundle.families import Bearings, Families
from gsba.bundle.readout import CameraEstimate, CameraEstimates
from gsba.bundle.trajectory_prior import GyroTurns
from gsba.camera.cameras import Cameras
from gsba.camera.lens import Lenses
from gsba.config import CameraSettings
from gsba.similarity import pose_similarity
from gsba.types import GyroConstraints, Round, Solution

CENTRE, BAND, READOUT_S = np.array([0.004, -0.003, 0.05]), np.deg2rad(4), 0.03
SWEEPS = np.array([[-1.0, 0, 0], [0, 1.0, 0]])
MOTION = motion(loop_walk(24), READOUT_S)
LENSES = Lenses(CENTRE, 0.2, BAND, SWEEPS, MOTION)


def _settled(
    camera: Lenses,
    known: CameraEstimate,
    seed: int = 0,
    said: CameraSettings | None = None,
    turning: GyroConstraints | None = None,
):
    world, shown = seen_through(camera, seed)
    solved = Solution.without_points(world.world_T_rigs)
    problem = problem_of(world, said)
    if turning is not None:  # its rates alone: steps are not measured
        own = (*problem.families.members, GyroTurns(turning, 1.0, 2.0))
        problem = replace(problem, families=Families(own))
    solved, known = solved_with(world, shown, known, solved, problem)
    return world, known, (solved, shown, CameraEstimates((known,)), times(24), problem)


def test_all_of_a_camera_is_found_from_a_start_that_is_off() -> None:
    start = replace(
        LENSES, centre=0.8 * CENTRE, inverse_stitch_radius=0.1, readout_motion=0.7 * MOTION
    )
    world, found, given = _settled(LENSES, CameraEstimate(start, 0.7 * READOUT_S))
    scale = pose_similarity(given[0].world_T_rigs, world.world_T_rigs).scale
    np.testing.assert_allclose(scale * found.lenses.centre, CENTRE, atol=0.001)
    assert found.lenses.inverse_stitch_radius / scale == pytest.approx(0.2, abs=0.03)
    assert found.readout_s == pytest.approx(READOUT_S, rel=0.05)


@pytest.mark.parametrize("start", [0.5, 2.0])
def test_a_tight_gate_does_not_confirm_the_start(start: float) -> None:
    """It leaves out what contradicts the start, which is what tells the distance of the lenses."""
    world, shown = seen_through(LENSES)
    solved = Solution.without_points(world.world_T_rigs)
    seen = CameraEstimates((CameraEstimate(LENSES, READOUT_S),)).cameras
    tracks, found = seen.clear(world.tracks, seen.seen(shown)), []
    for ratio in (1.0, start):
        known = CameraEstimate(replace(LENSES, centre=ratio * CENTRE), READOUT_S)
        given = times(24), solved, problem_of(world)
        found.append(
            solve_with_camera(tracks, shown, CameraEstimates((known,)), *given, (6.0, 3.0))[1]
        )
    centres = [one.each[0].lenses.centre for one in found]
    np.testing.assert_allclose(*centres, atol=1e-5)  # a standard deviation is 7e-5


def test_a_stitch_radius_that_is_said_goes_with_the_lenses() -> None:
    """Both pictures meet 5 m away, the lenses are as far apart as they are said to be."""
    front = float(np.linalg.norm(CENTRE))
    said = CameraSettings(baseline_mm=2e3 * front, stitch_radius_m=1 / LENSES.inverse_stitch_radius)
    start = replace(
        LENSES, centre=0.8 * CENTRE, inverse_stitch_radius=LENSES.inverse_stitch_radius / 0.8
    )
    world, found, given = _settled(LENSES, CameraEstimate(start, READOUT_S), said=said)
    scale = pose_similarity(given[0].world_T_rigs, world.world_T_rigs).scale
    length = float(np.linalg.norm(found.lenses.centre))
    assert found.lenses.inverse_stitch_radius * length == pytest.approx(
        LENSES.inverse_stitch_radius * front
    )
    np.testing.assert_allclose(scale * found.lenses.centre, CENTRE, atol=0.001)
    covariances = CameraSystem(*given).covariances()
    (measured,) = covariances.cameras
    assert np.isnan(measured.inverse_stitch_radius_sigma) and np.isfinite(measured.readout_sigma)
    grown = covariances.grown(4.0)
    np.testing.assert_allclose(grown.poses, 4 * covariances.poses)
    np.testing.assert_allclose(grown.cameras[0].centre, 4 * measured.centre)
    assert grown.cameras[0].readout_sigma == pytest.approx(2 * measured.readout_sigma)


def _turning(readout_motion: np.ndarray, known: np.ndarray) -> GyroConstraints:
    """A gyro's rates of frames that turn by readout_motion, where they are known (F,)."""
    rates = np.where(known[:, None], readout_motion[:, :3] / READOUT_S, np.nan)
    return GyroConstraints(np.zeros((23, 3)), np.full(23, np.inf), rates, np.deg2rad(0.1))


def test_frames_turn_while_they_are_read_as_a_gyro_says() -> None:
    """Nobody else knows that as well; frames that the gyro does not know are found as before."""
    known = np.arange(24) % 6 > 0
    still = replace(LENSES, readout_motion=MOTION * np.repeat([0.0, 1.0], 3))
    start, off = CameraEstimate(still, 0.8 * READOUT_S), {}
    for gyro in (None, _turning(MOTION, known)):
        _, found, _ = _settled(LENSES, start, turning=gyro)
        assert found.by_gyro is (None if gyro is None else True)
        assert found.readout_s == pytest.approx(READOUT_S, rel=0.05)
        off[gyro is None] = np.abs(found.lenses.readout_motion - MOTION)[:, :3]
    assert np.median(off[False][known]) < 0.2 * np.median(off[True][known])
    assert np.median(off[False][~known]) < 1.2 * np.median(off[True][~known])


def test_a_gyro_that_images_contradict_is_not_followed() -> None:
    """As if it were of another time: by as much, but otherwise."""
    still = replace(LENSES, readout_motion=MOTION * np.repeat([0.0, 1.0], 3))
    readout_motion = []
    for gyro in (None, _turning(MOTION[::-1], np.ones(24, bool))):
        _, found, _ = _settled(LENSES, CameraEstimate(still, READOUT_S), turning=gyro)
        assert not found.by_gyro
        readout_motion.append(found.lenses.readout_motion)
    np.testing.assert_array_equal(*readout_motion)


def test_covariances_are_those_of_errors_and_wider_than_of_a_known_camera() -> None:
    errors = []
    for seed in range(4):
        world, _, given = _settled(LENSES, CameraEstimate(LENSES, READOUT_S), seed)
        whole, camera = CameraSystem(*given).covariances(), given[2].each[0]
        (measured,) = whole.cameras
        scale = pose_similarity(given[0].world_T_rigs, world.world_T_rigs).scale
        off = scale * camera.lenses.centre - CENTRE
        errors.append(off / (scale * np.sqrt(np.diagonal(measured.centre))))
        errors.append([(camera.readout_s - READOUT_S) / measured.readout_sigma])
    spread = float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))
    assert 0.5 < spread < 2.0  # of 16
    seen = given[2].cameras.seen(given[1])
    alone, _ = adjustment.pose_covariances(given[0], seen, given[4])
    ratio = np.trace(whole.poses[1:], axis1=1, axis2=2) / np.trace(alone[1:], axis1=1, axis2=2)
    assert (ratio > 1).all()


def test_frames_own_motion_does_not_shrink_a_map_of_no_known_scale() -> None:
    """It is drawn to none, and less of it is left in a smaller map."""
    world, shown = seen_through(LENSES)
    gauge, tight = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    gauge.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(world.world_T_rigs[0]), tight))
    problem, start = problem_of(world), Solution.without_points(world.world_T_rigs)
    problem = replace(problem, families=Families((Bearings(), GivenFactors(gauge))))
    given = CameraEstimate(LENSES, READOUT_S), start, problem
    solved, found = solved_with(world, shown, *given)
    scale = pose_similarity(solved.world_T_rigs, world.world_T_rigs).scale
    assert scale == pytest.approx(1, abs=0.01)
    assert found.readout_s == pytest.approx(READOUT_S, rel=0.05)


class Duration(Family):
    """A variable under the letter that the readout's duration has, tied to a pose."""

    name, digest = "duration", "1"

    def variables(self, snapshot: MapSnapshot) -> gtsam.Values:
        values = gtsam.Values()
        values.insert(gtsam.symbol("D", 0), np.zeros(1))
        return values

    def graph(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
        graph, unit = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Unit.Create(1)
        graph.add(gtsam.PriorFactorVector(gtsam.symbol("D", 0), np.array([3.0]), unit))
        return graph


def test_variables_of_families_are_solved_beside_the_camera() -> None:
    world, shown = seen_through(LENSES)
    names = tuple(str(f) for f in range(24))
    problem = replace(
        problem_of(world), families=Families((Bearings(), Duration()), names, times(24))
    )
    start = Solution.without_points(world.world_T_rigs)
    solved, found = solved_with(world, shown, CameraEstimate(LENSES, READOUT_S), start, problem)
    assert solved.variables is not None and solved.variables.data == pytest.approx([3.0])
    assert found.readout_s == pytest.approx(READOUT_S, rel=0.05)
    measured = CameraSystem(
        solved, shown, CameraEstimates((found,)), times(24), problem
    ).covariances()
    assert np.isfinite(measured.cameras[0].readout_sigma)


def test_a_quadratic_block_is_what_it_was_made_of() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(18, 18))
    hessian, gradient = root.T @ root, rng.normal(size=18)
    keys, values = [3, 1, 2], gtsam.Values()
    for key in keys:
        values.insert(key, np.zeros(6))
    tiles, pairs = hessian.reshape(3, 6, 3, 6).swapaxes(1, 2), np.array([[1, 2], [0, 2], [0, 1]])
    own = tiles[np.arange(3), np.arange(3)]
    model = PoseSystem(own, tiles[tuple(pairs.T)], gradient.reshape(3, 6), {"quadratic": 2.0})
    block = QuadraticBlock(keys, pairs, model)
    system = reduced_system(gtsam.NonlinearFactorGraph(), [block], values)
    assert system.linearize(values) == {"quadratic": 2.0}
    steps = system.solve(0.0)
    expected = -np.linalg.solve(hessian, gradient)
    np.testing.assert_allclose(steps.ravel(), expected)
    least = 2.0 + 0.5 * gradient @ expected
    assert block.propose(values, steps) == pytest.approx(least)
    found = system.covariances(0, rng)
    np.testing.assert_allclose(found[0][1], np.linalg.inv(hessian)[6:12, 6:12])


def test_two_cameras_and_one_centre_are_solved_for_in_one_graph() -> None:
    """Frames of three cameras take turns: two pairs of lenses, one read row by row, and one centre.

    What is found of each is that of the others' frames beside it: landmarks are seen by all.
    """
    of_frame = tuple((np.arange(24) % 3).tolist())
    other = Lenses(np.array([-0.003, 0.002, 0.03]), band_rad=BAND)
    true = Cameras((LENSES, other, Lenses()), of_frame)
    world, shown = seen_through(true)
    start = CameraEstimates(
        (
            CameraEstimate(replace(LENSES, centre=0.8 * CENTRE), READOUT_S),
            CameraEstimate(replace(other, centre=1.3 * other.centre)),
            CameraEstimate(Lenses()),
        ),
        of_frame,
    )
    problem, poses = problem_of(world), Solution.without_points(world.world_T_rigs)
    seen = start.cameras.seen(shown)
    tracks = start.cameras.clear(world.tracks, seen)
    given = tracks, shown, start, times(24), poses, problem
    solved, found = solve_with_camera(*given, (30.0, 8.0, 8.0))
    scale = pose_similarity(solved.world_T_rigs, world.world_T_rigs).scale
    first, second, plain = found.each
    np.testing.assert_allclose(scale * first.lenses.centre, CENTRE, atol=0.0015)
    np.testing.assert_allclose(scale * second.lenses.centre, other.centre, atol=0.0015)
    assert first.readout_s == pytest.approx(READOUT_S, rel=0.1)
    assert second.lenses.readout_motion is None and plain.lenses == start.each[2].lenses
    sigmas = CameraSystem(solved, shown, found, times(24), problem).covariances().cameras
    assert [len(one.centre) for one in sigmas] == [3, 3, 0]
    assert np.isfinite(sigmas[0].readout_sigma) and np.isnan(sigmas[1].readout_sigma)


def test_a_camera_s_unknowns_do_not_act_on_what_others_see() -> None:
    of_frame = tuple((np.arange(24) % 2).tolist())
    cameras = CameraEstimates(
        (CameraEstimate(LENSES, READOUT_S), CameraEstimate(Lenses())), of_frame
    )
    world, shown = seen_through(cameras.cameras)
    problem, poses = problem_of(world), world.world_T_rigs
    unknowns = CameraUnknowns.of(cameras, poses, times(24), problem)
    keypoints = cameras.cameras.seen(shown)
    solved = Solution.without_points(poses)
    around = placed(solved, keypoints, cameras.cameras.clear(world.tracks, keypoints))
    values = values_of(poses)
    values.insert(unknowns.values)
    block = unknowns.block(around, shown, 1.0)
    residuals, _, by_frame, by_shared = block.jacobians(values)
    plain = np.array(of_frame)[block._sightings.frames] == 1
    assert plain.any() and not by_shared[plain].any() and not by_frame[plain][:, :, 6:].any()
    assert by_shared[~plain].any(axis=(0, 1)).all()
    # Rays of the plain camera are those of the block of known rays.
    tracks = around.tracks
    rows = keypoints.rows(tracks)
    known, by_pose, _ = bearing_residuals(
        poses[tracks.frames], around.points_world[tracks.points], keypoints.bearings_rig[rows], None
    )
    order = np.lexsort((tracks.frames, tracks.points))
    whitened = known[order] / keypoints.sigmas_rad[rows][order, None]
    np.testing.assert_allclose(residuals[plain], whitened[plain], atol=1e-6)
    turned = by_pose[order] / keypoints.sigmas_rad[rows][order, None, None]
    np.testing.assert_allclose(
        by_frame[plain][:, :, :6], turned[plain], atol=1e-6 * np.abs(turned).max()
    )


def test_a_camera_is_settled_once_few_observations_enter_or_leave() -> None:
    """Two at a gate's edge may take turns for ever."""
    counts = [(40_000, 39_900), (39_900, 39_905), (39_905, 39_907), (39_907, 39_905)]
    start, gates = Solution.without_points(np.stack([np.eye(4)])), []

    def adjusted(view: CameraView, _: Solution, some: tuple[float]) -> tuple[Solution, CameraView]:
        observations, support = counts[len(gates)] if some == (6.0,) else (30_000, 30_000)
        gates.extend(some)
        done = Round(some[0], 1.0, observations, 9_000, support, True, (), "")
        return replace(start, rounds=(done,)), view

    _settle_camera(start, MagicMock(), (6.0, 3.0), adjusted)
    assert gates == [6.0, 6.0, 6.0, 3.0]
