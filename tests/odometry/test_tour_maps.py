"""Steps of tours: hypotheses by searched places, and their confirmation by three frames."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsba.geometry import inverse, pose, unit
from gsba.odometry.tour_maps import (
    MAX_RIVAL_CELLS,
    MIN_CELLS,
    MIN_CELLS_OF_RATIO,
    Triple,
    confirmed,
    kept_steps,
    maps_of,
    ratios,
    triple,
)
from gsba.odometry.tour_steps import (
    Step,
    adjusted_pose,
    found_places,
    frame_of,
    hypotheses,
    pose_errors_deg,
    step_of,
)
from tests.room_tour import frames, true_poses, true_step

NONE = np.zeros((0, 3))


def hypothesis(turn_deg: float = 0.0) -> Step:
    """A hypothesis without keypoints, turned against others."""
    f1_T_f0 = pose(Rotation.from_euler("y", turn_deg, degrees=True).as_matrix(), np.eye(3)[2])
    return Step(f1_T_f0, NONE[:, 0], NONE[:, 0], NONE, NONE, 500.0, 1)


def of_cells(cells: int, log_ratio: float = 0.0) -> Triple:
    return Triple(log_ratio, cells, NONE, NONE)


def test_a_third_frame_confirms_the_true_ratio_and_no_other() -> None:
    before, after = true_step(0), true_step(1)
    positions = true_poses()[:3, :3, 3]
    lengths = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    true = np.log(lengths[1] / lengths[0])
    assert before.num > 300
    assert abs(ratios(before, after, frames()[1].keys)[0] - true) < 0.02
    first, third = frames()[0], frames()[2]
    right = triple(first, third, before, after, true)
    wrong = triple(first, third, before, after, true + 0.4)
    assert right.cells > 3 * MIN_CELLS and wrong.cells < MIN_CELLS
    seen = np.isfinite(right.places2[:, 0])
    f2_T_f0 = inverse(true_poses()[2]) @ true_poses()[0]
    points = first.keys[seen] * (before.depths0[seen] * lengths[0])[:, None]
    predicted = unit(points @ f2_T_f0[:3, :3].T + f2_T_f0[:3, 3])
    off = np.linalg.norm(predicted - right.places2[seen], axis=1)
    assert np.count_nonzero(seen) > 100 and np.median(off) < np.deg2rad(0.1)


def test_a_step_with_another_direction_fits_few_places() -> None:
    right = true_step(0)
    one, other = frames()[:2]
    turned = right.f1_T_f0.copy()
    turned[:3, 3] = Rotation.from_euler("y", 90, degrees=True).as_matrix() @ turned[:3, 3]
    rows = np.arange(0, len(one.keys), 3)
    none = np.zeros(0, int), NONE
    wrong = step_of(one, other, turned, found_places(one, other, rows, turned, 0.35), none)
    assert wrong.num < right.num / 10


def test_a_blank_picture_has_no_hypotheses() -> None:
    blank = frame_of(np.full((512, 1024), 90, np.uint8), None)
    assert hypotheses(frames()[0], blank) == [] == hypotheses(blank, frames()[0])
    steps = list[list[Step]]([[], [hypothesis()], []])
    assert confirmed(steps, [{}, {}])[1] == [None, None]


def test_a_pose_is_fitted_to_places_with_false_ones() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-3, 3, (300, 3))
    true = pose(Rotation.from_euler("xyz", [5, 20, -3], degrees=True).as_matrix(), unit([1, 0, 2]))
    rays0, rays1 = unit(points), unit(points @ true[:3, :3].T + true[:3, 3])
    rays1[:60] = unit(rng.normal(size=(60, 3)))
    start = pose(
        Rotation.from_euler("y", 1, degrees=True).as_matrix() @ true[:3, :3], unit([1, 0.05, 1.9])
    )
    assert max(pose_errors_deg(start, true)) > 0.9
    found = adjusted_pose(rays0, rays1, start, np.deg2rad(0.15))
    assert max(pose_errors_deg(found, true)) < 0.05


def test_the_chain_with_most_cells_is_confirmed_unless_it_is_rivalled() -> None:
    steps = [[hypothesis(), hypothesis(40)] for _ in range(3)]
    clear = {(0, 0): [of_cells(2)], (1, 1): [of_cells(MIN_CELLS)]}
    rivalled = {(1, 0): [of_cells(10), of_cells(9, 1.0)], (0, 0): [of_cells(3)]}
    chain, found = confirmed(steps, [clear, rivalled])
    assert chain == [1, 1, 0]
    assert found[0] is clear[1, 1][0] and found[1] is None
    few = {(1, 1): [of_cells(MIN_CELLS - 1)]}
    assert confirmed(steps, [few, few])[1] == [None, None]


def test_a_less_accurate_hypothesis_is_no_rival() -> None:
    steps = [[hypothesis(), hypothesis(1.5)], [hypothesis()]]
    near = {(0, 0): [of_cells(10)], (1, 0): [of_cells(9)]}
    assert confirmed(steps, [near])[1] == near[0, 0]
    steps = [[hypothesis(), hypothesis(5)], [hypothesis()]]
    assert confirmed(steps, [near])[1] == [None]


def test_between_confirmed_steps_few_cells_confirm_the_ratio() -> None:
    steps = [[hypothesis(), hypothesis(40)] for _ in range(4)]
    clear = {(0, 0): [of_cells(20)]}
    between = {(0, 0): [of_cells(MIN_CELLS_OF_RATIO)], (0, 1): [of_cells(MIN_CELLS_OF_RATIO)]}
    assert confirmed(steps, [clear, between, clear])[1][1] is between[0, 0][0]
    assert confirmed(steps, [clear, between, {}])[1][1] is None


def test_where_places_repeat_nothing_is_confirmed() -> None:
    steps = [[hypothesis(), hypothesis(40)] for _ in range(5)]
    clear = {(0, 0): [of_cells(60)]}
    repeated = clear | {(1, 1): [of_cells(MAX_RIVAL_CELLS)]}
    assert None not in confirmed(steps, [clear, clear, clear, repeated])[1]
    assert confirmed(steps, [clear, clear, repeated, repeated])[1] == [None] * 4


def test_a_step_of_low_rank_needs_frames_on_both_sides() -> None:
    low = replace(hypothesis(), rank=50.0)
    clear = {(0, 0): [of_cells(20)]}
    held = [clear[0, 0][0]] * 2
    assert confirmed([[hypothesis()], [low], [hypothesis()]], [clear, clear])[1] == held
    at_end = confirmed([[hypothesis()], [hypothesis()], [low]], [clear, clear])[1]
    assert at_end == [held[0], None]


def test_steps_are_kept_between_which_the_ratio_is_known() -> None:
    sizes = [5, 4, 9, 8, 7]
    assert kept_steps([True, True, True, True], sizes).all()
    # Step 1 gives way to step 2, and step 0 has no neighbour then.
    assert kept_steps([True, False, True, False], sizes).tolist() == [
        False,
        False,
        True,
        True,
        False,
    ]
    assert not kept_steps([False, False], [1, 1, 1]).any()


def test_steps_kept_make_maps_and_other_frames_are_alone() -> None:
    keys = np.eye(3)

    def step(depths0: list[float], depths1: list[float]) -> Step:
        return replace(hypothesis(), depths0=np.array(depths0), depths1=np.array(depths1))

    steps = [step([2, 2, 2], [1, 1, np.nan]), step([0.51, 0.9, np.nan], [0.6, 0.6, 0.6]), None]
    few = replace(frames()[0], keys=keys)
    one, alone = maps_of([few] * 4, steps, [of_cells(9, np.log(2)), None])
    assert (one.first, one.last, alone.first) == (0, 2, 3)
    assert alone.single and np.isnan(alone.depths[0]).all()
    assert np.linalg.norm(one.between(1, 2)[:3, 3]) == pytest.approx(2)
    # The second step is twice as long; depths by both must agree.
    np.testing.assert_allclose(one.depths[1], [1.01, np.nan, np.nan])
    np.testing.assert_allclose(one.depths[2], [1.2, 1.2, 1.2])
