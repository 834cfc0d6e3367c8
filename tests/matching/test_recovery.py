"""Neighbours matched without the trajectory where it misleads, and only there."""

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import bearings_of, context_of, features_of, unit, with_noise

from gsba.config import RefineSettings
from gsba.geometry import inverse, pose, rotation_angle
from gsba.matching import correspondences, guided_search, recovery
from gsba.matching.guided_search import MatchContext, SearchableFrames
from gsba.matching.recovery import Recovered
from gsba.similarity import Sim3
from gsba.types import CoarsePoses, Matches, PoseSource, Solution, VerifiedPairs

NUM, NUM_FRAMES = 250, 8
TRUTH = pose(
    np.tile(np.eye(3), (NUM_FRAMES, 1, 1)), np.outer(np.arange(NUM_FRAMES), [0.3, 0.0, 0.05])
)
SETTINGS = RefineSettings()
TIMES = np.arange(NUM_FRAMES, dtype=float)


def _walk(poses: np.ndarray, seen: np.ndarray) -> MatchContext:
    """A walk with poses (F, 4, 4) among points of which each frame sees some: (F, J) bool."""
    rng, num = np.random.default_rng(1), seen.shape[1]
    points = rng.uniform(2, 5, (num, 1)) * unit(rng.normal(size=(num, 3))) + [1, 0, 0]
    descriptors = (200 * rng.random((num, 64)) ** 4).astype(np.uint8)
    frames = [
        features_of(with_noise(bearings_of(points[some], T), 3e-4, rng), descriptors[some])
        for T, some in zip(poses, seen, strict=True)
    ]
    return context_of(frames, SETTINGS)


def _context(cut: int = NUM_FRAMES) -> MatchContext:
    """A short walk among points; from frame `cut` on, among others."""
    elsewhere = np.arange(NUM_FRAMES) >= cut
    return _walk(TRUTH, elsewhere[:, None] == (np.arange(2 * NUM) >= NUM))


def _coarse(slam: np.ndarray) -> CoarsePoses:
    return CoarsePoses(slam, np.full(NUM_FRAMES, PoseSource.SLAM, np.uint8), 0.0)


def _run(slam: np.ndarray, cut: int = NUM_FRAMES, times: np.ndarray = TIMES) -> Recovered:
    context = _context(cut)
    guided = correspondences.match_neighbours(context, Solution.without_points(slam))
    coarse = _coarse(slam)
    guided = recovery.unless_misguided(context, guided, coarse, times)
    return recovery.recover(context, guided, coarse, times)


def test_a_right_trajectory_is_left_alone() -> None:
    with patch.object(recovery, "match_anywhere", wraps=recovery.match_anywhere) as anywhere:
        recovered = _run(TRUTH)
    assert all(len(call.args[1]) == 0 for call in anywhere.call_args_list)
    assert recovered.trust.sound and len(recovered.neighbours.matches.pairs) == 2 * NUM_FRAMES - 3


def test_neighbours_of_a_false_pose_are_matched_without_it() -> None:
    slam = TRUTH.copy()
    slam[4] = slam[4] @ pose(Rotation.from_rotvec([0, 1.5, 0]).as_matrix(), np.array([0, 2.0, 0]))
    recovered = _run(slam)
    assert np.flatnonzero(recovered.trust.false_frames).tolist() == [4]
    found = recovered.neighbours
    pairs = found.matches.pairs
    assert len(pairs) == 2 * NUM_FRAMES - 3  # those two apart, too
    assert (np.diff(pairs[:, 1] - pairs[:, 0]) >= 0).all()
    for p, (f0, f1) in enumerate(pairs):
        rows = found.matches.of(p)
        assert len(rows) > 0.8 * NUM and (rows[:, 0] == rows[:, 1]).all()
        true = inverse(TRUTH[f0]) @ TRUTH[f1]
        assert np.degrees(rotation_angle(found.f0_T_f1s[p, :3, :3])) < 0.1
        assert found.f0_T_f1s[p, :3, 3] @ unit(true[:3, 3]) > np.cos(np.deg2rad(1))


def test_frames_with_a_pause_between_them_are_no_neighbours() -> None:
    slam = TRUTH.copy()
    slam[4:, :3, 3] += [0, 2.0, 0]
    times = np.arange(NUM_FRAMES) + 5.0 * (np.arange(NUM_FRAMES) >= 4)
    assert np.flatnonzero(_run(slam).trust.false_steps).tolist() == [3]
    paused = _run(slam, times=times).trust
    assert np.flatnonzero(paused.unseen_steps).tolist() == [3] and not paused.false_steps.any()


