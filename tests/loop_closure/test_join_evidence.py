"""What the surroundings say of joins: of true ones, of look-alikes, and of places out of sight."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from two_maps import HALF, NUM, TRUTH, scene, scene_of

from gsba.geometry import pose
from gsba.loop_closure import join_evidence
from gsba.loop_closure.join_evidence import FindingRates, JoinEvidence, Places, around
from gsba.loop_closure.join_test import JoinTest
from gsba.loop_closure.map_similarity import Proposal
from gsba.matching.guided_search import MatchContext
from gsba.similarity import Sim3

PARTS = (np.arange(NUM) >= HALF).astype(int)
ENDS = np.arange(6), np.arange(NUM - 6, NUM)  # of a walk around: they see the same place


def _places(strange: bool = False) -> tuple[MatchContext, Places, float]:
    context, solved, _ = scene(strange)
    known = solved.points_by_keypoint(context.keypoints)
    places = Places(TRUTH, [known[f] for f in range(NUM)])
    return context, places, solved.median_depth()


def _weighed(move: np.ndarray, strange: bool = False) -> JoinEvidence:
    """Of both ends, the last frames carried off."""
    context, places, depth = _places(strange)
    usual = join_evidence.rates(context, places, PARTS)
    poses = places.world_T_rigs.copy()
    poses[HALF:] = move @ poses[HALF:]
    moved = replace(places, world_T_rigs=poses)
    return join_evidence.weigh(context, moved, ENDS, usual, depth)[0]


def test_points_are_found_again_within_parts_and_hardly_by_chance() -> None:
    context, places, _ = _places()
    usual = join_evidence.rates(context, places, PARTS)
    assert np.median(usual.within) > 0.6 and usual.chance < 0.02


def test_a_true_join_is_confirmed() -> None:
    found = _weighed(np.eye(4))
    assert found.confirmed and not found.refuted and found.share > 0.8


def test_a_place_that_looks_otherwise_is_refuted() -> None:
    found = _weighed(np.eye(4), strange=True)
    assert found.refuted and found.share < 0.1 and not found.confirmed


@pytest.mark.parametrize("degrees", [20.0, 90.0, 180.0])
def test_a_false_join_is_refuted(degrees: float) -> None:
    centre = TRUTH[0, :3, 3]
    turn = Rotation.from_rotvec([0, np.deg2rad(degrees), 0]).as_matrix()
    found = _weighed(pose(turn, centre - turn @ centre))
    assert found.refuted and _weighed(np.eye(4)).beats(found)


@pytest.mark.parametrize(
    ("corners", "textures", "confirmed"),
    [(4, 4, True), (4, 1, False), (1, 4, False), (1, 1, False)],
)
def test_corners_and_what_covers_walls_must_both_be_found_again(
    corners: int, textures: int, confirmed: bool
) -> None:
    """Flats of one plan share corners, each in a cell of its own, and a picture may hang twice.

    4 of 10 points are found within parts, 1 of 10 by chance. Corners: 400 cells of 10 points in 50
    regions. Textures: 20 cells of 1,000 points in 20 other regions.
    """
    depth = 4.0  # cells of 1, regions of 4
    places = np.stack(np.unravel_index(np.arange(3200), (200, 4, 4)), axis=1)
    places = places[places[:, 0] % 4 < 2][::4][:400]
    pictures = 4 * np.stack([np.arange(60, 80), np.zeros(20), np.zeros(20)], axis=1)
    cells = np.concatenate([np.repeat(places, 10, axis=0), np.repeat(pictures, 1000, axis=0)])
    tenths = np.where(np.arange(len(cells)) < 4000, corners, textures)
    off = np.where(np.arange(len(cells)) % 10 < tenths, 0.0, np.nan)
    seen = join_evidence.Predictions(cells + 0.5, np.zeros(len(cells), np.int64), off)
    usual = join_evidence.FindingRates(np.full(24, 0.4), 0.1, np.full(24, 0.4))
    assert join_evidence.evidence_of(seen, usual, depth).confirmed == confirmed


CELLS = np.repeat(np.stack(np.unravel_index(np.arange(4000), (100, 40, 1)), axis=1), 5, axis=0)


def _of_cells(off: np.ndarray) -> JoinEvidence:
    """Evidence of a point in each of `CELLS`, found `off` radians from its place or not at all;
    within parts, 4 of 10 are found."""
    seen = join_evidence.Predictions(CELLS + 0.5, np.zeros(len(CELLS), np.int64), off)
    usual = join_evidence.FindingRates(np.full(24, 0.4), 0.0, np.full(24, 0.4))
    return join_evidence.evidence_of(seen, usual, 4.0)


@pytest.mark.parametrize(("at_place", "joined"), [(1.0, True), (0.7, True), (0.4, False)])
def test_what_matches_beside_its_place_does_not_join_recordings(
    at_place: float, joined: bool, rng: np.random.Generator
) -> None:
    """All is found that is found within parts, some of it at its place, the rest by chance."""
    anywhere = np.deg2rad(4.0) * np.sqrt(rng.uniform(size=len(CELLS)))  # even over a disc
    off = np.where(rng.uniform(size=len(CELLS)) < at_place, np.deg2rad(0.3), anywhere)
    off[rng.uniform(size=len(CELLS)) > 0.4] = np.nan
    found = _of_cells(off)
    assert abs(found.placed - at_place) < 0.05
    assert found.share > 0.95 and found.confirmed == joined


@pytest.mark.parametrize(("strange", "joined"), [(0.0, True), (0.1, True), (0.33, False)])
def test_an_exact_copy_of_a_place_shows_nothing_in_some_regions(
    strange: float, joined: bool, rng: np.random.Generator
) -> None:
    """All that is found is at its place, but in some regions nothing is."""
    off = np.where(rng.uniform(size=len(CELLS)) < 0.4, np.deg2rad(0.3), np.nan)
    off[CELLS[:, 0] < 100 * strange] = np.nan
    found = _of_cells(off)
    assert abs(found.strange - strange) < 0.05 and found.margin() > 0.05
    assert found.confirmed == found.likely == joined


def test_points_are_expected_as_often_as_the_recordings_that_meet_find_them() -> None:
    """A third recording, in a room that shows all of its points again, says nothing of theirs."""
    owners = np.digitize(np.arange(NUM), [10, 30])  # both ends, and the third between them
    context, solved, _ = scene_of(TRUTH, np.where(owners == 1, 1.0, 0.4))
    points, depth = solved.points_by_keypoint(context.keypoints), solved.median_depth()
    known = [points[f] for f in range(NUM)]
    measured = []

    def rates(chosen: np.ndarray) -> FindingRates:
        measured.append(np.unique(owners[chosen]).tolist())
        return join_evidence.rates(context, Places(TRUTH, known), owners, chosen=chosen)

    three = JoinTest(context, TRUTH, known, depth, owners, rates)
    found, again = (three.weigh(*ENDS, Sim3())[0] for _ in range(2))
    assert measured == [[0, 2]] and again == found
    one = JoinTest(context, TRUTH, known, depth, np.zeros_like(owners), rates)
    by_all = one.weigh(*ENDS, Sim3())[0]
    assert measured[1:] == [[0, 1, 2]] and by_all.margin() < found.margin() - 0.05
    assert found.confirmed
    turned = Rotation.from_rotvec([0, np.deg2rad(90), 0]).as_matrix()
    centre = TRUTH[-1, :3, 3]
    away = Sim3.of(1.0, pose(turned, centre - turned @ centre))
    assert three.weigh(ENDS[1], ENDS[0], away)[0].refuted


def test_what_leads_to_a_confirmed_place_is_not_tested_to_its_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    context, places, depth = _places()
    owners = np.zeros(NUM, int)
    usual = join_evidence.rates(context, places, PARTS)
    test = JoinTest(context, TRUTH, places.known, depth, owners, lambda _: usual)
    tests, weigh = [], JoinTest.weigh
    monkeypatch.setattr(JoinTest, "weigh", lambda *given: tests.append(0) or weigh(*given))

    def moved(shift: float) -> Proposal:
        frames = int(ENDS[1][0]), int(ENDS[0][0])
        return Proposal(Sim3.of(1.0, pose(np.eye(3), np.array([shift, 0, 0]) * depth)), frames, 9)

    first = test.judge(moved(0.03), *ENDS[::-1], [])
    assert first is not None and first.evidence.confirmed
    off = first.proposal.move.points(np.zeros((1, 3))) / depth
    assert np.linalg.norm(off) < 0.01  # refined until it settles
    once = len(tests)
    assert test.judge(moved(0.03), *ENDS[::-1], []) is first and len(tests) == once
    assert test.judge(moved(-0.03), *ENDS[::-1], [first]) is None and len(tests) == once + 1


def test_places_out_of_sight_say_nothing() -> None:
    found = _weighed(pose(np.eye(3), np.array([0.0, 40.0, 0.0])))
    assert found.witnesses == 0
    assert not (found.confirmed or found.refuted or found.absent)
    assert "no frames of the two maps overlap" in str(found)


def test_frames_around_one_are_of_its_group() -> None:
    frames = np.array([2, 3, 5, *range(10, 60)])
    assert around(frames, 5).tolist() == frames[:15].tolist()
    assert around(frames, 58).tolist() == frames[-14:].tolist()
