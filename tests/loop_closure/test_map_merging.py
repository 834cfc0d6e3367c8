"""Parts of a torn map: joined where they meet, frames alone registered, strangers kept apart."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from two_maps import HALF, MOVE, NUM, SCALE, TRUTH, scene, scene_of, torn

from gsba.geometry import inverse, pose, rotation_angle
from gsba.loop_closure import connectivity, join_evidence, map_merging
from gsba.loop_closure.join_evidence import JoinEvidence
from gsba.loop_closure.map_similarity import Proposal
from gsba.loop_closure.merged_map import Registered, follow
from gsba.matching.absolute_pose import FoundPose
from gsba.similarity import Sim3
from gsba.trajectory import judgement
from gsba.trajectory.joining import GUESS, PLACES, SegmentAlignment
from gsba.trajectory.judgement import StepChecks
from gsba.types import CoarsePoses, Matches, PoseSource, Solution, Tracks

TIMES = np.arange(NUM, dtype=float)
NOBODY = np.zeros(NUM - 1, bool)
BREAK = np.arange(NUM - 1) == HALF - 1


def _halves(alone: tuple[int, ...] = ()) -> np.ndarray:
    """Part of each frame."""
    found = (np.arange(NUM) >= HALF).astype(int)
    for n, f in enumerate(alone, 2):
        found[f] = n
    return connectivity.by_size(found)


def _without_map(solved: Solution, alone: tuple[int, ...]) -> Solution:
    """Some frames without observations, and nowhere near where they are."""
    tracks, poses = solved.landmarks.tracks, solved.world_T_rigs.copy()
    keep = ~np.isin(tracks.frames, alone)
    kept, renumbered = np.unique(tracks.points[keep], return_inverse=True)
    own = Tracks(
        renumbered.astype(np.int32), tracks.frames[keep], tracks.keypoints[keep], len(kept)
    )
    landmarks = replace(
        solved.landmarks, points_world=solved.landmarks.points_world[kept], tracks=own
    )
    poses[list(alone)] = MOVE
    return replace(solved, world_T_rigs=poses, landmarks=landmarks)


def _errors(found: Registered, true: np.ndarray = TRUTH) -> tuple[float, float]:
    """Largest errors in map units and degrees, relative to the first frame."""
    relative = inverse(found.solved.world_T_rigs[0]) @ found.solved.world_T_rigs
    wanted = inverse(true[0]) @ true
    turned = rotation_angle(np.swapaxes(relative[:, :3, :3], 1, 2) @ wanted[:, :3, :3])
    off = np.linalg.norm(relative[:, :3, 3] - wanted[:, :3, 3], axis=1)
    return float(off.max()), float(np.degrees(turned).max())


def test_a_map_keeps_the_world_of_its_earliest_part() -> None:
    """Even where a later part is the one that the others are carried to."""
    context, whole, late = scene()
    parts = torn(whole, late, SCALE, MOVE)
    later_first = 1 - _halves()
    found = map_merging.merge(context, parts, later_first, NOBODY, ~BREAK, TIMES)
    assert not found.components.any()
    np.testing.assert_allclose(found.scales[:HALF], 1.0, rtol=1e-9)
    np.testing.assert_allclose(found.solved.world_T_rigs[:HALF], TRUTH[:HALF], atol=1e-9)
    np.testing.assert_allclose(found.scales[HALF:], 1 / SCALE, rtol=0.005)
    off, turned = _errors(found)
    assert off < 0.05 and turned < 0.5


@cache
def _joined(scale: float) -> Registered:
    """Both halves, the later one in a world and scale of its own."""
    context, whole, late = scene()
    parts = torn(whole, late, scale, MOVE)
    return map_merging.merge(context, parts, _halves(), NOBODY, ~BREAK, TIMES)


@pytest.mark.parametrize("scale", [SCALE, 0.3])
def test_two_maps_of_any_scale_are_joined_where_they_meet(scale: float) -> None:
    found = _joined(scale)
    assert not found.components.any() and found.met.all() and not found.lost.any()
    np.testing.assert_allclose(found.scales[HALF:], 1 / scale, rtol=0.005)
    off, turned = _errors(found)
    assert off < 0.02 and turned < 0.2  # of a loop 8 across; bearings have 0.02 degrees of noise
    points, whole = found.solved.landmarks.points_world, scene()[1]
    assert np.median(np.linalg.norm(points - whole.landmarks.points_world, axis=1)) < 0.02


@pytest.mark.parametrize(("tilt_deg", "joined"), [(25.0, True), (70.0, False)])
def test_a_camera_may_be_held_in_another_way_in_another_recording(
    tilt_deg: float, joined: bool
) -> None:
    truth, tilt = TRUTH.copy(), Rotation.from_euler("x", tilt_deg, degrees=True).as_matrix()
    truth[HALF:, :3, :3] = tilt @ truth[HALF:, :3, :3]  # to one side, whatever the heading
    context, whole, late = scene_of(truth)
    owners = np.arange(NUM) // HALF
    times = TIMES + 1000 * owners
    given = context, torn(whole, late, SCALE, MOVE), _halves(), NOBODY, ~BREAK, times
    found = map_merging.merge(*given, recordings=owners)
    assert found.components.any() != joined
    if joined:
        off, turned = _errors(found, truth)
        assert off < 0.02 and turned < 0.2
        assert map_merging.merge(*given).components.any()  # of one recording: held in one way


@pytest.mark.parametrize(
    ("what", "joined"),
    [("walks on", True), ("pause", False), ("turned", False), ("carried", False)],
)
def test_a_likely_join_is_taken_where_the_camera_walks_on(
    what: str, joined: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The images give some evidence that the second half is where it was, but not enough."""
    truth = TRUTH.copy()
    if what == "turned":
        about = Rotation.from_euler("y", 70, degrees=True).as_matrix()
        truth[HALF:, :3, :3] = truth[HALF:, :3, :3] @ about
    if what == "carried":  # a recording that begins elsewhere, whatever its clock says
        truth[HALF:] = np.roll(truth[HALF:], -5, axis=0)
    context, whole, late = scene_of(truth)
    likely = JoinEvidence(0.5, 0.1, 200, 0.6, 0.08)
    assert likely.likely and not likely.confirmed
    weigh = join_evidence.weigh

    def weighed(*given) -> tuple[JoinEvidence, Matches]:
        evidence, found = weigh(*given)
        return (likely if evidence.confirmed else evidence), found

    monkeypatch.setattr(join_evidence, "weigh", weighed)
    times = TIMES + (5.0 if what == "pause" else 0.0) * (np.arange(NUM) >= HALF)
    monkeypatch.setattr(map_merging, "agreed", lambda *_: None)  # no pair over the break matches
    given = torn(whole, late, SCALE, MOVE), _halves(), NOBODY, ~BREAK, times
    found = map_merging.merge(context, *given)
    assert found.components.any() != joined
    assert [reason[:12] for reason in found.reasons if reason] == ["not certain:"] * (not joined)
    if joined:
        assert _errors(found, truth)[0] < 0.02