def test_two_places_stay_two() -> None:
    recovered = _run(TRUTH, cut=5)
    assert np.flatnonzero(recovered.trust.unseen_steps).tolist() == [4]
    crossing = recovered.neighbours.matches.pairs
    assert not ((crossing[:, 0] < 5) & (crossing[:, 1] >= 5)).any()
    np.testing.assert_allclose(recovered.trust.world_T_rigs, TRUTH, atol=1e-6)


def test_a_lone_look_alike_without_a_third_view_is_not_believed() -> None:
    """A step that whole panoramas agree on, but no third frame confirms."""
    context = _context(cut=5)
    pair = np.array([[1, 2]], np.int32)
    empty = recovery.match_anywhere(context, pair[:0])
    alone = recovery.match_anywhere(context, pair)
    assert len(empty.matches.pairs) == 0
    assert not recovery._is_supported((1, 2), alone, context.keypoints, True)


def test_frames_of_two_pieces_are_never_tied_by_two_views() -> None:
    """Each piece has a world and a scale of its own, and two views have none to hand on."""
    slam, half = TRUTH.copy(), NUM_FRAMES // 2
    slam[half:] = Sim3.of(0.4, np.eye(4)).poses(TRUTH[half:])
    segments = (np.arange(NUM_FRAMES) >= half).astype(np.int32)
    context = _context()
    guided = correspondences.match_neighbours(context, Solution.without_points(TRUTH))
    assert {(half - 1, half), (half - 2, half)} <= guided.frames()
    slam_only = np.full(NUM_FRAMES, PoseSource.SLAM, np.uint8)
    coarse = CoarsePoses(slam, slam_only, 0.0, segments)
    found = recovery.recover(context, guided, coarse, TIMES)
    pieces = segments[found.neighbours.matches.pairs]
    assert len(pieces) == 2 * (2 * half - 3) and (pieces[:, 0] == pieces[:, 1]).all()
    assert np.flatnonzero(found.trust.unseen_steps).tolist() == [half - 1]
    assert not found.trust.held_steps.any()  # where the second piece lies is a guess
    steps = np.linalg.norm(np.diff(found.trust.world_T_rigs[:, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(steps, steps[0], rtol=0.05)


def _from_images_alone(context: MatchContext) -> Recovered:
    nowhere = np.tile(np.eye(4), (NUM_FRAMES, 1, 1))
    coarse = CoarsePoses(nowhere, np.full(NUM_FRAMES, PoseSource.NONE, np.uint8), 0.0)
    return recovery.recover(context, VerifiedPairs.none(), coarse, TIMES)


def _frames(found: Recovered) -> set[tuple[int, int]]:
    return {(f0, f1) for f0, f1 in found.neighbours.matches.pairs.tolist()}


def test_few_points_do_not_make_a_step_many_times_shorter() -> None:
    """As a pattern of tiles does that is met one tile further on; many points are believed."""
    even = TRUTH.copy()
    even[:, :3, 3] *= 1.5
    poses = even.copy()
    poses[4:, :3, 3] -= 0.82 * (even[4] - even[3])[:3, 3]
    everything = np.ones((NUM_FRAMES, NUM), bool)
    few = everything & (np.arange(NUM) < 45)
    assert {(2, 3), (3, 4), (4, 5)} <= _frames(_from_images_alone(_walk(poses, everything)))
    pairs = _frames(_from_images_alone(_walk(poses, few)))
    assert (3, 4) not in pairs and {(2, 3), (4, 5)} <= pairs
    assert {(2, 3), (3, 4), (4, 5)} <= _frames(_from_images_alone(_walk(even, few)))


def test_steps_are_matched_again_with_all_keypoints() -> None:
    context = _walk(TRUTH, np.ones((NUM_FRAMES, NUM), bool))
    pair = np.array([[2, 3]], np.int32)
    whole = recovery.match_anywhere(context, pair)
    few = replace(whole, matches=Matches.of_rows(pair, [whole.matches.of(0)[::6]]))
    again = recovery.match_again(context, few, {2})
    assert len(few.matches.of(0)) < 45 and len(again.matches.of(0)) > 0.9 * NUM
    assert len(recovery.match_again(context, few, {3}).matches.of(0)) < 45


def test_at_lost_steps_of_frames_far_apart_the_camera_walks_on() -> None:
    """Look-alikes mislead there; turns that images show replace the trajectory's."""
    slam = TRUTH.copy()
    slam[4] = slam[4] @ pose(Rotation.from_rotvec([0, 1.5, 0]).as_matrix(), np.array([0, 2.0, 0]))
    lost = np.array([[3, 4], [4, 5]], np.int32)
    context = _context()
    found = recovery.match_anywhere(context, lost)
    coarse = CoarsePoses(slam, np.full(NUM_FRAMES, PoseSource.SLAM, np.uint8), 0.0)
    walked = recovery._walked_on(coarse, lost, found, TIMES)
    np.testing.assert_allclose(walked, inverse(TRUTH[0]) @ TRUTH, atol=2e-3)


@pytest.mark.parametrize(
    ("far", "misled", "expected"), [(True, 0.5, True), (True, 0.05, False), (False, 0.5, False)]
)
def test_known_steps_of_frames_far_apart_tell_whether_matching_is_misled(
    far: bool, misled: float, expected: bool
) -> None:
    context = _context()
    guided = correspondences.match_neighbours(context, Solution.without_points(TRUTH))
    asked = recovery.match_anywhere

    def answer(context: MatchContext, chosen: np.ndarray) -> VerifiedPairs:
        found = asked(context, chosen)
        poses = found.f0_T_f1s.copy()
        poses[: round(misled * len(poses)), :3, 3] *= -1  # in the other direction
        return replace(found, f0_T_f1s=poses)

    with (
        patch.object(recovery, "match_anywhere", answer),
        patch.object(recovery, "_FAR_STEP_DEPTHS", 0.05 if far else 0.5),
    ):
        assert recovery._misleads(context, guided) == expected


@pytest.mark.parametrize(
    ("share", "lost", "kept"), [(0.5, 2, 0), (1.0, 2, NUM_FRAMES - 3), (0.5, 1, NUM_FRAMES - 2)]
)
def test_guided_steps_are_left_out_where_other_poses_explain_more_matches(
    share: float, lost: int, kept: int
) -> None:
    """Gates around a reversed trajectory keep the few false matches that confirm it."""
    context = _context()
    steps = np.column_stack([np.arange(NUM_FRAMES - 1), np.arange(1, NUM_FRAMES)])
    found = recovery.match_anywhere(context, steps)
    poses = found.f0_T_f1s.copy()
    poses[:, :3, 3] *= -1
    rows = [found.matches.of(p)[: int(share * len(found.matches.of(p)))] for p in range(len(poses))]
    matches = Matches.of_rows(found.matches.pairs, rows)
    guided = replace(found, f0_T_f1s=poses, matches=matches).taken(range(lost, NUM_FRAMES - 1))
    assert len(recovery.unless_misguided(context, guided, _coarse(TRUTH), TIMES).f0_T_f1s) == kept


def test_a_look_alike_at_a_lost_step_is_not_taken_where_matching_misleads() -> None:
    """Where matching does not mislead, it is what images say."""
    slam = TRUTH.copy()
    slam[4, :3, 3] += [0, 2.0, 0]
    misleading = TRUTH.copy()
    misleading[4, :3, 3] -= [0.5, 0, 0]  # a bay back
    asked = recovery.match_anywhere

    def misled(context: MatchContext, chosen: np.ndarray, rivals: bool = True) -> VerifiedPairs:
        found = asked(context, chosen, rivals)
        poses = inverse(misleading[found.matches.pairs[:, 0]])
        poses = poses @ misleading[found.matches.pairs[:, 1]]
        poses[:, :3, 3] = unit(poses[:, :3, 3])
        return replace(found, f0_T_f1s=poses)

    for misleading_walk in (False, True):
        with (
            patch.object(recovery, "match_anywhere", misled),
            patch.object(recovery, "_misleads", return_value=misleading_walk),
        ):
            recovered = _run(slam)
        step = inverse(recovered.trust.world_T_rigs[3]) @ recovered.trust.world_T_rigs[4]
        assert (
            unit(step[:3, 3]) @ unit(TRUTH[4, :3, 3] - TRUTH[3, :3, 3]) > 0.99
        ) == misleading_walk


def test_a_learned_matcher_gets_all_keypoints_where_search_finds_scarce_matches(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    context, asked = _context(), []

    def matcher(frames, *given):
        asked.append(frames)
        return guided_search.guided(frames, *given)

    frames, pairs = context.frames, np.array([[0, 1], [1, 2]])
    strongest = SearchableFrames(frames.features, 10)
    context = replace(context, strongest=strongest, matcher=matcher)
    assert len(recovery.match_anywhere(context, pairs).matches.pairs) == 2
    assert not asked
    monkeypatch.setattr(recovery, "SCARCE_MATCHES", 10_000)
    assert len(recovery.match_anywhere(context, pairs).matches.pairs) == 2
    assert len(asked) == 2 and all(one is frames for one in asked)
    asked.clear()
    recovery.match_anywhere(context.of_strongest(), pairs)
    assert not asked
