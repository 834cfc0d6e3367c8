"""Loops that bend a path as far as its steps can be off, and those that would bend it further."""

import numpy as np
import pytest
from synthetic import drifted, loop_walk

from gsba.geometry import inverse
from gsba.loop_closure import loops

NUM_FRAMES = 40
TRUTH = loop_walk(NUM_FRAMES)
SEEN = np.zeros(NUM_FRAMES - 1, bool)
TRUE = np.array([(n, NUM_FRAMES - 1 - n) for n in range(4)])
STEP = float(np.median(np.linalg.norm(np.diff(TRUTH[:, :3, 3], axis=0), axis=1)))


def _relative(pairs: np.ndarray, shift: float = 0.0) -> np.ndarray:
    """What loops between frames assert; false by a shift along the path, in steps."""
    targets = TRUTH[pairs[:, 1]].copy()
    targets[:, 2, 3] += shift * STEP
    return inverse(TRUTH[pairs[:, 0]]) @ targets


@pytest.mark.parametrize("seed", range(3))
def test_true_loops_stay_on_a_path_that_drifted(seed: int) -> None:
    path = drifted(TRUTH, np.random.default_rng(seed), 0.3)
    assert loops.affordable(path, SEEN, TRUE, _relative(TRUE)).all()


@pytest.mark.parametrize("count", [3, 8])
@pytest.mark.parametrize("shift", [1.5, 4.0])
def test_false_loops_that_agree_with_one_another_are_switched_off(shift: float, count: int) -> None:
    """Identical bays in the middle of the path, as many as or more than true loops at its ends."""
    path = drifted(TRUTH, np.random.default_rng(0), 0.3)
    false = np.array([(8 + n, 20 + n) for n in range(count)])
    pairs = np.concatenate([TRUE, false])
    asserted = np.concatenate([_relative(TRUE), _relative(false, shift)])
    kept = loops.affordable(path, SEEN, pairs, asserted)
    assert kept[: len(TRUE)].all() and not kept[len(TRUE) :].any()


def test_a_step_that_no_image_confirms_gives_way() -> None:
    torn, unseen = TRUTH.copy(), SEEN.copy()
    torn[20:, :3, 3] += [0.4 * STEP, 0, STEP]
    unseen[19] = True
    assert loops.affordable(torn, unseen, TRUE, _relative(TRUE)).all()
    assert not loops.affordable(torn, SEEN, TRUE[:2], _relative(TRUE[:2], 3.0)).any()
