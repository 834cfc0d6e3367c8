"""Points that lost all their observations, at either end or in between, harm no consumer."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import RIG, World, make_world

from gsba.bundle import shared_parameters, triangulation
from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.families import Bearings, Families
from gsba.bundle.reconstruction import assemble
from gsba.camera.cameras import Cameras
from gsba.camera.lens import Lenses
from gsba.config import RefineSettings
from gsba.photometric.references import references, visible_frames
from gsba.types import CoarsePoses, Counts, Landmarks, PoseSource, Solution, Tracks

NUM_FRAMES, NUM_POINTS = 12, 60
SETTINGS = RefineSettings()
PROBLEM = AdjustmentContext(Families((Bearings(),)), RIG, SETTINGS, 1)


@cache
def _world() -> World:
    return make_world(0, NUM_FRAMES, NUM_POINTS, false_share=0)


@dataclass(frozen=True)
class Case:
    """Tracks of which some points lost all observations, and the same without these points."""

    rows: np.ndarray  # (O,) bool, observations that are left
    seen: np.ndarray  # (J,) bool, points that have some
    holed: Tracks
    compact: Tracks

    def landmarks(self) -> tuple[Landmarks, Landmarks]:
        """Their true points."""
        points, counts = _world().points_world, Counts(0, 0, "tracks")
        compact = Landmarks(points[self.seen], self.compact, counts)
        return Landmarks(points, self.holed, counts), compact


@st.composite
def _cases(draw: st.DrawFn) -> Case:
    """The first and last few points without observations, some in between, and rows at random."""
    tracks = _world().tracks
    num = tracks.num_points
    lost = np.zeros(num, bool)
    lost[: draw(st.integers(0, 3))] = True
    lost[num - draw(st.integers(0, 3)) :] = True
    lost[draw(st.lists(st.integers(0, num - 1), max_size=20))] = True
    seed, share = draw(st.integers(0, 2**32 - 1)), draw(st.sampled_from([0.3, 0.7, 1.0]))
    rows = ~lost[tracks.points] & (np.random.default_rng(seed).random(len(tracks)) < share)
    points = tracks.points[rows]
    seen, numbers = np.unique(points, return_inverse=True)
    own = tracks.frames[rows], tracks.keypoints[rows]
    holed, compact = Tracks(points, *own, num), Tracks(numbers.astype(np.int32), *own, len(seen))
    return Case(rows, np.isin(np.arange(num), seen), holed, compact)


each = settings(max_examples=60, deadline=None)


def _assert_same(found: Tracks, expected: Tracks) -> None:
    for name in ("points", "frames", "keypoints"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert found.num_points == expected.num_points


@each
@given(_cases())
def test_filters_leave_out_points_without_observations(case: Case) -> None:
    _assert_same(_world().tracks.of_observations(case.rows), case.compact)
    _assert_same(case.holed.of(case.seen), case.compact)
    _assert_same(case.compact.of_observations(np.ones(len(case.compact), bool)), case.compact)


@each
@given(st.floats(0, 1.5), st.floats(-0.9, 0.9))
def test_what_lenses_blend_leaves_no_point_without_observations(band: float, x: float) -> None:
    turn = np.array([[np.sqrt(1 - x * x), 0, x], [0, 1, 0], [-x, 0, np.sqrt(1 - x * x)]])
    lenses = Lenses(band_rad=band, axes=np.tile(turn, (NUM_FRAMES, 1, 1)))
    kept = Cameras((lenses,)).clear(_world().tracks, _world().keypoints)
    np.testing.assert_array_equal(np.unique(kept.points), np.arange(kept.num_points))
    found = triangulation.place(kept, _world().keypoints, _world().world_T_rigs, 6.0)
    assert found.counts.received == kept.num_points


@each
@given(_cases())
def test_hosts_are_those_of_the_seen(case: Case) -> None:
    hosts = case.holed.hosts()
    np.testing.assert_array_equal(hosts[case.seen], case.compact.hosts())
    assert (hosts[~case.seen] == -1).all()


@each
@given(_cases())
def test_triangulation_drops_the_unseen(case: Case) -> None:
    given = _world().keypoints, _world().world_T_rigs, 6.0
    found, expected = (triangulation.place(t, *given) for t in (case.holed, case.compact))
    np.testing.assert_array_equal(found.points_world, expected.points_world)
    _assert_same(found.tracks, expected.tracks)
    unseen = np.count_nonzero(~case.seen)
    reason = "observations disagree"
    assert found.counts.dropped[reason] == expected.counts.dropped[reason] + unseen


@each
@given(_cases())
def test_points_are_moved_with_their_hosts(case: Case) -> None:
    rng = np.random.default_rng(0)
    scales, moves = rng.uniform(1, 2, NUM_FRAMES), _world().world_T_rigs
    found, expected = (each.moved(scales, moves).points_world for each in case.landmarks())
    np.testing.assert_array_equal(found[case.seen], expected)


@each
@given(_cases())
def test_parts_hold_every_observation_once(case: Case) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shared_parameters, "_MIN_POINTS", 5)
        holed, _ = case.landmarks()
        parts = shared_parameters.parts_of(holed)
        drawn = shared_parameters.drawn(holed, max(len(case.holed) // 2, 1), 0)
    assert not parts or sum(len(part.tracks) for part in parts) == len(case.holed)
    for part in [*parts, drawn]:
        assert part.tracks.num_points == len(part.points_world)


@each
@given(_cases())
def test_eliminating_points_gives_the_same_system(case: Case) -> None:
    solved = Solution(_world().world_T_rigs, case.landmarks()[1], 1.0, ())
    systems = []
    for landmarks in case.landmarks():
        around = replace(solved, landmarks=landmarks)
        rays = shared_parameters.ObservedRays(around, _world().keypoints, PROBLEM)
        seen = shared_parameters.weighted(rays)
        sums = shared_parameters.without_points(seen, landmarks.tracks, NUM_FRAMES, seen.by_pose)
        systems.append(sums.system())
    np.testing.assert_allclose(systems[0].cost, systems[1].cost, rtol=1e-12)
    np.testing.assert_allclose(systems[0].gradient, systems[1].gradient, rtol=1e-9, atol=1e-9)
    assert abs(systems[0].hessian - systems[1].hessian).max() <= 1e-9 * (
        1 + abs(systems[1].hessian).max()
    )


@each
@given(_cases())
def test_patches_are_looked_for_at_the_seen_alone(case: Case) -> None:
    poses, found = _world().world_T_rigs, []
    for landmarks in case.landmarks():
        rows = references(landmarks, poses)
        extended = np.ones(len(rows), bool)
        views = visible_frames(landmarks, poses, rows, extended, np.arange(len(poses)))
        found.append((rows, views))
    np.testing.assert_array_equal(found[0][0][case.seen], found[1][0])
    points, frames = found[0][1]
    np.testing.assert_array_equal(frames, found[1][1][1])
    assert case.seen[points].all()


@pytest.mark.filterwarnings("error")
@each
@given(_cases())
def test_a_result_is_the_same_for_the_seen(case: Case) -> None:
    sources = np.full(NUM_FRAMES, PoseSource.SLAM, np.uint8)
    coarse = CoarsePoses(_world().world_T_rigs, sources, 0.0)
    covariances = np.zeros((NUM_FRAMES, 6, 6))
    results = [
        assemble(
            Solution(_world().world_T_rigs, landmarks, 1.0, ()),
            covariances,
            _world().keypoints,
            coarse,
            1,
        )
        for landmarks in case.landmarks()
    ]
    for name in ("points_world", "point_colors", "point_errors"):
        found, expected = (getattr(result, name) for result in results)
        np.testing.assert_array_equal(found[case.seen], expected)
    whole = replace(results[0], observation_points=results[1].observation_points)
    for name in ("pose_statuses", "observation_frames", "observation_bearings"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(results[1], name))
