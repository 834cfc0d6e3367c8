"""How far a round moved poses, in standard deviations of the steps between them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import loop_walk

from gsba.bundle.map_strength import step_motion
from gsba.geometry import pose
from gsba.types import JointErrors

NUM = 40
SIGMAS = np.array([1e-3] * 3 + [5e-3] * 3)


def _known(num: int) -> tuple[np.ndarray, JointErrors]:
    """Each pose known on its own."""
    covariances = np.tile(np.diag(SIGMAS**2), (num, 1, 1))
    return covariances, JointErrors(np.zeros((num - 1, 6, 6)), np.zeros((0, num, 6), np.float32))


def _moved(world_T_rigs: np.ndarray, tangents: np.ndarray) -> np.ndarray:
    turns = Rotation.from_rotvec(tangents[:, :3]).as_matrix()
    return world_T_rigs @ pose(turns, tangents[:, 3:])


@pytest.mark.parametrize("sigmas", [0.1, 1.0, 3.0])
def test_motion_is_counted_in_standard_deviations(sigmas: float) -> None:
    before, rng = loop_walk(NUM), np.random.default_rng(0)
    drawn = [
        step_motion(
            before, _moved(before, sigmas * SIGMAS * rng.normal(size=(NUM, 6))), *_known(NUM)
        )
        for _ in range(10)
    ]
    assert np.sqrt(np.mean(np.square(drawn))) == pytest.approx(sigmas, rel=0.1)


def test_another_world_and_scale_is_no_motion() -> None:
    before = loop_walk(NUM)
    after = pose(Rotation.from_rotvec([0.3, 1, 0.2]).as_matrix(), np.array([1.0, 2, 3])) @ before
    after[:, :3, 3] *= 2.5
    assert step_motion(before, after, *_known(NUM)) < 1e-6


def test_another_world_and_scale_of_one_of_two_maps_is_no_motion() -> None:
    """Nothing ties two maps: the second one alone is moved, and grows."""
    before, maps = loop_walk(NUM), np.repeat([0, 1], NUM // 2)
    after = before.copy()
    second = pose(Rotation.from_rotvec([0.0, 0.1, 0]).as_matrix(), np.array([1.0, 2, 3]))
    after[maps == 1] = second @ before[maps == 1]
    after[maps == 1, :3, 3] *= 1.5
    assert step_motion(before, after, *_known(NUM)) > 1
    assert step_motion(before, after, *_known(NUM), maps) < 1e-6
    one = np.concatenate([np.zeros(NUM - 1, int), [7]])  # a frame alone has no step
    assert step_motion(before, before, *_known(NUM), one) < 1e-6


def test_steps_that_nothing_is_known_of_do_not_count() -> None:
    before, (covariances, joint) = loop_walk(NUM), _known(NUM)
    after = before.copy()
    after[7, :3, 3] += np.array([0, 0.1, 0])
    assert step_motion(before, after, covariances, joint) > 1
    covariances[7] = np.nan
    assert step_motion(before, after, covariances, joint) < 0.3
    assert np.isnan(step_motion(before, after, np.full_like(covariances, np.nan), joint))
