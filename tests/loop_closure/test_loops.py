"""Places met again beyond the reach of drift: the right ones are closed, look-alikes are not."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import unit
from two_maps import HALF, NUM, SETTINGS, TRUTH, scene_of, torn

from gsba.geometry import inverse, pose, rotation_angle
from gsba.loop_closure import loops
from gsba.loop_closure.loops import Loop
from gsba.loop_closure.retrieval import _sampled_descriptors, aggregate, global_descriptors
from gsba.matching.guided_search import MatchContext
from gsba.similarity import relative_similarity
from gsba.store.shards import Threads
from gsba.types import Solution, Tracks

SEEN = np.zeros(NUM - 1, bool)


@cache
def _whole() -> tuple[MatchContext, Solution]:
    """Once around, in one map."""
    return scene_of(TRUTH, halves=False)[:2]


@cache
def _halves(heading: float = 0.0) -> tuple[MatchContext, Solution, np.ndarray]:
    """Once around, the second half with the camera turned about its vertical axis."""
    turned = TRUTH.copy()
    turned[HALF:, :3, :3] @= Rotation.from_rotvec([0, heading, 0]).as_matrix()
    return scene_of(turned)


def test_looks_do_not_depend_on_heading() -> None:
    straight, turned = (_halves(heading)[0].frames for heading in (0.0, 2.0))
    words = straight[0].descriptors[:64]
    for f in range(NUM):
        one, other = (aggregate(frames[f].descriptors, words) for frames in (straight, turned))
        np.testing.assert_allclose(one, other, atol=1e-5)


def test_the_same_place_looks_most_alike() -> None:
    looks = global_descriptors(_whole()[0].frames, NUM, 0, Threads(1))
    far = [f for f in range(NUM) if 4 < f < NUM - 4]
    alike = looks @ looks.T
    assert alike[0, NUM - 1] > max(alike[0, f] for f in far)


def test_only_places_that_may_be_met_again_are_compared() -> None:
    context, whole = _whole()
    looks = global_descriptors(context.frames, NUM, 0, Threads(1))
    found = loops.candidates(looks, whole, SEEN, SETTINGS)
    assert [0, NUM - 1] in found.tolist()
    # A walk that ends before it comes back.
    num = HALF
    before = replace(
        whole,
        world_T_rigs=whole.world_T_rigs[:num],
        landmarks=whole.landmarks.of(_seen_before(whole.landmarks.tracks, num)),
    )
    unseen = SEEN[: num - 1].copy()
    assert not len(loops.candidates(looks[:num], before, unseen, SETTINGS))
    unseen[num // 2] = True  # what is on its other side may be anywhere
    across = loops.candidates(looks[:num], before, unseen, SETTINGS)
    assert len(across) and (across[:, 0] <= num // 2).all() and (across[:, 1] > num // 2).all()


def _seen_before(tracks: Tracks, frame: int) -> np.ndarray:
    """True (J,) for points that no frame from one on sees."""
    seen = np.ones(tracks.num_points, bool)
    seen[tracks.points[tracks.frames >= frame]] = False
    return seen


def test_frames_that_the_map_holds_together_are_not_compared() -> None:
    assert loops.close(*_whole(), SEEN).counts.received == 0
    assert loops.close(*_halves()[:2], SEEN).counts.received > 0


@pytest.mark.parametrize("heading", [0.0, 2.5])
def test_a_map_torn_in_two_is_joined_where_it_meets(heading: float) -> None:
    context, whole, late = _halves(heading)
    by = pose(Rotation.from_rotvec([0.02, 0.3, 0]).as_matrix(), np.array([0.2, 0.1, -0.3]))
    unseen = SEEN.copy()
    unseen[HALF - 1] = True
    closed = loops.close(context, torn(whole, late, 1.0, by), unseen)
    assert len(closed.pairs) >= 3
    relative = inverse(closed.solved.world_T_rigs[0]) @ closed.solved.world_T_rigs
    true = inverse(whole.world_T_rigs[0]) @ whole.world_T_rigs
    assert np.linalg.norm(relative[:, :3, 3] - true[:, :3, 3], axis=1).max() < 0.05
    between = np.swapaxes(relative[:, :3, :3], 1, 2) @ true[:, :3, :3]
    assert np.degrees(rotation_angle(between)).max() < 1.0
    # Points went with their frames.
    tracks, solved = closed.solved.landmarks.tracks, closed.solved
    rays = bearings_of_each(solved.landmarks.points_world[tracks.points], solved, tracks)
    seen = context.keypoints.bearings_rig[context.keypoints.rows(tracks)]
    assert np.median(np.linalg.norm(rays - seen, axis=1)) < 2e-3


def test_descriptors_that_are_drawn_hold_no_others() -> None:
    drawn = _sampled_descriptors(np.eye(50, dtype=np.float32), 3, share=4, seed=0)
    assert drawn.shape == (4, 50) and drawn.base is None


def bearings_of_each(points: np.ndarray, solved: Solution, tracks: Tracks) -> np.ndarray:
    poses = solved.world_T_rigs[tracks.frames]
    return unit(np.einsum("oji,oj->oi", poses[:, :3, :3], points - poses[:, :3, 3]))


def test_a_confirmed_path_is_not_bent_further_than_it_drifts() -> None:
    """The same torn map, but every step was confirmed by images: then the loops are the error."""
    context, whole, late = _halves()
    moved = torn(whole, late, 1.0, pose(np.eye(3), np.array([3.0, 0, 0])))
    closed = loops.close(context, moved, SEEN)
    assert len(closed.pairs) == 0 and closed.solved is moved


def _loops(shift: float, count: int, support: int, last: int = NUM - 1) -> list[Loop]:
    """Loops between the first frames and the last, false by a shift along x of the world."""
    found = []
    for n in range(count):
        target = TRUTH[last - n].copy()
        target[0, 3] += shift
        found.append(Loop(n, last - n, inverse(TRUTH[n]) @ target, support))
    return found


def _consistent(found: list[Loop]) -> list[Loop]:
    return loops.consistent(found, _whole()[1], SETTINGS.pairs.window)


def test_a_lone_loop_is_not_believed() -> None:
    assert len(_consistent(_loops(0.0, 2, 500))) == 0
    assert len(_consistent(_loops(0.0, 3, 20))) == 3


def test_loops_that_scatter_are_not_believed() -> None:
    scattered = [loop for n in range(5) for loop in _loops(0.7 * n, n + 1, 50)[-1:]]
    assert len(_consistent(scattered)) == 0


@pytest.mark.parametrize(("support", "believed"), [(60, 4), (25, 0), (10, 0)])
def test_rivals_need_to_be_outweighed(support: int, believed: int) -> None:
    """Four true loops against four that agree on an arch further on."""
    found = _consistent(_loops(0.0, 4, support) + _loops(2.0, 4, 25))
    true = [loop for loop in found if np.allclose(loop.f0_T_f1, _loops(0.0, 4, 1)[loop.f0].f0_T_f1)]
    assert len(true) == believed
    assert len(found) == (4 if support in (60, 10) else 0)


def test_what_two_frames_see_fixes_pose_and_scale() -> None:
    rng = np.random.default_rng(2)
    points0 = rng.uniform(1, 4, (60, 1)) * unit(rng.normal(size=(60, 3)))
    true = pose(Rotation.from_rotvec([0.3, 2.0, -0.2]).as_matrix(), np.array([0.4, -0.2, 0.1]))
    points1 = 1.7 * (points0 - true[:3, 3]) @ true[:3, :3]
    points1[:20] = rng.normal(size=(20, 3))
    found = relative_similarity(points0, points1, 0)
    assert found is not None and 40 <= found[1].sum() <= 42
    np.testing.assert_allclose(found[0].new_T_old, true, atol=0.05)
    assert relative_similarity(points0[:20], points1[:20], 0) is None
