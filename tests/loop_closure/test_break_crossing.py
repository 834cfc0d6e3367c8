"""Pieces on either side of a short break: joined where several pairs of frames agree, else not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from two_maps import HALF, MOVE, NUM, SCALE, TRUTH, scene, torn

from gsba.geometry import inverse
from gsba.loop_closure.break_crossing import MIN_AGREEING, agreed, continues, crossing
from gsba.loop_closure.map_similarity import Proposal
from gsba.matching import recovery
from gsba.similarity import Sim3
from gsba.types import Solution

OUTSIDE = np.arange(HALF, NUM)
CHOSEN = np.array([(HALF - 1, HALF), (HALF - 2, HALF), (HALF - 1, HALF + 1), (HALF - 2, HALF + 1)])


def _proposals(stretch: float = 1.0) -> tuple[list[Proposal], Solution]:
    """Of pairs over the break, points of the second map `stretch` times as far as they are."""
    context, whole, late = scene()
    parts = torn(whole, late, SCALE, MOVE)
    by_keypoint = parts.points_by_keypoint(context.keypoints)
    known = [(stretch if f >= HALF else 1.0) * by_keypoint[f] for f in range(NUM)]
    pairs = recovery.match_anywhere(context, CHOSEN)
    return crossing(pairs, context.keypoints, parts.world_T_rigs, known, OUTSIDE), parts


def test_each_pair_over_a_break_says_how_the_maps_lie() -> None:
    proposals, parts = _proposals()
    assert len(proposals) == len(CHOSEN)
    for one in proposals:
        assert one.move.scale == pytest.approx(1 / SCALE, rel=0.03)
        moved = one.move.poses(parts.world_T_rigs[HALF])
        assert np.linalg.norm(moved[:3, 3] - TRUTH[HALF, :3, 3]) < 0.05
    best = agreed(proposals, parts.world_T_rigs, parts.median_depth())
    assert best is not None and best.move.scale == pytest.approx(1 / SCALE, rel=0.03)


def test_the_scale_comes_from_the_points_that_both_maps_know() -> None:
    """A second map of which everything is 30 % too far says so."""
    scales = [one.move.scale for one in _proposals(1.3)[0]]
    np.testing.assert_allclose(scales, 1 / SCALE / 1.3, rtol=0.03)


def test_a_map_that_knows_nothing_of_what_both_see_joins_nowhere() -> None:
    assert not _proposals(np.nan)[0]


def test_too_few_pairs_or_none_that_agree_join_nothing() -> None:
    proposals, parts = _proposals()
    given = parts.world_T_rigs, parts.median_depth()
    assert agreed([], *given) is None
    assert agreed(proposals[: MIN_AGREEING - 1], *given) is None

    def scaled(one: Proposal, factor: float) -> Proposal:
        move = Sim3(factor * one.move.scale, one.move.rotation, one.move.translation)
        return replace(one, move=move)

    apart = [scaled(one, 1.3**n) for n, one in enumerate(proposals)]
    assert agreed(apart, *given) is None


@pytest.mark.parametrize(
    ("shift", "turn_deg", "expected"),
    [(0.0, 0, True), (0.0, 50, True), (0.0, 90, False), (4.0, 0, False)],
)
def test_a_part_follows_a_map_only_as_a_camera_walks_on(
    shift: float, turn_deg: float, expected: bool
) -> None:
    step = np.linalg.norm(TRUTH[HALF, :3, 3] - TRUTH[HALF - 1, :3, 3])
    turn = Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
    first = TRUTH[HALF]
    moved = first.copy()
    moved[:3, :3] = first[:3, :3] @ turn
    moved[0, 3] += shift * step
    move = Sim3.of(1.0, moved @ inverse(first))
    inside, times = np.arange(HALF), np.arange(NUM, dtype=float)
    assert continues(move, [(HALF, HALF - 1)], inside, TRUTH, times) == expected
    # Reversed in time, the same.
    backward = TRUTH[::-1], np.arange(NUM, dtype=float)
    after = NUM - 1 - HALF
    assert continues(move, [(after, after + 1)], NUM - 1 - inside[::-1], *backward) == expected


def test_a_part_follows_nothing_without_a_break_or_steps_of_the_map() -> None:
    times = np.arange(NUM, dtype=float)
    assert not continues(Sim3(), [], np.arange(HALF), TRUTH, times)
    assert not continues(Sim3(), [(HALF, HALF - 1)], np.array([0, HALF - 1]), TRUTH, times)
