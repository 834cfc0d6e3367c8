"""Scene points from bearings: exact, robust, and the least-squares ones."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from synthetic import bearings_of, loop_walk, unit, with_noise

from gsba.bundle import triangulation
from gsba.types import Landmarks, Tracks

SIGMA = 5e-4


def _all_see_all(num_frames: int, num_points: int) -> Tracks:
    points, frames = np.divmod(np.arange(num_frames * num_points, dtype=np.int32), num_frames)
    return Tracks(points, frames, points.copy(), num_points)


def _observe(points_world: np.ndarray, world_T_rigs: np.ndarray) -> np.ndarray:
    """Bearings (J F, 3) in the order of `_all_see_all`."""
    seen = np.stack([bearings_of(points_world, world_T_rig) for world_T_rig in world_T_rigs])
    return seen.swapaxes(0, 1).reshape(-1, 3)


def _run(bearings: np.ndarray, world_T_rigs: np.ndarray, gate: float = 8.0) -> Landmarks:
    tracks = _all_see_all(len(world_T_rigs), len(bearings) // len(world_T_rigs))
    sigmas = np.full(len(bearings), SIGMA)
    return triangulation.triangulate(tracks, bearings, sigmas, world_T_rigs, gate)


def _points(num: int, rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(1, 12, (num, 1)) * unit(rng.normal(size=(num, 3)))


@pytest.mark.parametrize("num_frames", [2, 3, 7])
def test_exact_bearings_give_exact_points(num_frames: int) -> None:
    rng = np.random.default_rng(num_frames)
    world_T_rigs, points = loop_walk(num_frames, 1.0), _points(40, rng)
    found = _run(_observe(points, world_T_rigs), world_T_rigs)
    kept = found.counts.kept
    assert kept == found.tracks.num_points == len(found.points_world) >= 38  # few lie on the axis
    offsets = np.linalg.norm(points[:, None] - found.points_world, axis=2).min(axis=0)
    assert offsets.max() < 1e-7
    assert len(found.tracks) == kept * num_frames


def test_a_false_observation_is_found_out() -> None:
    rng = np.random.default_rng(1)
    world_T_rigs, points = loop_walk(6, 1.0), _points(50, rng)
    bearings = with_noise(_observe(points, world_T_rigs), SIGMA, rng)
    false = np.arange(50) * 6 + rng.integers(0, 6, 50)
    turned = Rotation.from_rotvec(0.2 * unit(np.cross(bearings[false], rng.normal(size=(50, 3)))))
    bearings[false] = turned.apply(bearings[false])
    found = _run(bearings, world_T_rigs)
    assert found.counts.kept == 50
    kept = set(zip(found.tracks.points, found.tracks.frames, strict=True))
    assert not kept & set(zip(np.arange(50), false % 6, strict=True))
    assert len(found.tracks) >= 50 * 5 - 1  # 8 sigmas leave no true one out, but for a fluke
    errors = np.linalg.norm(found.points_world - points, axis=1)
    # Depth error of rays that meet at angle a over distance d: d SIGMA / sin(a); a >= ~ 1 / 12.
    assert np.median(errors / np.linalg.norm(points, axis=1) ** 2) < 3 * SIGMA


def test_two_observations_that_disagree_make_no_point() -> None:
    world_T_rigs = loop_walk(2, 1.0)
    bearings = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])  # skew rays
    found = _run(bearings, world_T_rigs)
    assert found.counts.kept == 0
    assert found.counts.dropped["observations disagree"] == 1
    assert len(found.tracks) == 0 and found.points_world.shape == (0, 3)


@pytest.mark.parametrize(("distance", "kept"), [(30.0, 1), (70.0, 0)])
def test_points_need_parallax(distance: float, kept: int) -> None:
    """Half a unit apart: 0.95 degrees at 30 units, 0.41 at 70."""
    world_T_rigs = np.stack([np.eye(4)] * 2)
    world_T_rigs[1, 0, 3] = 0.5
    point = np.array([[0.2, 0.1, distance]])
    found = _run(_observe(point, world_T_rigs), world_T_rigs)
    assert found.counts.kept == kept
    assert found.counts.dropped["parallax too small"] == 1 - kept


@pytest.mark.parametrize(("distance", "kept"), [(0.1, 1), (0.03, 0)])
def test_a_point_within_the_camera_is_none(distance: float, kept: int) -> None:
    """So far before the front lens of the first frame, which is 0.05 before the middle."""
    world_T_rigs, lens = np.stack([np.eye(4)] * 2), np.array([0, 0, 0.05])
    world_T_rigs[1, 0, 3] = -0.1
    lenses_T = world_T_rigs.copy()
    lenses_T[:, :3, 3] += lens
    bearings = _observe(lens + np.array([[0, 0, distance]]), lenses_T)
    found = triangulation.triangulate(
        _all_see_all(2, 1), bearings, np.full(2, SIGMA), world_T_rigs, 8.0, 1,
        np.stack([lens] * 2),
    )  # fmt: skip
    assert found.counts.kept == kept and found.counts.dropped["too near"] == 1 - kept


def test_a_standing_camera_makes_no_points() -> None:
    rng = np.random.default_rng(2)
    world_T_rigs = np.stack([np.eye(4)] * 5)
    bearings = with_noise(_observe(_points(30, rng), world_T_rigs), SIGMA, rng)
    assert _run(bearings, world_T_rigs).counts.kept == 0


def test_noise_of_a_camera_that_stands_for_a_while_makes_no_points() -> None:
    """Positions off by noise meet rays off by noise close to the camera, at any angle."""
    rng = np.random.default_rng(7)
    world_T_rigs, points = loop_walk(9, 1.0), _points(300, rng)
    world_T_rigs[3:] = world_T_rigs[3]
    world_T_rigs[3:, :3, 3] += rng.normal(0, 1e-6, (6, 3))
    noisy = with_noise(_observe(points, world_T_rigs), 20 * SIGMA, rng).reshape(300, 9, 3)
    names = np.repeat(np.arange(300, dtype=np.int32), 2)
    tracks = Tracks(names, np.tile(np.int32([3, 4]), 300), names.copy(), 300)
    given = noisy[:, 3:5].reshape(-1, 3), np.full(600, 20 * SIGMA)
    standing = triangulation.standing_within(_all_see_all(9, 1), world_T_rigs)
    found = triangulation.triangulate(tracks, *given, world_T_rigs, 8.0, standing=standing)
    assert found.counts.kept == 0 and found.counts.dropped["too near"] > 50


def test_the_way_between_maps_laid_side_by_side_is_no_step() -> None:
    """Every third frame is in no map, and lies a hundred times as far away as the walk is long."""
    world_T_rigs, points = loop_walk(9, 1.0), _points(40, np.random.default_rng(7))
    mapped = np.flatnonzero(np.arange(9) % 3 < 2)
    bearings = _observe(points, world_T_rigs[mapped])
    world_T_rigs[2::3, 0, 3] += 100
    seen = _all_see_all(len(mapped), 40)
    tracks = replace(seen, frames=mapped[seen.frames].astype(np.int32))
    sigmas = np.full(len(tracks), SIGMA)
    found = triangulation.triangulate(tracks, bearings, sigmas, world_T_rigs, 8.0)
    assert found.counts.kept == 40


def test_points_behind_are_refused() -> None:
    """Reversed bearings meet in the very same point, behind every frame."""
    rng = np.random.default_rng(3)
    world_T_rigs, points = loop_walk(5, 1.0), _points(30, rng)
    assert _run(_observe(points, world_T_rigs), world_T_rigs).counts.kept == 30
    assert _run(-_observe(points, world_T_rigs), world_T_rigs).counts.kept == 0


def test_tracks_can_be_required_to_be_long(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(4)
    world_T_rigs, points = loop_walk(3, 1.0), _points(30, rng)
    bearings = _observe(points, world_T_rigs)
    bearings[::3] *= -1  # frame 0 sees nothing right
    longest = _run(bearings, world_T_rigs)
    assert longest.counts.kept >= 25 and len(longest.tracks) == 2 * longest.counts.kept
    monkeypatch.setattr(triangulation, "_MIN_TRACK_LENGTH", 3)
    none = _run(bearings, world_T_rigs)
    assert none.counts.kept == 0


def test_points_are_the_least_squares_ones() -> None:
    rng = np.random.default_rng(5)
    world_T_rigs, points = loop_walk(6, 1.0), _points(25, rng)
    bearings = with_noise(_observe(points, world_T_rigs), SIGMA, rng)
    tracks = _all_see_all(6, 25)
    sigmas = SIGMA * rng.uniform(0.5, 2, len(bearings))
    found = triangulation.triangulate(tracks, bearings, sigmas, world_T_rigs, 50.0)
    assert len(found.tracks) == len(tracks)  # no gate at work: the plain problem
    rays = np.einsum("fij,pfj->pfi", world_T_rigs[:, :3, :3], bearings.reshape(25, 6, 3))
    for j, (point, ray) in enumerate(zip(found.points_world, rays, strict=True)):
        sigma = sigmas.reshape(25, 6)[j]

        def residuals(x: np.ndarray, ray: np.ndarray = ray, sigma: np.ndarray = sigma):
            directions = unit(x - world_T_rigs[:, :3, 3])
            return (np.cross(ray, directions) / sigma[:, None]).ravel()

        best = least_squares(residuals, points[j], xtol=1e-15, ftol=1e-15, gtol=1e-15)
        # Squares above the least ones are the squared distance in standard deviations; weights
        # by distance held fixed in each step shift a point by 0.03 of one.
        assert np.sum(residuals(point) ** 2) - 2 * best.cost < 0.05**2


def test_no_tracks_make_no_points() -> None:
    nothing = np.zeros(0, np.int32)
    found = triangulation.triangulate(
        Tracks(nothing, nothing, nothing, 0), np.zeros((0, 3)), np.zeros(0), loop_walk(3), 8.0
    )
    assert found.points_world.shape == (0, 3) and found.counts.received == 0
