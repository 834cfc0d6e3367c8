"""Maps of a tour, joined across a step that no three frames confirm."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsba.geometry import inverse, pose, unit
from gsba.odometry import tour_joins, tour_merging
from gsba.odometry.tour_joins import (
    MIN_LEAD,
    MIN_SCORE,
    Join,
    Places,
    TourMap,
    is_sure,
    join,
    scaled,
)
from gsba.odometry.tour_merging import all_joined, held
from gsba.odometry.tour_steps import agreed_logs, pose_errors_deg
from gsba.types.records import with_rows
from tests.room_tour import frames, still, true_poses, true_step


@pytest.fixture(autouse=True)
def _two_hypotheses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the step from the second still to the third a rough pose and a wrong one."""
    true = inverse(true_poses()[2]) @ true_poses()[1]
    found = [
        pose(
            Rotation.from_euler("y", turn, degrees=True).as_matrix() @ true[:3, :3],
            unit(true[:3, 3]),
        )
        for turn in (1.5, 90.0)
    ]
    ranked = [(1.0, one) for one in found]
    monkeypatch.setattr(tour_joins, "rough_poses", lambda one, other: ranked)


@dataclass(frozen=True)
class RowOfMaps:
    """Three maps of three frames each, in units of their own, and joins of them that are known."""

    poses: np.ndarray  # (9, 4, 4) f_T_world
    scores: dict[tuple[int, int], float] = field(default_factory=dict)  # by the frames that meet

    def true(self, f: int, g: int, unit_length: float) -> np.ndarray:
        """Pose g_T_f (4, 4) in units of a length."""
        return scaled(self.poses[g] @ inverse(self.poses[f]), 1 / unit_length)

    def unit_of(self, some: TourMap) -> float:
        """Length of a map's unit."""
        f = some.first
        step = np.linalg.norm(self.true(f, f + 1, 1.0)[:3, 3])
        return float(step / np.linalg.norm(some.between(f, f + 1)[:3, 3]))

    def join(self, frames: object, one: TourMap, other: TourMap) -> tuple[Join | None, float]:
        """The true join, with a place one unit of length away in either map."""
        score = self.scores.get((one.last, other.first))
        units = self.unit_of(one), self.unit_of(other)
        if score is None:
            return None, 0.0
        ends = (one.last, other.first), (other.first, one.last)
        none, true = np.zeros((1, 3)), self.true(one.last, other.first, units[0])
        places = [
            Places(f, g, np.zeros(1, int), none, np.array([1 / unit]), none, np.ones(1, bool))
            for (f, g), unit in zip(ends, units, strict=True)
        ]
        return Join(true, float(np.log(units[1] / units[0])), score, places), 0.0

    def maps(self) -> list[TourMap]:
        """The maps, of units 1, 2 and 0.5."""
        return [
            TourMap(
                first,
                np.array([self.true(first, first + n, size) for n in range(3)]),
                [np.zeros(0)] * 3,
            )
            for first, size in ((0, 1.0), (3, 2.0), (6, 0.5))
        ]


def true_map(room: int, first: int) -> TourMap:
    """The map of two stills, whose step has length 1."""
    step = true_step(first, room)
    return TourMap(first, np.stack([np.eye(4), step.f1_T_f0]), [step.depths0, step.depths1])


def test_maps_of_one_room_are_joined_in_pose_and_scale() -> None:
    some, poses = frames(), true_poses()
    ((one, other, best),) = all_joined(some, [true_map(0, 0), true_map(0, 2)], 1)
    assert one.last == 1 and other.first == 2
    true = inverse(poses[2]) @ poses[1]
    assert max(pose_errors_deg(best.g_T_f, true)) < 0.5
    lengths = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert np.linalg.norm(best.g_T_f[:3, 3]) == pytest.approx(lengths[1] / lengths[0], rel=0.01)
    assert np.exp(best.log_scale) == pytest.approx(lengths[2] / lengths[0], rel=0.01)
    pairs = held(some, one, other, best)
    assert [pair for pair, *_ in pairs] == [(0, 2), (0, 3), (1, 2), (1, 3)]
    for (f, g), f_T_g, found_g, found_f in pairs:
        assert max(pose_errors_deg(f_T_g, inverse(poses[f]) @ poses[g])) < 0.5
        assert len(found_g) == len(some[f].keys) and len(found_f) == len(some[g].keys)


