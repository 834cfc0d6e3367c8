"""Guided matching: what the gate lets in, what it keeps out, and each keypoint once."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import bearings_of, features_of, unit, with_noise

from gsba.features.detection import ExtractorTraits
from gsba.geometry import pose
from gsba.matching import guided_search
from gsba.matching.guided_search import Gate, SearchableFrames, match_pair, searchable, within_gate
from gsba.store.shards import Threads
from gsba.types import Features

NUM = 400
F0_T_F1 = pose(Rotation.from_rotvec([0.05, 0.3, -0.02]).as_matrix(), np.array([0.4, 0.05, 0.6]))
BAND = Gate(np.deg2rad(0.5), 0.01, np.deg2rad(80))
POINT = Gate(np.pi, 1.0, np.pi, np.deg2rad(0.5))
TRAITS = ExtractorTraits(min_similarity=0.8, max_ratio=0.9)


class Scene:
    """Points with random descriptors seen from both frames, keypoints of frame 1 shuffled."""

    def __init__(self, seed: int = 0, noise_rad: float = 3e-4) -> None:
        rng = np.random.default_rng(seed)
        self.points = rng.uniform(2, 8, (NUM, 1)) * unit(rng.normal(size=(NUM, 3)))
        self.descriptors = (200 * rng.random((NUM, 64)) ** 4).astype(np.uint8)  # cosines ~ 0.4
        self.shuffle = rng.permutation(NUM)  # keypoint in frame 1 -> point
        self.bearings0 = with_noise(bearings_of(self.points, np.eye(4)), noise_rad, rng)
        seen = bearings_of(self.points[self.shuffle], F0_T_F1)
        self.bearings1 = with_noise(seen, noise_rad, rng)
        self.rng = rng

    def first(self) -> Features:
        noise = np.random.default_rng(9).integers(0, 10, self.descriptors.shape)
        return features_of(self.bearings0, (self.descriptors + noise).astype(np.uint8))

    def second(self, extra: np.ndarray | None = None, like: np.ndarray | None = None) -> Features:
        """Frame 1, behind its own keypoints copies of points `like` at bearings `extra`."""
        bearings, descriptors = self.bearings1, self.descriptors[self.shuffle]
        if extra is not None and like is not None:
            bearings = np.concatenate([bearings, extra])
            descriptors = np.concatenate([descriptors, self.descriptors[like]])
        return features_of(bearings, descriptors)

    def correct(self, matches: np.ndarray) -> np.ndarray:
        second = np.append(self.shuffle, np.full(NUM, -1))[matches[:, 1]]
        return matches[:, 0] == second


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


def _match(
    first: Features,
    second: Features,
    gate: Gate = BAND,
    points_f0: np.ndarray | None = None,
    f0_T_f1: np.ndarray = F0_T_F1,
    traits: ExtractorTraits = TRAITS,
) -> np.ndarray:
    return match_pair(searchable(first), searchable(second), f0_T_f1, gate, traits, points_f0)


def test_true_matches_pass(scene: Scene) -> None:
    found = _match(scene.first(), scene.second())
    assert scene.correct(found).all()
    assert len(found) == NUM  # 0.5 degrees of slack is 29 sigmas


def test_the_length_of_the_baseline_is_unused(scene: Scene) -> None:
    longer = F0_T_F1.copy()
    longer[:3, 3] *= 7
    found = _match(scene.first(), scene.second(), f0_T_f1=longer)
    np.testing.assert_array_equal(found, _match(scene.first(), scene.second()))


def test_the_gate_is_as_wide_as_it_says(scene: Scene) -> None:
    """A prediction turned about the direction of motion moves points off their circles."""
    direction = F0_T_F1[:3, 3] / np.linalg.norm(F0_T_F1[:3, 3])
    turned = F0_T_F1.copy()
    turned[:3, :3] = Rotation.from_rotvec(np.deg2rad(2) * direction).as_matrix() @ turned[:3, :3]
    assert len(_match(scene.first(), scene.second(), f0_T_f1=turned)) < 0.35 * NUM
    wide = Gate(np.deg2rad(2.2), 0.01, np.deg2rad(80))
    found = _match(scene.first(), scene.second(), wide, f0_T_f1=turned)
    assert len(found) == NUM and scene.correct(found).all()


@pytest.mark.parametrize("gate", [BAND, POINT])
def test_other_matchers_pass_the_same_gate(scene: Scene, gate: Gate) -> None:
    """What guided search finds among true matches is what `within_gate` lets through."""
    turned = F0_T_F1.copy()
    turn = np.deg2rad(0.9) * F0_T_F1[:3, 3] / np.linalg.norm(F0_T_F1[:3, 3])
    turned[:3, :3] = Rotation.from_rotvec(turn).as_matrix() @ turned[:3, :3]
    points = scene.points if gate is POINT else None
    first, second = scene.first(), scene.second()
    true = np.column_stack([np.arange(NUM), np.argsort(scene.shuffle)])
    inside = within_gate(true, first, second, turned, gate, points)
    assert 0.1 * NUM < inside.sum() < 0.9 * NUM
    found = _match(first, second, gate, points, turned)
    np.testing.assert_array_equal(found[scene.correct(found)], true[inside])


def test_uncertain_directions_widen_the_gate_with_parallax(scene: Scene) -> None:
    wrong = F0_T_F1.copy()
    wrong[:3, 3] = Rotation.from_rotvec([0, 0.3, 0]).apply(wrong[:3, 3])
    assert len(_match(scene.first(), scene.second(), f0_T_f1=wrong)) < 0.5 * NUM
    wide = Gate(BAND.rotation_rad, np.tan(0.4), np.pi / 2)
    found = _match(scene.first(), scene.second(), wide, f0_T_f1=wrong)
    assert scene.correct(found).all()
    # Towards the motion a wrong direction turns the planes of points most.
    aside = np.linalg.norm(np.cross(unit(scene.points), unit(F0_T_F1[:3, 3])), axis=1) > 0.1
    assert aside.sum() > 0.9 * NUM and set(np.flatnonzero(aside)) <= set(found[:, 0])


def _across(scene: Scene, rows: np.ndarray, angle: float) -> np.ndarray:
    """Bearings in frame 1 of points moved off their great circles by `angle`."""
    rotated = bearings_of(scene.points[rows], F0_T_F1) @ F0_T_F1[:3, :3].T
    normals = unit(np.cross(F0_T_F1[:3, 3], rotated))
    return unit(rotated + np.tan(angle) * normals) @ F0_T_F1[:3, :3]


def _along(scene: Scene, rows: np.ndarray, depth_factor: float) -> np.ndarray:
    """Bearings in frame 1 of points moved along their rays in frame 0: on the great circle."""
    return bearings_of(depth_factor * scene.points[rows], F0_T_F1)


def test_a_perfect_copy_outside_the_band_is_no_rival(scene: Scene) -> None:
    """Repeated structure: the same descriptor 4 degrees off the epipolar line. It neither wins
    nor makes its original fail the ratio test, as both do where the gate lets it in."""
    rows = np.arange(0, NUM, 4)
    second = scene.second(_across(scene, rows, np.deg2rad(4)), rows)
    found = _match(scene.first(), second)
    assert len(found) == NUM and scene.correct(found).all()
    blind = _match(scene.first(), second, Gate(np.deg2rad(10), 1.0, np.pi))
    assert not np.isin(rows, blind[scene.correct(blind), 0]).any()


def test_a_copy_that_would_lie_behind_is_no_rival() -> None:
    """On the great circle, but moved towards the direction of motion."""
    scene = Scene(1)
    rotated = scene.bearings0[:40]
    toward = unit(rotated + 0.3 * F0_T_F1[:3, 3]) @ F0_T_F1[:3, :3]
    found = _match(scene.first(), scene.second(toward, np.arange(40)))
    assert scene.correct(found).all()
    # Near the direction of motion itself the copy is within the gate's slack.
    assert np.isin(np.arange(40), found[:, 0]).sum() > 30


def test_parallax_is_bounded() -> None:
    scene = Scene(2)
    rows = np.arange(60)
    parallax = np.arccos(
        np.einsum(
            "ij,ij->i", unit(scene.points), bearings_of(scene.points, F0_T_F1) @ F0_T_F1[:3, :3].T
        )
    )
    small = Gate(BAND.rotation_rad, BAND.direction, np.deg2rad(5))
    found = _match(scene.first(), scene.second(), small)
    # The bound is softened by the rotation's uncertainty.
    assert (parallax[found[:, 0]] < np.deg2rad(5.6)).all()
    assert set(np.flatnonzero(parallax < np.deg2rad(4.9))) <= set(found[:, 0])
    assert len(rows) < NUM


def test_known_points_keep_out_copies_on_the_epipolar_line() -> None:
    """A copy further along the same line: only a known depth can tell them apart."""
    scene = Scene(3)
    rows = np.arange(0, NUM, 4)
    copies = _along(scene, rows, 3.0)
    apart = np.linalg.norm(copies - bearings_of(scene.points[rows], F0_T_F1), axis=1)
    rows, copies = rows[apart > np.deg2rad(1.5)], copies[apart > np.deg2rad(1.5)]
    assert len(rows) > 50
    second = scene.second(copies, rows)
    band = _match(scene.first(), second)
    assert not np.isin(rows, band[scene.correct(band), 0]).any()
    found = _match(scene.first(), second, POINT, scene.points)
    assert len(found) == NUM and scene.correct(found).all()


def test_known_points_alone_are_matched(scene: Scene) -> None:
    points = scene.points.copy()
    points[::2] = np.nan
    found = _match(scene.first(), scene.second(), POINT, points)
    assert (found[:, 0] % 2 == 1).all() and len(found) == NUM // 2


def test_a_wrong_depth_finds_nothing(scene: Scene) -> None:
    moved = bearings_of(0.5 * scene.points, F0_T_F1) - bearings_of(scene.points, F0_T_F1)
    far = np.linalg.norm(moved, axis=1) > np.deg2rad(1)
    found = _match(scene.first(), scene.second(), POINT, 0.5 * scene.points)
    assert not far[found[:, 0]].any() and far.sum() > NUM // 2


@pytest.mark.parametrize(("sides", "change"), [((0,), 3), ((1,), 3), ((0, 1), 30)])
def test_two_orientations_of_one_place_count_once(sides: tuple[int, ...], change: int) -> None:
    """The second orientation is neither a rival in the ratio test, however alike, nor, where both
    frames have it, a second match."""
    scene = Scene(4)
    views = [scene.first(), scene.second()]
    for side in sides:
        twice = np.repeat(np.arange(NUM), 2)
        descriptors = views[side].descriptors[twice].astype(int)
        descriptors[1::2, :32] = np.maximum(descriptors[1::2, :32] - change, 0)
        bearings = views[side].bearings_rig[twice]
        views[side] = features_of(bearings, descriptors.astype(np.uint8))
    matches = _match(*views)
    assert len(matches) == NUM
    assert all(len(np.unique(column)) == NUM for column in matches.T)
    for side in sides:
        matches[:, side] //= 2
    assert scene.correct(matches).all()
    assert all(len(np.unique(column)) == NUM for column in matches.T)


@pytest.mark.parametrize(("apart_deg", "expected"), [(0.1, 1), (0.4, 0)])
def test_rivals_at_one_place_are_none(apart_deg: float, expected: int) -> None:
    """One feature found twice at two scales, a pixel apart."""
    angle = np.deg2rad(apart_deg)
    bearings = np.array([[0.0, 0, 1], [np.sin(angle), 0, np.cos(angle)]])
    descriptors = np.array([[100, 100, 100, 0], [100, 100, 98, 0]], np.uint8)
    one = features_of(bearings[:1], np.array([[100, 100, 99, 0]], np.uint8))
    two = features_of(bearings, descriptors)
    for first, second in ((one, two), (two, one)):
        found = _match(first, second, Gate(np.pi, 1.0, np.pi), f0_T_f1=np.eye(4))
        assert len(found) == expected


def test_matches_are_one_to_one_and_mutual() -> None:
    """Two keypoints of frame 0, far apart, look like one of frame 1: the better one has it."""
    bearings = unit(np.array([[0.0, 0, 1], [0.3, 0, 1]]))
    descriptors = np.array([[100, 100, 100, 0], [100, 100, 96, 30]], np.uint8)
    first = features_of(bearings, descriptors)
    second = features_of(bearings[:1], descriptors[:1])
    everything = Gate(np.pi, 1.0, np.pi)
    loose = ExtractorTraits(max_ratio=1.0, min_similarity=0.0)
    for f0, f1 in ((first, second), (second, first)):
        found = _match(f0, f1, everything, f0_T_f1=np.eye(4), traits=loose)
        np.testing.assert_array_equal(found, [[0, 0]])


def test_an_unrequited_match_is_none() -> None:
    """0 likes 0, but 0 likes 1 and 1 likes 1: only the last is mutual."""
    bearings = unit(np.array([[0.0, 0, 1], [0.3, 0, 1]]))
    first = features_of(bearings, _directions(0.0, 0.35))
    second = features_of(bearings, _directions(0.2, 0.36))
    loose = ExtractorTraits(max_ratio=1.0, min_similarity=0.0)
    found = _match(first, second, Gate(np.pi, 1.0, np.pi), f0_T_f1=np.eye(4), traits=loose)
    np.testing.assert_array_equal(found, [[1, 1]])


def _directions(*angles: float) -> np.ndarray:
    """Unit descriptors (N, 3) float32 in a plane."""
    return np.array([[np.cos(a), np.sin(a), 0] for a in angles], np.float32)


@pytest.mark.parametrize("ratio", [0.9, 0.5])
def test_ratio_and_similarity_are_those_of_the_descriptors(ratio: float) -> None:
    """Against unit descriptors at known angles: distances 2 sin(angle / 2)."""
    bearings = unit(np.array([[0.0, 0, 1], [0.3, 0, 1]]))
    everything = Gate(np.pi, 1.0, np.pi)
    first = features_of(bearings[:1], _directions(0.0))
    best = 0.2
    for rival, expected in ((ratio * 1.03, 1), (ratio * 0.97, 0)):
        other = 2 * np.arcsin(np.sin(best / 2) / ratio * (rival / ratio))
        second = features_of(bearings, _directions(best, -other))
        traits = ExtractorTraits(max_ratio=ratio, min_similarity=0.5)
        found = _match(first, second, everything, f0_T_f1=np.eye(4), traits=traits)
        assert len(found) == expected
    alone = features_of(bearings[:1], _directions(best))
    for similarity, expected in ((np.cos(best) - 0.01, 1), (np.cos(best) + 0.01, 0)):
        traits = ExtractorTraits(min_similarity=similarity, max_ratio=0.9)
        found = _match(first, alone, everything, f0_T_f1=np.eye(4), traits=traits)
        assert len(found) == expected


def test_a_standing_camera_is_matched_by_rotation_alone() -> None:
    scene = Scene(5)
    turn = pose(F0_T_F1[:3, :3], np.zeros(3))
    second = features_of(scene.bearings0 @ turn[:3, :3], scene.descriptors)
    found = _match(scene.first(), second, f0_T_f1=turn)
    assert len(found) == NUM and (found[:, 0] == found[:, 1]).all()


@pytest.mark.parametrize("points", [False, True])
def test_empty_frames_match_nothing(points: bool) -> None:
    full = Scene().first()
    empty = features_of(np.zeros((0, 3)), np.zeros((0, 64), np.uint8))
    for first, second in ((empty, full), (full, empty), (empty, empty)):
        known = np.ones((len(first), 3)) if points else None
        found = _match(first, second, POINT if points else BAND, known)
        assert found.shape == (0, 2) and found.dtype == np.int32


def test_pairs_are_matched_in_order_whatever_the_threads(scene: Scene) -> None:
    frames = [scene.first(), scene.second(), scene.first()]
    world_T_rigs = np.stack([np.eye(4), F0_T_F1, np.eye(4)])
    pairs = np.array([[0, 1], [1, 2], [0, 2]])
    single, threaded = (
        guided_search.match(
            pairs,
            world_T_rigs,
            [BAND] * 3,
            SearchableFrames(_reader(frames)),
            TRAITS,
            Threads(threads),
        )
        for threads in (1, 3)
    )
    np.testing.assert_array_equal(single.offsets, [0, NUM, 2 * NUM, 3 * NUM])
    np.testing.assert_array_equal(single.keypoints, threaded.keypoints)
    np.testing.assert_array_equal(single.of(1)[:, ::-1][single.of(1)[:, 1].argsort()], single.of(0))
    np.testing.assert_array_equal(single.pairs, pairs)


def test_no_pairs_are_no_error(scene: Scene) -> None:
    none = np.zeros((0, 2), np.int32)
    frames = SearchableFrames(_reader([scene.first()]))
    found = guided_search.match(none, np.eye(4)[None], [], frames, TRAITS, Threads(2))
    assert found.keypoints.shape == (0, 2) and found.pairs.shape == (0, 2)


def test_frames_are_read_once_while_they_fit(scene: Scene) -> None:
    reads: list[int] = []

    def load(frame: int) -> Features:
        reads.append(frame)
        return scene.first()

    frames = SearchableFrames(load, capacity=2)
    assert reads == [0]  # for the axes of descriptors
    for frame in (0, 1, 0, 1, 2, 1, 0):
        frames[frame]
    assert reads[1:] == [0, 1, 2, 0]


def test_a_frame_being_read_holds_up_no_other(scene: Scene) -> None:
    """Each of two reads waits until the other has begun."""
    meeting = Barrier(2, timeout=60)

    def load(frame: int) -> Features:
        if frame:
            meeting.wait()
        return scene.first()

    frames = SearchableFrames(load)
    with ThreadPoolExecutor(3) as pool:
        found = list(pool.map(frames.__getitem__, (1, 2, 1)))  # one frame is read once for both
    assert found[0] is found[2] and found[0] is not found[1]


def _reader(frames: list[Features]) -> Callable[[int], Features]:
    return lambda frame: frames[frame]


def test_some_frames_need_no_other(scene: Scene) -> None:
    """What workers elsewhere get does not read frame 0 again, even where that is blank."""
    blank = features_of(np.zeros((0, 3)), scene.descriptors[:0])
    every = [blank, scene.first(), scene.second()]
    frames = SearchableFrames(_reader(every))
    reads: list[int] = []

    def load(frame: int) -> Features:
        reads.append(frame)
        return every[frame]

    some = SearchableFrames(load, axes=frames._axes).taken([1, 2])
    np.testing.assert_array_equal(some[1].descriptors, frames[1].descriptors)
    assert reads == [1]
