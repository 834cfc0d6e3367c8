"""Places met again beyond the reach of drift: the right ones are closed, look-alikes are not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import bearings_of, features_of, loop_walk, unit, with_noise

from gsba.config import PairSettings, RefineSettings
from gsba.features import detection
from gsba.geometry import inverse, pose, rotation_angle
from gsba.loop_closure import loops
from gsba.loop_closure.loops import Loop
from gsba.loop_closure.retrieval import _sampled_descriptors, aggregate, global_descriptors
from gsba.matching.guided_search import MatchContext, SearchableFrames
from gsba.similarity import relative_similarity
from gsba.store.shards import Threads
from gsba.types import Counts, Keypoints, Landmarks, Solution, Tracks

NUM_FRAMES, NUM_POINTS = 40, 1500
SETTINGS = RefineSettings(pairs=PairSettings(window=8))
TRUTH = loop_walk(NUM_FRAMES)
SEEN = np.zeros(NUM_FRAMES - 1, bool)


def _scene(heading: float = 0.0) -> tuple[SearchableFrames, Keypoints, Solution]:
    """Once around; every frame sees what is near, the last ones what the first ones see."""
    rng = np.random.default_rng(0)
    near = TRUTH[rng.integers(0, NUM_FRAMES, NUM_POINTS), :3, 3]
    offsets = rng.uniform(0.8, 2.5, (NUM_POINTS, 1)) * unit(rng.normal(size=(NUM_POINTS, 3)))
    points = near + offsets
    descriptors = (200 * rng.random((NUM_POINTS, 64)) ** 4).astype(np.uint8)
    turned = TRUTH.copy()
    turn = Rotation.from_rotvec([0, heading, 0]).as_matrix()
    turned[NUM_FRAMES // 2 :, :3, :3] = turned[NUM_FRAMES // 2 :, :3, :3] @ turn
    frames, tracks = [], []
    for f, world_T_rig in enumerate(turned):
        seen = np.flatnonzero(np.linalg.norm(points - world_T_rig[:3, 3], axis=1) < 2.6)
        bearings = with_noise(bearings_of(points[seen], world_T_rig), 3e-4, rng)
        frames.append(features_of(bearings, descriptors[seen]))
        tracks.append(np.column_stack([seen, np.full(len(seen), f), np.arange(len(seen))]))
    rows = np.concatenate(tracks)
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))].astype(np.int32)
    _, renumbered = np.unique(rows[:, 0], return_inverse=True)
    kept = np.unique(rows[:, 0])
    own = Tracks(renumbered.astype(np.int32), rows[:, 1], rows[:, 2], len(kept))
    landmarks = Landmarks(points[kept], own, Counts(len(kept), len(kept), "tracks"))
    solved = Solution(turned, landmarks, 1.0, ())
    return SearchableFrames(frames.__getitem__), detection.gather(frames), solved


def _split(solved: Solution) -> Solution:
    """The same points as two maps would hold them: those of the first half, and of the second."""
    tracks = solved.landmarks.tracks
    late = tracks.frames >= NUM_FRAMES // 2
    points = 2 * tracks.points + late
    order = np.lexsort((tracks.frames, points))
    kept, renumbered = np.unique(points[order], return_inverse=True)
    own = Tracks(
        renumbered.astype(np.int32), tracks.frames[order], tracks.keypoints[order], len(kept)
    )
    placed = solved.landmarks.points_world[kept // 2]
    return replace(solved, landmarks=Landmarks(placed, own, solved.landmarks.counts))


def _moved(solved: Solution, by: np.ndarray) -> Solution:
    """The second half of frames and points carried off."""
    poses = solved.world_T_rigs.copy()
    half = NUM_FRAMES // 2
    poses[half:] = by @ poses[half:]
    tracks = solved.landmarks.tracks
    first = tracks.frames[np.searchsorted(tracks.points, np.arange(tracks.num_points))]
    points = solved.landmarks.points_world.copy()
    late = first >= half
    points[late] = points[late] @ by[:3, :3].T + by[:3, 3]
    return Solution(poses, replace(solved.landmarks, points_world=points), 1.0, ())


def test_looks_do_not_depend_on_heading() -> None:
    straight, turned = _scene()[0], _scene(heading=2.0)[0]
    words = straight[0].descriptors[:64]
    for f in range(NUM_FRAMES):
        one, other = (aggregate(frames[f].descriptors, words) for frames in (straight, turned))
        np.testing.assert_allclose(one, other, atol=1e-5)


def _context(frames: SearchableFrames, keypoints: Keypoints) -> MatchContext:
    return MatchContext(frames, frames, keypoints, SETTINGS, Threads(1))


def test_the_same_place_looks_most_alike() -> None:
    looks = global_descriptors(_scene()[0], NUM_FRAMES, 0, Threads(1))
    far = [f for f in range(NUM_FRAMES) if 4 < f < NUM_FRAMES - 4]
    alike = looks @ looks.T
    assert alike[0, NUM_FRAMES - 1] > max(alike[0, f] for f in far)


def test_only_places_that_may_be_met_again_are_compared() -> None:
    strongest, _, whole = _scene()
    looks = global_descriptors(strongest, NUM_FRAMES, 0, Threads(1))
    found = loops.candidates(looks, whole, SEEN, SETTINGS)
    assert [0, NUM_FRAMES - 1] in found.tolist()
    # A walk that ends before it comes back.
    num = NUM_FRAMES // 2
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
    strongest, keypoints, whole = _scene()
    assert loops.close(_context(strongest, keypoints), whole, SEEN).counts.received == 0
    assert loops.close(_context(strongest, keypoints), _split(whole), SEEN).counts.received > 0


@pytest.mark.parametrize("heading", [0.0, 2.5])
def test_a_map_torn_in_two_is_joined_where_it_meets(heading: float) -> None:
    strongest, keypoints, whole = _scene(heading)
    by = pose(Rotation.from_rotvec([0.02, 0.3, 0]).as_matrix(), np.array([0.2, 0.1, -0.3]))
    torn = _moved(_split(whole), by)
    unseen = SEEN.copy()
    unseen[NUM_FRAMES // 2 - 1] = True
    closed = loops.close(_context(strongest, keypoints), torn, unseen)
    assert len(closed.pairs) >= 3
    relative = inverse(closed.solved.world_T_rigs[0]) @ closed.solved.world_T_rigs
    true = inverse(whole.world_T_rigs[0]) @ whole.world_T_rigs
    assert np.linalg.norm(relative[:, :3, 3] - true[:, :3, 3], axis=1).max() < 0.05
    between = np.swapaxes(relative[:, :3, :3], 1, 2) @ true[:, :3, :3]
    assert np.degrees(rotation_angle(between)).max() < 1.0
    # Points went with their frames.
    tracks, solved = closed.solved.landmarks.tracks, closed.solved
    rays = bearings_of_each(solved.landmarks.points_world[tracks.points], solved, tracks)
    seen = keypoints.bearings_rig[keypoints.rows(tracks)]
    assert np.median(np.linalg.norm(rays - seen, axis=1)) < 2e-3


def test_descriptors_that_are_drawn_hold_no_others() -> None:
    drawn = _sampled_descriptors(np.eye(50, dtype=np.float32), 3, share=4, seed=0)
    assert drawn.shape == (4, 50) and drawn.base is None


def bearings_of_each(points: np.ndarray, solved: Solution, tracks: Tracks) -> np.ndarray:
    poses = solved.world_T_rigs[tracks.frames]
    return unit(np.einsum("oji,oj->oi", poses[:, :3, :3], points - poses[:, :3, 3]))


def test_a_confirmed_path_is_not_bent_further_than_it_drifts() -> None:
    """The same torn map, but every step was confirmed by images: then the loops are the error."""
    strongest, keypoints, whole = _scene()
    torn = _moved(_split(whole), pose(np.eye(3), np.array([3.0, 0, 0])))
    closed = loops.close(_context(strongest, keypoints), torn, SEEN)
    assert len(closed.pairs) == 0 and closed.solved is torn


def _loops(shift: float, count: int, support: int, last: int = NUM_FRAMES - 1) -> list[Loop]:
    """Loops between the first frames and the last, false by a shift along x of the world."""
    found = []
    for n in range(count):
        target = TRUTH[last - n].copy()
        target[0, 3] += shift
        found.append(Loop(n, last - n, inverse(TRUTH[n]) @ target, support))
    return found


def _consistent(found: list[Loop]) -> list[Loop]:
    solved = _scene()[2]
    return loops.consistent(found, solved, SETTINGS.pairs.window)


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
