"""Parts of the tracker alone: the atlas, flow, turns, the window, and a place by descriptors."""

import numpy as np
import pytest
from dense_walk import WIDTH, RenderedWalk, turn
from one_gallery import gallery
from scipy.spatial.transform import Rotation

from gsba.camera.rig import owner_faces
from gsba.camera.sphere import erp_directions
from gsba.demo.raycast import ranges
from gsba.geometry import angles_between, inverse, pose, rotation_angle, unit
from gsba.odometry.atlas import AtlasLayout, Cutter, follow, new_corners
from gsba.odometry.derotation import miniature, turned
from gsba.odometry.relocalisation import describe, placed
from gsba.odometry.window import WindowObservations, adjust_window

LAYOUT = AtlasLayout.of(WIDTH)


def _turn(degrees: float, axis: tuple[float, float, float]) -> np.ndarray:
    return Rotation.from_rotvec(np.deg2rad(degrees) * unit(np.array(axis))).as_matrix()


def test_pixels_of_an_atlas_and_bearings_are_each_others_inverse() -> None:
    bearings = unit(np.random.default_rng(0).normal(size=(500, 3)))
    faces = owner_faces(bearings).astype(np.int64)
    pixels = LAYOUT.pixels(bearings, faces)
    assert LAYOUT.inside(pixels, faces, 5.0).all()
    np.testing.assert_allclose(LAYOUT.bearings(pixels, faces), bearings, atol=1e-12)


def test_an_atlas_shows_what_the_panorama_does() -> None:
    rays = erp_directions(WIDTH)
    direction = unit(np.array([0.2, -0.3, -0.9]))  # near the seam
    grey = np.clip(128 + 100 * rays @ direction, 0, 255).astype(np.uint8)
    world_R_rig = _turn(70, (0.3, 1.0, 0.2))
    atlas = Cutter(LAYOUT).cut(grey, world_R_rig)
    expected = 128 + 100 * LAYOUT.directions @ (world_R_rig @ direction)
    assert np.abs(atlas.image - expected).max() < 2.0


def test_features_are_followed_over_a_turn_across_seam_and_poles(walk: RenderedWalk) -> None:
    rig_R_turned = _turn(5, (1.0, 1.0, 0.3))
    one = Cutter(LAYOUT).cut(walk.frames[0], np.eye(3))
    other = Cutter(LAYOUT).cut(turn(walk.frames[0], rig_R_turned), np.eye(3))
    corners = new_corners(LAYOUT, one, None, np.zeros((0, 3)))
    assert len(corners) > 300
    expected = corners @ rig_R_turned
    start = unit(expected + np.deg2rad(2.0) * np.roll(expected, 1, axis=1))
    found, good = follow(LAYOUT, one, other, corners, start)
    assert good.mean() > 0.8
    assert np.rad2deg(np.median(angles_between(found, expected)[good])) < 0.1


def test_corners_keep_clear_of_known_features_and_masks(walk: RenderedWalk) -> None:
    atlas = Cutter(LAYOUT).cut(walk.frames[0], np.eye(3))
    known = new_corners(LAYOUT, atlas, None, np.zeros((0, 3)))
    usable = LAYOUT.directions[..., 0] > 0.1
    fresh = new_corners(LAYOUT, atlas, usable, known)
    assert (fresh[:, 0] > 0.09).all()
    assert len(fresh) < 0.3 * len(known)


@pytest.mark.parametrize("degrees", [20.0, 90.0, 175.0])
def test_a_turn_of_any_angle_is_found_from_whole_panoramas(
    walk: RenderedWalk, degrees: float
) -> None:
    rig_R_turned = _turn(degrees, (0.05, 1.0, -0.03))
    found = turned(
        miniature(walk.frames[0]), miniature(turn(walk.frames[0], rig_R_turned)), [np.eye(3)]
    )
    assert np.rad2deg(rotation_angle(found.T @ rig_R_turned)) < 0.5


def test_a_window_is_adjusted_to_its_true_poses_and_scale() -> None:
    rng = np.random.default_rng(0)
    points = 3 * unit(rng.normal(size=(200, 3)))
    steps = 0.2 * np.arange(6)[:, None] * np.array([[1.0, 0.2, 0.1]])
    truth = np.stack([pose(_turn(3.0 * k, (0, 1, 0.2)), step) for k, step in enumerate(steps)])
    ids = 7 * np.arange(len(points))
    frames = [(ids, unit((points - t[:3, 3]) @ t[:3, :3])) for t in truth]
    frames[5][1][:10] = unit(rng.normal(size=(10, 3)))  # false
    start = truth.copy()
    start[2:, :3, 3] += rng.normal(size=(4, 3)) * 0.01
    sigma = np.deg2rad(0.1)
    solved = adjust_window(start, 2, WindowObservations.of(frames), sigma)
    off = inverse(truth) @ solved.world_T_rigs
    assert np.abs(off[:, :3, 3]).max() < 1e-3
    assert len(solved.ids) >= 198  # of 200: a point straight ahead has no parallax
    np.testing.assert_allclose(solved.points_world, points[solved.ids // 7], atol=1e-2)
    false = {(5, 7 * n) for n in range(10)}
    assert {tuple(row) for row in solved.outliers.tolist()} == false


def test_a_frame_is_placed_by_descriptors_in_the_unit_of_the_map(walk: RenderedWalk) -> None:
    cutter = Cutter(LAYOUT)
    one, other = (cutter.cut(walk.frames[n], np.eye(3)) for n in (0, 6))
    key, frame = describe(LAYOUT, one, None), describe(LAYOUT, other, None)
    true_T = inverse(walk.world_T_rigs[0]) @ walk.world_T_rigs[6]
    world = key.bearings_rig @ walk.world_T_rigs[0][:3, :3].T
    distances = ranges(gallery(), walk.world_T_rigs[0][:3, 3], world)
    found = placed(key, frame, key.bearings_rig, distances, seed=0)
    assert np.rad2deg(rotation_angle(found[:3, :3].T @ true_T[:3, :3])) < 0.5
    assert np.linalg.norm(found[:3, 3] - true_T[:3, 3]) < 0.1 * np.linalg.norm(true_T[:3, 3])


def test_unrelated_pictures_place_nothing(walk: RenderedWalk) -> None:
    cutter = Cutter(LAYOUT)
    noise = np.random.default_rng(0).integers(0, 255, walk.frames[0].shape).astype(np.uint8)
    key, frame = (describe(LAYOUT, cutter.cut(g, np.eye(3)), None) for g in (walk.frames[0], noise))
    distances = np.ones(len(key.bearings_rig))
    assert placed(key, frame, key.bearings_rig, distances, seed=0) is None
