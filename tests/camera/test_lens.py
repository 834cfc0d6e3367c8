"""Two lenses, read row by row: where rays start, and where points are shown."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import RIG, unit

from gsba.camera.cameras import Cameras
from gsba.camera.lens import Lenses
from gsba.camera.rig import owner_faces
from gsba.types import Keypoints, Tracks

RNG = np.random.default_rng(0)
SWEEPS = np.array([[1.0, 0, 0], [0, -1.0, 0]])
FRAMES = RNG.integers(0, 5, 400)
TWISTS = RNG.normal(0, 1, (5, 6)) * np.repeat([0.004, 0.03], 3)
AXES = Rotation.from_rotvec(RNG.normal(size=(5, 3))).as_matrix()
TWO = Lenses(np.array([0.001, -0.002, 0.04]), band_rad=np.deg2rad(4))
LENSES = {
    "two centres": TWO,
    "read row by row": replace(TWO, row_directions=SWEEPS, readout_motion=TWISTS),
    "turned below the panorama": replace(
        TWO, row_directions=SWEEPS, readout_motion=TWISTS, axes=AXES
    ),
    "stitched for a radius": replace(TWO, inverse_stitch_radius=0.3),
    "all of it": Lenses(TWO.centre, 0.3, TWO.band_rad, SWEEPS, TWISTS, AXES),
}


def _away_from_the_seam(lenses: Lenses, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) of which no near one comes to lie on its other side, and their frames (N,)."""
    rng, wide = np.random.default_rng(seed), replace(lenses, band_rad=np.deg2rad(15))
    points = rng.uniform(0.5, 8, (400, 1)) * unit(rng.normal(size=(400, 3)))
    clear = ~wide.blended(points, FRAMES)
    return points[clear], FRAMES[clear]


@pytest.mark.parametrize("lenses", LENSES.values(), ids=LENSES)
def test_a_point_lies_on_the_ray_of_where_it_is_shown(lenses: Lenses) -> None:
    points, frames = _away_from_the_seam(lenses, 2)
    shown = unit(lenses.seeing(points, frames))
    directions, origins = lenses.rays(shown, frames)
    along = np.einsum("ni,ni->n", points - origins, directions)
    off = points - origins - along[:, None] * directions
    np.testing.assert_allclose(off, 0, atol=1e-6)  # a row's time is settled in four passes
    assert (along > 0).all()


@pytest.mark.parametrize("lenses", LENSES.values(), ids=LENSES)
def test_a_view_has_things_where_the_picture_shows_them(lenses: Lenses) -> None:
    points, frames = _away_from_the_seam(lenses, 1)
    shown = unit(lenses.seeing(points, frames))
    view_T_rigs = np.linalg.inv(lenses.views(shown, frames))
    aside = points * (1 + 5e-4 * np.random.default_rng(3).normal(size=points.shape))
    for where, tolerance in ((points, 1e-6), (aside, 3e-5)):  # rows differ, and magnification
        seen = (view_T_rigs[:, :3, :3] @ where[:, :, None])[:, :, 0] + view_T_rigs[:, :3, 3]
        expected = unit(lenses.seeing(where, frames))
        np.testing.assert_allclose(unit(seen), expected, atol=tolerance)


def test_rows_of_a_lens_are_read_from_edge_to_edge() -> None:
    lenses, one = Lenses(np.array([0, 0, 0.1]), row_directions=SWEEPS), np.zeros(3, int)
    edge = np.deg2rad(89.999)
    rim = np.array([[np.sin(edge), 0, np.cos(edge)], [-np.sin(edge), 0, np.cos(edge)]])
    np.testing.assert_allclose(
        lenses.fractions(rim, one[:2]), [0.45, -0.45], atol=1e-4
    )  # of 200 degrees
    back = np.array([[0, -np.sin(edge), -np.cos(edge)], [0, 0, -1.0], [0, 0, 1.0]])
    np.testing.assert_allclose(lenses.fractions(back, one), [0.45, 0, 0], atol=1e-4)
    assert not Lenses().fractions(rim, one[:2]).any()


