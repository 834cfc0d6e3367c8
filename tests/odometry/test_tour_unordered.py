"""Steps of stills in no order, confirmed without their own points."""

import numpy as np
from scipy.spatial.transform import Rotation

from gsba.odometry.tour_maps import Triple
from gsba.odometry.tour_steps import Step, step_at
from gsba.odometry.tour_unordered import without_unsupported
from tests.room_tour import frames, true_poses, true_step

NONE = np.zeros((0, 3))


def sure_triples() -> list[Triple | None]:
    """Triples of true ratios, which confirm all steps of the four stills."""
    lengths = np.linalg.norm(np.diff(true_poses()[:, :3, 3], axis=0), axis=1)
    return [Triple(float(log), 30, NONE, NONE) for log in np.diff(np.log(lengths))]


def turned(f: int, angle_deg: float) -> Step:
    """A step with another direction, and the places found there."""
    wrong = true_step(f).f1_T_f0.copy()
    turn = Rotation.from_euler("y", angle_deg, degrees=True).as_matrix()
    wrong[:3, 3] = turn @ wrong[:3, 3]
    return step_at(frames()[f], frames()[f + 1], wrong)


def test_places_on_both_sides_confirm_right_steps() -> None:
    steps, sure = [true_step(f) for f in range(3)], sure_triples()
    assert without_unsupported(frames(), steps, sure, 1) == sure


def test_a_wrong_step_that_three_frames_confirm_is_left_out() -> None:
    steps, sure = [true_step(f) for f in range(3)], sure_triples()
    inside = without_unsupported(frames(), [steps[0], turned(1, 60), steps[2]], sure, 1)
    assert inside == [None, None]
    at_end = without_unsupported(frames(), [*steps[:2], turned(2, 60)], sure, 1)
    assert at_end == [sure[0], None]