def test_all_places_of_two_searches_between_the_same_frames_hold_a_join() -> None:
    """A search further inside of a map finds places between frames next to the join, too."""
    some, (one, other) = frames(), (true_map(0, 0), true_map(0, 2))
    best, _ = join(some, one, other)
    assert best is not None
    halves = [
        with_rows(each, np.arange(n, len(each.rows), 2)) for n in (0, 1) for each in best.places
    ]
    twice = held(some, one, other, replace(best, places=halves))
    for once, again in zip(held(some, one, other, best), twice, strict=True):
        np.testing.assert_array_equal(once[2], again[2])
        np.testing.assert_array_equal(once[3], again[3])


def test_single_frames_join_the_map_beside_them() -> None:
    some, poses = frames(), true_poses()
    alone = [TourMap(f, np.eye(4)[None], [np.full(len(some[f].keys), np.nan)]) for f in range(4)]
    lengths = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    for one, other, unit_length in (
        (true_map(0, 0), alone[2], lengths[0]),
        (alone[1], true_map(0, 2), lengths[2]),
    ):
        best, rival = join(some, one, other)
        assert best is not None and is_sure(best, rival) and best.log_scale == 0
        found = np.linalg.norm(best.g_T_f[:3, 3])
        assert found == pytest.approx(lengths[1] / unit_length, rel=0.01)
    assert all_joined(some, alone, 1) == []


def test_maps_of_different_rooms_are_not_joined() -> None:
    some = [*frames()[:2], still(2, room=1), still(3, room=1)]
    assert not is_sure(*join(some, true_map(0, 0), true_map(1, 2)))


def test_a_join_that_another_rivals_is_not_sure() -> None:
    at = Join(np.eye(4), 0.0, 2 * MIN_SCORE, [])
    assert is_sure(at, 0.0) and not is_sure(at, 2.1 * MIN_SCORE / MIN_LEAD)
    assert not is_sure(Join(np.eye(4), 0.0, 0.9 * MIN_SCORE, []), 0.0)
    assert not is_sure(None, 0.0)


def test_lengths_are_proposed_by_keys_that_agree() -> None:
    logs = np.array([0.0, 0.02, -0.03, 0.05, 1.0, 1.01, 1.02, -2.0, 3.0])
    cells = np.array([1, 2, 3, 4, 5, 5, 6, 7, 8])
    (first, num), (second, few) = agreed_logs(logs, cells, 0.15, 2)
    assert abs(first) < 0.05 and num == 4
    assert abs(second - 1.01) < 0.01 and few == 2
    assert agreed_logs(logs[-2:], cells[-2:], 0.15, 2) == []


@pytest.fixture
def row_of_maps(monkeypatch: pytest.MonkeyPatch) -> RowOfMaps:
    rng = np.random.default_rng(0)
    turns = Rotation.from_rotvec(0.3 * rng.normal(size=(9, 3))).as_matrix()
    row = RowOfMaps(inverse(pose(turns, rng.normal(size=(9, 3)))))
    monkeypatch.setattr(tour_merging, "join", row.join)
    return row


def test_maps_that_share_little_at_a_door_are_joined_further_inside(row_of_maps: RowOfMaps) -> None:
    scores, true = row_of_maps.scores, row_of_maps.true
    scores |= {(5, 6): 40.0, (2, 6): 60.0}
    maps = row_of_maps.maps()
    inside, door = all_joined([], maps, 1)
    assert (inside[0].last, inside[1].first) == (5, 6)
    one, other, at = door
    assert (one.last, other.first, other.last) == (2, 3, 8)
    np.testing.assert_allclose(at.g_T_f, true(2, 3, 1.0), atol=1e-9)
    assert at.log_scale == pytest.approx(np.log(2.0))
    scores.pop((2, 6))
    assert len(all_joined([], maps, 1)) == 1


@pytest.mark.parametrize("first", [(2, 3), (5, 6)])
def test_joins_have_the_units_of_maps_joined_before(
    first: tuple[int, int], row_of_maps: RowOfMaps
) -> None:
    """A join known since the map before it had units of its own is not taken in these."""
    row_of_maps.scores.update({(2, 3): 40.0, (5, 6): 40.0})
    row_of_maps.scores[first] = 60.0
    joined = all_joined([], row_of_maps.maps(), 1)
    assert (joined[0][0].last, joined[0][1].first) == first and len(joined) == 2
    for one, other, at in joined:
        units = row_of_maps.unit_of(one), row_of_maps.unit_of(other)
        true = row_of_maps.true(one.last, other.first, units[0])
        np.testing.assert_allclose(at.g_T_f, true, atol=1e-9)
        assert np.exp(at.log_scale) == pytest.approx(units[1] / units[0])
        for some in at.places:
            assert some.depths == pytest.approx(1 / units[some.f >= other.first])
