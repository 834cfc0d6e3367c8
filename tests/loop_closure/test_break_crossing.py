"""Pieces on either side of a short break: joined where several pairs of frames agree, else not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from two_maps import HALF, MOVE, NUM, SCALE, TRUTH, scene, torn

from gsba.geometry import inverse
from gsba.loop_closure.break_crossing import MIN_AGREEING, Breaks, agreed, crossing
from gsba.loop_closure.map_similarity import Proposal
from gsba.matching import recovery
from gsba.similarity import Sim3
from gsba.types import Solution

OUTSIDE = np.arange(HALF, NUM)
CHOSEN = np.array([(HALF - 1, HALF), (HALF - 2, HALF), (HALF - 1, HALF + 1), (HALF - 2, HALF + 1)])


def _moved_by(move: Sim3, units: float) -> Sim3:
    return replace(move, translation=move.translation + np.array([units, 0, 0]))


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


def test_one_more_pair_suffices_beside_frames_next_to_one_another() -> None:
    """Half of the pairs show another bay of a hall."""
    proposals, parts = _proposals()
    given = parts.world_T_rigs, parts.median_depth()
    near, other = ((HALF, HALF - 1), (HALF, HALF - 2))
    one, two = (next(p for p in proposals if p.frames == frames) for frames in (near, other))
    bay = replace(one, frames=(HALF + 1, HALF - 2), move=_moved_by(one.move, 1.0))
    assert agreed([one, two, bay], *given, near) is one
    assert agreed([one, two, bay], *given) is None
    assert agreed([one, two, bay], *given, (HALF + 1, HALF - 1)) is None
    assert agreed([one, bay], *given, near) is None
    assert (
        agreed([one, two, bay, replace(bay, move=_moved_by(one.move, 2.0))], *given, near) is None
    )


BEFORE, TIMES = np.arange(HALF), np.arange(NUM, dtype=float)


def _carried(paces: float, turn_deg: float = 0.0) -> Sim3:
    """The second half turned, and moved along the step before it until that is some usual steps
    long."""
    step = TRUTH[HALF, :3, 3] - TRUTH[HALF - 1, :3, 3]
    moved = TRUTH[HALF].copy()
    moved[:3, :3] = moved[:3, :3] @ Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
    moved[:3, 3] += (paces - 1) * step
    return Sim3.of(1.0, moved @ inverse(TRUTH[HALF]))


@pytest.mark.parametrize(
    ("paces", "turn_deg", "expected"),
    [
        (1.0, 0, True),
        (1.0, 50, True),
        (1.0, 90, False),
        (5.0, 0, False),
        (0.3, 0, False),
        (-1.0, 0, False),
    ],
)
def test_a_part_follows_a_map_only_as_a_camera_walks_on(
    paces: float, turn_deg: float, expected: bool
) -> None:
    move = _carried(paces, turn_deg)
    breaks = Breaks([(HALF, HALF - 1)], OUTSIDE, BEFORE, TRUTH, TIMES)
    assert breaks.continued_by(move) == expected
    # Reversed in time, the same.
    after, sides = NUM - 1 - HALF, [NUM - 1 - rows[::-1] for rows in (OUTSIDE, BEFORE)]
    backward = Breaks([(after, after + 1)], *sides, TRUTH[::-1], TIMES)
    assert backward.continued_by(move) == expected


@pytest.mark.parametrize("paces", [0.3, -0.6, 2.6])
@pytest.mark.parametrize("pause", [1.0, 2.0])
def test_a_part_a_bay_away_is_moved_to_where_the_camera_walks_on(
    paces: float, pause: float
) -> None:
    times = TIMES + (pause - 1) * (TIMES >= HALF)
    breaks = Breaks([(HALF, HALF - 1)], OUTSIDE, BEFORE, TRUTH, times)
    moves = breaks.at_usual_pace(_carried(paces))
    assert moves and all(map(breaks.continued_by, moves))
    step, true = TRUTH[HALF, :3, 3] - TRUTH[HALF - 1, :3, 3], TRUTH[HALF, :3, 3]
    off = [
        np.linalg.norm(move.poses(TRUTH[[HALF]])[0, :3, 3] - true - (pause - 1) * step)
        for move in moves
    ]
    assert min(off) < 0.1 * pause * np.linalg.norm(step)
    alone = replace(breaks, part=np.array([HALF]))  # a single frame has no direction of its own
    assert len(alone.at_usual_pace(_carried(paces))) < len(moves)


def test_a_part_follows_nothing_without_a_break_or_steps_of_the_map() -> None:
    apart = np.array([0, HALF - 1])
    for steps, inside in (([], BEFORE), ([(HALF, HALF - 1)], apart)):
        breaks = Breaks(steps, OUTSIDE, inside, TRUTH, TIMES)
        assert not breaks.continued_by(Sim3()) and not breaks.at_usual_pace(Sim3())
