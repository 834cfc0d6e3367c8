"""The solution carried back into the world and scale of the trajectory."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from scipy.spatial.transform import Rotation
from synthetic import World, make_world, unit

from gsba.bundle.reconstruction import assemble
from gsba.camera.cameras import Cameras
from gsba.camera.lens import Lenses
from gsba.geometry import angular_errors, inverse, pose
from gsba.store.finished import cameras_of_map
from gsba.types import (
    CoarsePoses,
    Counts,
    JointErrors,
    Landmarks,
    PoseSource,
    PoseStatus,
    Reconstruction,
    Solution,
)
from gsba.types.records import with_rows

SCALE = 0.25
SLAM_R_WORLD = Rotation.from_rotvec([0.4, -1.0, 2.0]).as_matrix()
SLAM_SHIFT = np.array([10.0, -3.0, 5.0])


@pytest.fixture(scope="module")
def world() -> World:
    return make_world(0, num_frames=10, num_points=120, false_share=0)


def _in_slam(world_T_rigs: np.ndarray) -> np.ndarray:
    return pose(SLAM_R_WORLD @ world_T_rigs[:, :3, :3], _points_in_slam(world_T_rigs[:, :3, 3]))


def _points_in_slam(points: np.ndarray) -> np.ndarray:
    return SCALE * points @ SLAM_R_WORLD.T + SLAM_SHIFT


def _adjustment(world: World, noise: float = 1.7) -> Solution:
    counts = Counts(world.tracks.num_points, world.tracks.num_points, "tracks")
    landmarks = Landmarks(world.points_world, world.tracks, counts)
    return Solution(world.world_T_rigs, landmarks, noise, ())


def _assemble(
    world: World,
    coarse: np.ndarray | None = None,
    sources: np.ndarray | None = None,
    covariances: np.ndarray | None = None,
    joint: JointErrors | None = None,
    false_steps: np.ndarray | None = None,
) -> Reconstruction:
    num = len(world.world_T_rigs)
    poses = CoarsePoses(
        _in_slam(world.world_T_rigs) if coarse is None else coarse,
        np.full(num, PoseSource.SLAM, np.uint8) if sources is None else sources,
        0.0,
    )
    covariances = np.zeros((num, 6, 6)) if covariances is None else covariances
    given = _adjustment(world), covariances, world.keypoints, poses, 12
    return assemble(*given, joint_errors=joint, false_steps=false_steps)


def test_the_result_sits_in_the_slam_world_and_scale(world: World) -> None:
    found = _assemble(world)
    np.testing.assert_allclose(found.world_T_rigs, _in_slam(world.world_T_rigs), atol=1e-12)
    np.testing.assert_allclose(found.points_world, _points_in_slam(world.points_world), atol=1e-12)


def test_observations_still_point_at_their_points(world: World) -> None:
    found = _assemble(world)
    rig_T_world = inverse(found.world_T_rigs)[found.observation_frames]
    points = found.points_world[found.observation_points]
    local = unit(np.einsum("oij,oj->oi", rig_T_world[:, :3, :3], points) + rig_T_world[:, :3, 3])
    angles = np.linalg.norm(np.cross(local, found.observation_bearings), axis=1)
    assert angles.max() < 5 * 5e-4  # the noise of the world, nothing more
    errors = np.bincount(found.observation_points, angles) / np.bincount(found.observation_points)
    np.testing.assert_allclose(found.point_errors, errors, rtol=1e-6)
    np.testing.assert_allclose(found.observation_sigmas, 1.7 * 5e-4)


def test_covariances_scale_with_the_map(world: World) -> None:
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(10, 6, 6))
    covariances = roots @ np.swapaxes(roots, 1, 2)
    draws = rng.normal(size=(7, 10, 6)).astype(np.float32)
    joint = JointErrors(covariances[:-1], draws)
    result = _assemble(world, covariances=covariances, joint=joint)
    found, joint = result.pose_covariances, result.joint_errors
    np.testing.assert_allclose(found[:, :3, :3], covariances[:, :3, :3])  # rig axes: no turning
    np.testing.assert_allclose(found[:, :3, 3:], SCALE * covariances[:, :3, 3:])
    np.testing.assert_allclose(found[:, 3:, 3:], SCALE**2 * covariances[:, 3:, 3:])
    np.testing.assert_allclose(joint.neighbours, found[:-1])
    np.testing.assert_allclose(joint.draws, draws * ([1.0] * 3 + [SCALE] * 3), rtol=1e-6)


def test_interpolated_poses_have_no_say(world: World) -> None:
    coarse = _in_slam(world.world_T_rigs)
    coarse[4, :3, 3] += 5
    sources = np.full(10, PoseSource.SLAM, np.uint8)
    sources[4] = PoseSource.INTERPOLATED
    found = _assemble(world, coarse, sources)
    np.testing.assert_allclose(found.world_T_rigs, _in_slam(world.world_T_rigs), atol=1e-12)


def _without_frame(world: World, frame: int, left: int) -> World:
    """The world with all but `left` observations of a frame gone."""
    rows = np.flatnonzero(world.tracks.frames == frame)[left:]
    keep = np.ones(len(world.tracks), bool)
    keep[rows] = False
    return replace(world, tracks=with_rows(world.tracks, keep))


def test_unrefined_frames_are_told_and_have_no_say(world: World) -> None:
    fewer = _without_frame(_without_frame(world, 4, 11), 6, 12)
    coarse = _in_slam(world.world_T_rigs)
    coarse[4, :3, 3] += 5
    found = _assemble(fewer, coarse)
    expected = np.full(10, PoseStatus.REFINED)
    expected[4] = PoseStatus.UNREFINED
    np.testing.assert_array_equal(found.pose_statuses, expected)
    np.testing.assert_allclose(found.world_T_rigs, _in_slam(world.world_T_rigs), atol=1e-12)


def test_colours_are_the_means_of_their_observations(world: World) -> None:
    colors = np.random.default_rng(1).integers(0, 256, world.keypoints.colors.shape, np.uint8)
    painted = replace(world, keypoints=replace(world.keypoints, colors=colors))
    found = _assemble(painted)
    seen = colors[world.keypoints.rows(world.tracks)].astype(float)
    for j in (0, 50, world.tracks.num_points - 1):
        mean = seen[world.tracks.points == j].mean(axis=0)
        np.testing.assert_allclose(found.point_colors[j], mean, atol=0.5)


def test_an_inverted_world_is_refused(world: World) -> None:
    """One pose of the trajectory and guesses that go the other way ask for a negative scale."""
    coarse = _in_slam(world.world_T_rigs)
    coarse[:, :3, 3] = 2 * coarse[0, :3, 3] - coarse[:, :3, 3]
    sources = np.full(10, PoseSource.EXTRAPOLATED, np.uint8)
    sources[0] = PoseSource.SLAM
    refused(r"10 frames that could place the result .* --fps", _assemble, world, coarse, sources)
    coarse[:, :3, 3] = coarse[0, :3, 3]
    refused("no positive scale", _assemble, world, coarse)


def test_the_longest_true_stretch_places_a_map_whose_trajectory_went_on_elsewhere(
    world: World,
) -> None:
    """Tracking was lost behind frame 5 and went on in a world of its own, where all goes back."""
    coarse, false_steps = _in_slam(world.world_T_rigs), np.zeros(9, bool)
    coarse[6:, :3, 3] = coarse[6, :3, 3] - 20 * (coarse[6:, :3, 3] - coarse[6, :3, 3])
    refused("10 frames that could place", _assemble, world, coarse, false_steps=false_steps)
    false_steps[5] = True
    found = _assemble(world, coarse, false_steps=false_steps)
    np.testing.assert_allclose(found.world_T_rigs, _in_slam(world.world_T_rigs), atol=1e-12)
    false_steps[:] = True  # one frame correlates with anything
    refused("10 frames that could place", _assemble, world, coarse, false_steps=false_steps)


def test_residuals_that_cannot_be_right_are_refused(world: World) -> None:
    behind = replace(world, points_world=2 * world.world_T_rigs[0, :3, 3] - world.points_world)
    solved = _adjustment(behind)
    tracks, points = solved.landmarks.tracks, solved.landmarks.points_world
    bearings = behind.keypoints.bearings_rig[behind.keypoints.rows(tracks)]
    poses = solved.world_T_rigs[tracks.frames]
    median = np.degrees(np.median(angular_errors(poses, points[tracks.points], bearings)))
    refused(rf"fell apart \(median residual {median:.1f} deg\)", _assemble, behind)


def test_a_small_map_that_fits_no_trajectory_stays_as_it_was_solved(world: World) -> None:
    coarse = _in_slam(world.world_T_rigs)
    coarse[7:, :3, 3] *= -1
    poses = CoarsePoses(coarse, np.full(10, PoseSource.SLAM, np.uint8), 0.0)
    groups = np.repeat([0, 1], [7, 3]).astype(np.int32)
    found = assemble(
        _adjustment(world), np.zeros((10, 6, 6)), world.keypoints, poses, 12, components=groups
    )
    np.testing.assert_array_equal(found.world_T_rigs[7:], world.world_T_rigs[7:])


def test_each_map_has_its_own_unit(world: World) -> None:
    """A second map that the trajectory has three times as large as the solution, beside the first:
    what is as long in both, like the distance of two lenses, is in the unit of either."""
    coarse = _in_slam(world.world_T_rigs)
    coarse[6:, :3, 3] *= 3
    poses = CoarsePoses(coarse, np.full(10, PoseSource.SLAM, np.uint8), 0.0)
    groups = np.repeat([0, 1], [6, 4]).astype(np.int32)
    given = _adjustment(world), np.zeros((10, 6, 6)), world.keypoints, poses, 12
    whole = assemble(*given, components=groups)
    assert whole.map_scales is not None
    np.testing.assert_allclose(whole.map_scales, [1, 3], rtol=1e-9)
    whole = replace(whole, lens_baseline=(0.25, 0.01), vertical=np.array([0.0, 1, 0]))
    largest, other = whole.of_map(1), whole.of_map(2)
    assert whole.num_maps == 2 and whole.map_numbers().tolist() == [1] * 6 + [2] * 4
    assert largest.lens_baseline == (0.25, 0.01) and largest.vertical is whole.vertical
    assert other.lens_baseline == pytest.approx((0.75, 0.03)) and other.vertical is None
    np.testing.assert_array_equal(other.world_T_rigs, whole.world_T_rigs[6:])
    for part in (largest, other):
        assert part.components is None and part.map_scales is None and part.num_maps == 1
    lenses = Lenses(np.array([0.0, 0, 0.125]), readout_motion=np.arange(60.0).reshape(10, 6))
    of_other = cameras_of_map(Cameras((lenses,)), whole, 2).only
    assert 2 * of_other.centre[2] == pytest.approx(other.lens_baseline[0])
    np.testing.assert_allclose(of_other.readout_motion[:, :3], lenses.readout_motion[6:, :3])
    np.testing.assert_allclose(of_other.readout_motion[:, 3:], 3 * lenses.readout_motion[6:, 3:])


def test_a_map_of_other_cameras_alone_has_no_unit_by_the_lenses(world: World) -> None:
    """Nothing ties its unit to that of the map with two lenses, so that these give no scale."""
    groups = np.repeat([0, 1], [6, 4]).astype(np.int32)
    coarse = CoarsePoses(_in_slam(world.world_T_rigs), np.zeros(10, np.uint8), 0.0)
    given = _adjustment(world), np.zeros((10, 6, 6)), world.keypoints, coarse, 12
    whole = assemble(*given, components=groups)
    for two_lenses in (0, 1):
        origins = np.zeros((len(whole.observation_frames), 3))
        origins[groups[whole.observation_frames] == two_lenses, 2] = 0.1
        both = replace(whole, lens_baseline=(0.25, 0.01), observation_origins=origins)
        assert both.of_map(2 - two_lenses).lens_baseline is None
        assert both.of_map(1 + two_lenses).lens_baseline is not None


def test_a_frame_alone_is_no_map(world: World) -> None:
    coarse = CoarsePoses(_in_slam(world.world_T_rigs), np.zeros(10, np.uint8), 0.0)
    groups = np.array([0, 0, 0, 0, 0, 1, 1, 1, 3, 2], np.int32)
    given = _adjustment(world), np.zeros((10, 6, 6)), world.keypoints, coarse, 12
    found = assemble(*given, components=groups)
    assert found.num_maps == 2
    assert found.map_numbers().tolist() == [1, 1, 1, 1, 1, 2, 2, 2, 0, 0]
    assert found.frames_of_map(2).tolist() == [5, 6, 7]
