"""Closing loops: known points where they must appear, not what looks like them elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import bearings_of, context_of, features_of, unit, with_noise

from gsba.camera.rig import owner_faces
from gsba.config import PairSettings, RefineSettings
from gsba.features import detection
from gsba.geometry import inverse, pose
from gsba.matching import correspondences
from gsba.matching.guided_search import MatchContext, SearchableFrames
from gsba.store.shards import Threads
from gsba.types import Counts, Landmarks, Solution, Tracks, VerifiedPairs

NUM = 300
LAST = 5  # the frame that comes back
STRIDE = 0.2  # the walk is 0.2 a step along x, the points are 2 to 4 away


def _scene(shift: float) -> tuple[MatchContext, Solution]:
    """A solved walk along x whose last frame sees, of every point, a copy moved along x."""
    rng = np.random.default_rng(0)
    points = rng.uniform(2, 4, (NUM, 1)) * unit(rng.normal(size=(NUM, 3)))
    positions = np.outer(np.arange(LAST + 1), [STRIDE, 0, 0])
    world_T_rigs = pose(np.tile(np.eye(3), (LAST + 1, 1, 1)), positions)
    descriptors = (200 * rng.random((NUM, 64)) ** 4).astype(np.uint8)
    shifts = np.zeros((LAST + 1, 3))
    shifts[LAST, 0] = shift
    frames = [
        features_of(with_noise(bearings_of(points + moved, world_T_rig), 3e-4, rng), descriptors)
        for moved, world_T_rig in zip(shifts, world_T_rigs, strict=True)
    ]
    which, seen_from = (grid.ravel() for grid in np.meshgrid(np.arange(NUM), np.arange(LAST)))
    order = np.lexsort((seen_from, which))
    which, seen_from = which[order].astype(np.int32), seen_from[order].astype(np.int32)
    landmarks = Landmarks(points, Tracks(which, seen_from, which, NUM), Counts(NUM, NUM, "tracks"))
    solved = Solution(world_T_rigs, landmarks, 1.0, ())
    return context_of(frames, RefineSettings(pairs=PairSettings(window=2))), solved


def _loops_to_last(shift: float) -> tuple[VerifiedPairs, np.ndarray]:
    """All loops, and the rows of those that end in the last frame."""
    found = correspondences.match_loops(*_scene(shift))
    return found, np.flatnonzero(found.matches.pairs[:, 1] == LAST)


def test_neighbours_of_different_maps_are_not_matched_along_epipolars() -> None:
    context, solved = _scene(shift=0)
    context = replace(context, settings=RefineSettings())
    whole = correspondences.match_along_epipolars(context, solved)
    maps = np.array([0, 0, 0, -1, 1, 1])
    found = correspondences.match_along_epipolars(context, solved, maps)
    apart = [[2, 4]]  # frame 3 is of no map
    assert [pair for pair in whole.pairs.tolist() if pair not in apart] == found.pairs.tolist()
    assert apart[0] in whole.pairs.tolist() and len(found.of(0)) > NUM / 2


def test_points_are_known_where_tracks_see_them() -> None:
    context, solved = _scene(shift=0)
    turned = solved.world_T_rigs.copy()
    turned[:, :3, :3] = Rotation.random(LAST + 1, rng=2).as_matrix()
    landmarks, whole = solved.landmarks, solved.landmarks.tracks
    tracks = whole.of_observations(whole.frames != whole.points % LAST)
    solved = replace(solved, world_T_rigs=turned, landmarks=replace(landmarks, tracks=tracks))
    known = solved.points_by_keypoint(context.keypoints)
    expected = np.full((LAST + 1, NUM, 3), np.nan)
    for point, frame, keypoint in zip(tracks.points, tracks.frames, tracks.keypoints, strict=True):
        there = inverse(turned[frame]) @ [*landmarks.points_world[point], 1]
        expected[frame, keypoint] = there[:3]
    assert np.isnan(expected).any() and np.isfinite(expected).any()
    for frame in range(LAST + 1):
        np.testing.assert_allclose(known[frame], expected[frame], atol=1e-12)


def test_loops_are_closed_by_known_points() -> None:
    found, rows = _loops_to_last(shift=0)
    assert found.matches.pairs[rows, 0].tolist() == [2, 1, 0]  # beyond the window, nearest first
    for row in rows:
        matched = found.matches.of(row)
        assert len(matched) > 0.9 * NUM and (matched[:, 0] == matched[:, 1]).all()


@pytest.mark.parametrize(("loop_deg", "fooled"), [(2.0, False), (180.0, True)])
def test_look_alikes_at_a_distance_close_no_loop(
    loop_deg: float, fooled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Copies as one would see the points from further along: two views alone cannot tell."""
    monkeypatch.setattr(correspondences, "_LOOP_DEG", loop_deg)
    found, rows = _loops_to_last(shift=-1.5)
    assert (len(rows) > 0) == fooled
    assert len(found.matches.pairs) - len(rows) == 3  # 0-3, 0-4 and 1-4 are what they seem


@pytest.mark.parametrize(("min_inlier_ratio", "misled"), [(0.5, False), (0.0, True)])
def test_all_keypoints_decide_where_the_strongest_disagree(
    min_inlier_ratio: float, misled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The strongest see a pattern that repeats, or nothing in common; the many others are right."""
    rng = np.random.default_rng(3)
    points = rng.uniform(2, 4, (600, 1)) * unit(rng.normal(size=(600, 3)))
    true, wrong = np.array([STRIDE, 0, 0]), STRIDE * unit(np.array([1, 0.28, 0]))
    repeated, lost = np.arange(600) < 90, (np.arange(600) >= 90) & (np.arange(600) < 240)
    descriptors = (200 * rng.random((600, 64)) ** 4).astype(np.uint8)
    frames = []
    for step in range(2):
        rig_T = np.eye(4)
        seen_from = np.where(repeated[:, None], step * wrong, step * true)
        bearings = with_noise(bearings_of(points - seen_from, rig_T), 3e-4, rng)
        if step:
            bearings[lost] = with_noise(bearings[lost], np.deg2rad(1), rng)
        by_face = np.argsort(owner_faces(bearings), kind="stable")
        frames.append(features_of(bearings[by_face], descriptors[by_face]))
    monkeypatch.setattr(correspondences, "_MIN_INLIER_RATIO", min_inlier_ratio)
    settings = RefineSettings(pairs=PairSettings(window=2))
    all_, strongest = (SearchableFrames(frames.__getitem__, n) for n in (None, 40))
    context = MatchContext(all_, strongest, detection.gather(frames), settings, Threads(1))
    world_T_rigs = pose(np.tile(np.eye(3), (2, 1, 1)), np.stack([np.zeros(3), true]))
    start = Solution.without_points(world_T_rigs)
    found = correspondences.match_neighbours(context, start)
    assert found.matches.pairs.tolist() == [[0, 1]]
    off = np.rad2deg(np.arccos(found.f0_T_f1s[0, :3, 3] @ unit(true)))
    assert off > 10 if misled else off < 1