def test_each_lens_sees_from_its_side_and_neither_at_the_seam() -> None:
    lenses, angle = TWO, np.deg2rad([86.1, 85.9, 94.1, 93.9])
    directions = np.column_stack([np.sin(angle), 0 * angle, np.cos(angle)])
    frames = np.zeros(4, int)
    assert lenses.blended(directions, frames).tolist() == [True, False, False, True]
    _, origins = lenses.rays(directions, frames)
    np.testing.assert_allclose(origins, np.outer([1, 1, -1, -1], lenses.centre))


def test_axes_turn_the_lenses_of_their_frame() -> None:
    rng = np.random.default_rng(0)
    turned, frames = replace(TWO, axes=AXES), np.repeat([2, 4], 50)
    directions = unit(rng.normal(size=(100, 3)))
    own = np.einsum("nji,nj->ni", AXES[frames], directions)
    expected = np.einsum("nij,nj->ni", AXES[frames], TWO.origins(own, frames))
    np.testing.assert_allclose(turned.origins(directions, frames), expected)
    alone = turned.of_frame(4)
    at = frames == 4
    zero = np.zeros(np.count_nonzero(at), int)
    np.testing.assert_allclose(alone.origins(directions[at], zero), expected[at])


def test_a_stitcher_is_right_at_its_radius() -> None:
    """What is as far from the rig's centre as panoramas are stitched for shows no parallax."""
    rng = np.random.default_rng(0)
    radius = 3.0
    lenses, frames = replace(TWO, inverse_stitch_radius=1 / radius), np.zeros(50, int)
    directions = unit(rng.normal(size=(50, 3)))
    shown = unit(lenses.seeing(radius * directions, frames))
    clear = ~lenses.blended(directions, frames)
    np.testing.assert_allclose(shown[clear], directions[clear], atol=1e-12)


def test_jacobians_by_the_centre_are_numerical_ones() -> None:
    rng = np.random.default_rng(0)
    lenses, frames = replace(TWO, axes=AXES), rng.integers(0, 5, 40)
    directions = unit(rng.normal(size=(40, 3)))
    found = lenses.by_centre(np.tile(np.eye(3), (40, 1, 1)), directions, frames)
    for k, step in enumerate(1e-3 * np.eye(3)):
        moved = replace(lenses, centre=lenses.centre + step).origins(directions, frames)
        numeric = (moved - lenses.origins(directions, frames)) / 1e-3
        np.testing.assert_allclose(found[:, :, k], numeric, atol=1e-9)


def _keypoints(bearings: np.ndarray) -> Keypoints:
    faces, num = owner_faces(bearings), len(bearings)
    grey = np.full((num, 3), 128, np.uint8)
    starts = np.array([0, num // 2, num])
    return Keypoints(starts, RIG.project(bearings, faces), faces, bearings, np.ones(num), grey)


def test_one_centre_changes_nothing() -> None:
    rng = np.random.default_rng(0)
    keypoints = _keypoints(unit(rng.normal(size=(10, 3))))
    tracks = Tracks(np.arange(10), np.repeat([0, 1], 5), np.tile(np.arange(5), 2), 10)
    assert not Lenses() and not Cameras() and Cameras().seen(keypoints) is keypoints
    assert Cameras().clear(tracks, keypoints) is tracks


def test_tracks_lose_what_is_blended() -> None:
    bearings = unit(np.column_stack([np.ones(10), np.zeros(10), np.linspace(-0.5, 0.5, 10)]))
    keypoints, cameras = _keypoints(bearings), Cameras((TWO,))
    tracks = Tracks(np.arange(10), np.repeat([0, 1], 5), np.tile(np.arange(5), 2), 10)
    kept = cameras.clear(tracks, keypoints)
    assert kept.num_points == 8 and kept.points.tolist() == list(range(8))
    assert kept.frames.tolist() == [0, 0, 0, 0, 1, 1, 1, 1]
    assert kept.keypoints.tolist() == [0, 1, 2, 3, 1, 2, 3, 4]
    seen = cameras.seen(keypoints)
    np.testing.assert_allclose(seen.origins_rig[:, 2], np.repeat([-0.04, 0.04], 5))