@pytest.mark.parametrize(("seconds", "joined"), [(4.0, True), (8.0, False)])
def test_pairs_over_a_pause_join_what_the_surroundings_confirm(
    seconds: float, joined: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No other place is searched for; frames are compared over a pause that is not too long."""
    context, whole, late = scene()
    monkeypatch.setattr(map_merging._Joining, "_meetings", lambda *_: [])
    times = TIMES + seconds * (np.arange(NUM) >= HALF)
    given = torn(whole, late, SCALE, MOVE), _halves(), NOBODY, ~BREAK, times
    found = map_merging.merge(context, *given)
    assert found.components.any() != joined
    if joined:
        assert _errors(found)[0] < 0.05


def test_a_pause_is_one_among_the_intervals_of_its_recording(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Stills that lie between two videos have longer intervals than most frames."""
    context, whole, late = scene()
    monkeypatch.setattr(map_merging._Joining, "_meetings", lambda *_: [])
    owners = np.digitize(np.arange(NUM), [HALF - 6, HALF + 6])
    intervals = np.where(owners == 1, 1.0, 0.1)
    intervals[np.diff(owners, prepend=0) > 0] = 100.0
    given = torn(whole, late, SCALE, MOVE), _halves(), NOBODY, ~BREAK, np.cumsum(intervals)
    found = map_merging.merge(context, *given, recordings=owners)
    assert not found.components.any() and _errors(found)[0] < 0.05


@pytest.mark.parametrize(
    ("what", "joined"), [("walks on", True), ("missing", False), ("carried", False)]
)
def test_two_pairs_join_frames_next_to_one_another_where_the_camera_walks_on(
    what: str, joined: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames further apart show other bays, as halls do."""
    truth = TRUTH.copy()
    if what == "carried":
        truth[HALF:] = np.roll(truth[HALF:], -5, axis=0)
    context, whole, late = scene_of(truth)
    crossing, step = map_merging.crossing, TRUTH[HALF, :3, 3] - TRUTH[HALF - 1, :3, 3]

    def crossed(*given) -> list[Proposal]:
        one, two = crossing(*given)[:2]
        moved = replace(one.move, translation=one.move.translation + 3 * step)
        return [one, two, replace(one, frames=(HALF + 1, HALF - 2), move=moved)]

    likely = JoinEvidence(0.5, 0.1, 200, 0.6, 0.08)
    assert likely.likely and not likely.doubted
    weigh = join_evidence.weigh
    monkeypatch.setattr(join_evidence, "weigh", lambda *given: (likely, weigh(*given)[1]))
    monkeypatch.setattr(map_merging, "crossing", crossed)
    monkeypatch.setattr(map_merging._Joining, "_meetings", lambda *_: [])
    times = TIMES + (1.0 if what == "missing" else 0.0) * (np.arange(NUM) >= HALF)
    given = torn(whole, late, SCALE, MOVE), _halves(), NOBODY, ~BREAK, times
    assert map_merging.merge(context, *given).components.any() != joined


@pytest.mark.parametrize("num_dark", [1, 4])
def test_maps_are_joined_over_frames_that_show_nothing(
    num_dark: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Dark pictures between two maps count as missing frames."""
    context, whole, late = scene()
    monkeypatch.setattr(map_merging._Joining, "_meetings", lambda *_: [])
    monkeypatch.setattr(map_merging._Joining, "_register", lambda *_: False)
    dark = tuple(range(HALF, HALF + num_dark))
    solved = _without_map(torn(whole, late, SCALE, MOVE), dark)
    found = map_merging.merge(context, solved, _halves(dark), NOBODY, NOBODY, TIMES)
    np.testing.assert_array_equal(np.flatnonzero(found.components), dark)


@pytest.mark.parametrize("held", [False, True])
def test_a_join_a_bay_off_is_left_for_one_at_the_usual_pace(
    held: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pairs over the break agree on a step that leads back; a trajectory would know better."""
    context, whole, late = scene_of(TRUTH, np.full(NUM, 0.4))
    parts, true = torn(whole, late, SCALE, MOVE), Sim3.of(SCALE, MOVE).inverse()
    step = TRUTH[HALF, :3, 3] - TRUTH[HALF - 1, :3, 3]
    bay_off = replace(true, translation=true.translation - 1.4 * step)
    false = Proposal(bay_off, (HALF, HALF - 1), 100)
    monkeypatch.setattr(map_merging, "agreed", lambda *_: false)
    monkeypatch.setattr(map_merging._Joining, "_meetings", lambda *_: [])
    monkeypatch.setattr(map_merging._Joining, "_plausible", lambda *_: True)
    found = map_merging.merge(context, parts, _halves(), BREAK & held, ~BREAK, TIMES)
    assert not found.components.any()
    assert (_errors(found)[0] < 0.05) != held


@pytest.mark.parametrize(
    ("missing", "far", "at_pace"), [(True, False, True), (False, True, True), (False, False, False)]
)
def test_a_frame_a_bay_off_is_registered_at_the_usual_pace(
    missing: bool, far: bool, at_pace: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where frames are missing beside it or far apart; else it is where its points say."""
    context, whole, _ = scene()
    monkeypatch.setattr(judgement, "_LONG_STEP_DEPTHS", 0.01 if far else 10.0)
    whole, f = _without_map(whole, (7,)), 7
    times = TIMES + 0.55 * missing * ((f <= TIMES).astype(float) + (f < TIMES))
    step, calls = TRUTH[f, :3, 3] - TRUTH[f - 1, :3, 3], list[int]()
    resect = map_merging.resect

    def misled(*given) -> FoundPose | None:
        found = resect(*given)
        calls.append(f)
        if found is None or len(calls) > 1:
            return found
        moved = found.world_T_rig.copy()
        moved[:3, 3] -= 1.4 * step
        return replace(found, world_T_rig=moved)

    monkeypatch.setattr(map_merging, "resect", misled)
    monkeypatch.setattr(map_merging._Joining, "_shows_map", lambda *_: True)
    found = map_merging.merge(context, whole, _halves((f,)), NOBODY, NOBODY, times)
    off = _errors(found)[0]
    assert found.alone[f] and (off < 0.02) == at_pace


def test_maps_that_have_grown_are_compared_with_one_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of four parts two meet, then the first one what has grown; the last one meets none."""
    context, whole, _ = scene()
    size = NUM // 4
    own = [Sim3.of(SCALE**n, np.linalg.matrix_power(MOVE, n)) for n in range(4)]
    poses = [own[n].poses(TRUTH[n * size : (n + 1) * size]) for n in range(4)]
    torn_up, asked = replace(whole, world_T_rigs=np.concatenate(poses)), []

    def similarity(
        joining: map_merging._Joining, part: int, rows: np.ndarray, inside: np.ndarray
    ) -> Sim3 | None:
        asked.append((part, int(inside[0]), len(inside)))
        if 3 in np.append(joining.parts[inside], part):
            return None
        if 0 in np.append(joining.parts[inside], part) and len(rows) + len(inside) < 3 * size:
            return None
        old, new = (joining.moves[f].after(own[f // size]) for f in (rows[0], inside[0]))
        return new.after(old.inverse())

    monkeypatch.setattr(map_merging._Joining, "_similarity", similarity)
    parts = np.repeat(np.arange(4), size)
    found = map_merging.merge(context, torn_up, parts, NOBODY, NOBODY, TIMES)
    np.testing.assert_array_equal(found.components, parts == 3)
    assert len(set(asked)) == len(asked)  # nothing is compared twice
    start = inverse(found.solved.world_T_rigs[0]) @ found.solved.world_T_rigs[: 3 * size]
    np.testing.assert_allclose(start, inverse(TRUTH[0]) @ TRUTH[: 3 * size], atol=1e-9)
    for n in range(3):
        np.testing.assert_allclose(found.scales[n * size], SCALE**-n, rtol=1e-12)


def test_maps_beside_the_first_are_searched_for_what_looks_like_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Once around in four parts, each of which looks like the two beside it."""
    context, whole, _ = scene()
    searched = []

    def best(_: object, part: int, meetings: list, rows: np.ndarray, inside: np.ndarray) -> None:
        searched.append((part, int(inside[0])))

    monkeypatch.setattr(map_merging._Joining, "_best", best)
    monkeypatch.setattr(map_merging._Joining, "_meetings", lambda *_: [])
    monkeypatch.setattr(map_merging, "agreed", lambda *_: None)
    size = NUM // 4
    parts = np.repeat(np.arange(4), size)
    found = map_merging.merge(context, whole, parts, NOBODY, NOBODY, TIMES)
    np.testing.assert_array_equal(found.components, parts)
    assert sorted(searched) == [(1, 0), (2, 0), (2, size), (3, 0), (3, 2 * size)]


def test_strangers_stay_apart() -> None:
    context, whole, late = scene(strange=True)
    found = map_merging.merge(
        context, torn(whole, late, SCALE, MOVE), _halves(), NOBODY, ~BREAK, TIMES
    )
    np.testing.assert_array_equal(found.components, np.arange(NUM) >= HALF)
    assert found.counts.dropped == {"frames alone": 0, "apart": 1}
    # Side by side: no frame of one is as near to the other as to its own.
    positions = found.solved.world_T_rigs[:, :3, 3]
    gap = np.linalg.norm(positions[:HALF, None] - positions[None, HALF:], axis=2).min()
    assert gap > 2 * np.ptp(positions[HALF:], axis=0).max()


def test_strangers_that_the_trajectory_ties_together_stay_where_it_has_them() -> None:
    context, whole, late = scene(strange=True)
    far = torn(whole, late, 1.0, pose(np.eye(3), np.array([0.0, 40.0, 0.0])))
    held = NOBODY.copy()
    held[HALF - 1] = True
    found = map_merging.merge(context, far, _halves(), held, ~BREAK, TIMES)
    assert not found.components.any() and not found.met[HALF:].any()
    np.testing.assert_allclose(found.solved.world_T_rigs, far.world_T_rigs, atol=1e-12)


def test_what_the_trajectory_puts_into_a_place_that_looks_otherwise_is_apart() -> None:
    context, whole, _ = scene(strange=True)
    held = NOBODY.copy()
    held[HALF - 1] = True
    found = map_merging.merge(context, whole, _halves(), held, ~BREAK, TIMES)
    np.testing.assert_array_equal(found.components, np.arange(NUM) >= HALF)
    assert found.reasons[0] == "" and "contradict its pose in the trajectory" in found.reasons[1]


@pytest.mark.slow
def test_a_join_that_asks_for_more_than_drift_is_not_believed_against_the_trajectory() -> None:
    context, whole, late = scene()
    far = torn(whole, late, 1.0, pose(np.eye(3), np.array([0.0, 40.0, 0.0])))
    held = NOBODY.copy()
    held[HALF - 1] = True
    step = far.world_T_rigs[HALF, :3, 3] - far.world_T_rigs[HALF - 1, :3, 3]
    assert np.linalg.norm(step) > 40  # the trajectory vouches for a long step: as long may it err
    joined = map_merging.merge(context, far, _halves(), held, ~BREAK, TIMES)
    assert joined.met.all()
    turned = torn(whole, late, 3.0, np.eye(4))
    kept = map_merging.merge(context, turned, _halves(), held, ~BREAK, TIMES)
    assert not kept.met[HALF:].any()
    np.testing.assert_allclose(kept.solved.world_T_rigs, turned.world_T_rigs, atol=1e-12)


def test_frames_alone_are_registered_against_the_map() -> None:
    context, whole, _ = scene()
    alone = (7, 13, 14)
    whole = _without_map(whole, alone)
    found = map_merging.merge(context, whole, _halves(alone), NOBODY, NOBODY, TIMES)
    np.testing.assert_array_equal(np.flatnonzero(found.alone), alone)
    off, turned = _errors(found)
    assert off < 0.02 and turned < 0.2
    assert not found.lost.any() and not found.components.any()


def _registered_alone(
    frames: tuple[int, ...], only: int, seen: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> Registered:
    """A map and a part of some frames without points, in a world of its own, of which one can be
    registered."""
    context, whole, _ = scene()
    whole = _without_map(whole, frames)
    whole.world_T_rigs[list(frames)] = MOVE @ TRUTH[list(frames)]
    register, numbers = map_merging._Joining._register, np.arange(NUM)

    def registered(self, f: int, inside: np.ndarray) -> bool:
        return f == only and register(self, f, inside)

    monkeypatch.setattr(map_merging._Joining, "_register", registered)
    parts_of = np.isin(numbers, frames).astype(int)
    return map_merging.merge(context, whole, parts_of, NOBODY, seen, TIMES)


def test_a_frame_goes_where_the_registered_one_that_it_is_tied_to_has_moved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The first of two is registered once: again, it would no longer move."""
    found = _registered_alone((13, 14), 13, np.arange(NUM - 1) == 13, monkeypatch)
    np.testing.assert_array_equal(np.flatnonzero(found.alone), [13])
    assert not found.lost.any() and not found.components.any()
    off, turned = _errors(found)
    assert off < 0.02 and turned < 0.2
    np.testing.assert_allclose(found.moves[13], inverse(MOVE), atol=0.02)


def test_what_is_left_of_a_part_does_not_take_its_registered_frame_along(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = _registered_alone((12, 13, 14, 15), 12, NOBODY, monkeypatch)
    np.testing.assert_array_equal(np.flatnonzero(found.alone), [12])
    np.testing.assert_array_equal(np.flatnonzero(found.components), [13, 14, 15])
    poses = found.solved.world_T_rigs
    np.testing.assert_allclose(poses[12], TRUTH[12], atol=0.02)
    steps = inverse(poses[13]) @ poses[[14, 15]]
    np.testing.assert_allclose(steps, inverse(TRUTH[13]) @ TRUTH[[14, 15]], atol=1e-9)


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_two_frames_with_points_in_a_unit_of_their_own_are_registered(scale: float) -> None:
    """Points of the first one do not lead the second astray, and come to where they are."""
    context, whole, _ = scene()
    alone, tracks, places = (13, 14), whole.landmarks.tracks, whole.landmarks.points_world
    own = np.isin(tracks.frames, alone)
    first, second = (tracks.points[tracks.frames == f] for f in alone)
    shared = np.intersect1d(first, second)
    kept = ~own | np.isin(tracks.points, shared)
    points = tracks.points[kept] + len(places) * own[kept]
    order = np.lexsort((tracks.frames[kept], points))
    used, points = np.unique(points[order], return_inverse=True)
    seen = Tracks(
        points.astype(np.int32),
        tracks.frames[kept][order],
        tracks.keypoints[kept][order],
        len(used),
    )
    move = Sim3.of(scale, MOVE)
    landmarks = replace(
        whole.landmarks, points_world=np.vstack([places, move.points(places)])[used], tracks=seen
    )
    poses = TRUTH.copy()
    poses[list(alone)] = move.poses(poses[list(alone)])
    pair = replace(whole, world_T_rigs=poses, landmarks=landmarks)
    parts_of = np.isin(np.arange(NUM), alone).astype(int)
    found = map_merging.merge(context, pair, parts_of, NOBODY, NOBODY, TIMES)
    np.testing.assert_array_equal(np.flatnonzero(found.alone), alone)
    assert not found.lost.any() and max(_errors(found)) < 0.2
    np.testing.assert_allclose(found.scales[list(alone)], 1 / scale, rtol=0.005)
    off = found.solved.landmarks.points_world - places[used % len(places)]
    assert np.median(np.linalg.norm(off[used >= len(places)], axis=1)) < 0.02


def test_a_single_frame_does_not_join_two_recordings() -> None:
    """A frame is registered where its recording has frames, and nowhere else."""
    context, whole, _ = scene()
    alone = (7, 13, 30)
    whole, owners = _without_map(whole, alone), np.arange(NUM) // HALF
    times = TIMES + 1000 * owners
    parts_of = _halves(alone)
    given = context, whole, parts_of, NOBODY, NOBODY, times
    together = map_merging.merge(*given, recordings=owners)
    np.testing.assert_array_equal(np.flatnonzero(together.alone), alone)
    stranger = np.where(np.arange(NUM) == 30, 2, owners)  # the only frame of a third recording
    found = map_merging.merge(*given, recordings=stranger)
    np.testing.assert_array_equal(np.flatnonzero(found.alone), (7, 13))
    np.testing.assert_array_equal(np.flatnonzero(found.lost), [30])
    np.testing.assert_array_equal(found.components, np.arange(NUM) == 30)


def test_a_frame_of_elsewhere_stays_where_its_steps_have_it_or_is_not_registered() -> None:
    context, whole, _ = scene(strange=True)
    parts_of = (np.arange(NUM) == 30).astype(int)
    given = context, _without_map(whole, tuple(range(HALF, NUM))), parts_of, NOBODY
    found = map_merging.merge(*given, NOBODY, TIMES)
    np.testing.assert_array_equal(np.flatnonzero(found.lost), [30])
    np.testing.assert_array_equal(found.components, parts_of)  # apart: a guess is not exported
    assert not found.alone.any() and found.counts.dropped == {"frames alone": 1, "apart": 0}
    pair = context, given[1], np.isin(np.arange(NUM), (30, 31)).astype(int), NOBODY
    counts = map_merging.merge(*pair, NOBODY, TIMES).counts
    assert (counts.received, counts.kept) == (1, 0)  # a part is one, whatever its frames
    by_steps = map_merging.merge(*given, ~NOBODY, TIMES)
    assert not by_steps.lost.any() and not by_steps.components.any()


def _trust(poses: np.ndarray, unseen: np.ndarray) -> StepChecks:
    nobody = np.zeros(NUM, bool)
    return StepChecks(poses, unseen.copy(), nobody, unseen, np.ones(NUM - 1), None)


def test_a_piece_of_the_trajectory_goes_where_its_frames_were_carried() -> None:
    _, whole, late = scene()
    parts = torn(whole, late, SCALE, MOVE)
    unseen = NOBODY.copy()
    unseen[HALF - 1] = True
    segments = (np.arange(NUM) >= HALF).astype(np.int32)
    slam = np.full(NUM, PoseSource.SLAM, np.uint8)
    coarse = CoarsePoses(parts.world_T_rigs, slam, 0.0, segments)
    joints = (SegmentAlignment(HALF, NUM - 1, 2.0, MOVE, GUESS),)
    found = _joined(SCALE)
    moved, trust, joints = follow(found, coarse, _trust(parts.world_T_rigs, unseen), joints)
    np.testing.assert_allclose(moved.world_T_rigs, found.solved.world_T_rigs, atol=1e-9)
    assert joints[0].how == PLACES and trust.false_steps[HALF - 1]
    # What the piece's own poses were before the guess now lies where the map has them.
    own = Sim3.of(1.0, np.eye(4)).poses(MOVE[None])  # any pose will do
    again = Sim3.of(found.scales[-1], found.moves[-1]).poses(Sim3.of(2.0, MOVE).poses(own))
    joined = Sim3.of(joints[0].scale, joints[0].world_T_own).poses(own)
    np.testing.assert_allclose(joined, again, atol=1e-9)
