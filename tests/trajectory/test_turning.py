"""A turn on the spot is claimed only where matches prove it, of the frames that they tie."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import keypoints_of, unit, with_noise

from gsba.geometry import rotation_angle
from gsba.trajectory import turning
from gsba.trajectory.limits import TwoViewLimits
from gsba.types import Counts, Keypoints, Matches, VerifiedPairs

NUM_FRAMES, SIGMA = 9, 5e-4  # radians
ROTATIONS = Rotation.from_rotvec([[0.02 * f, 0.3 * f, 0] for f in range(NUM_FRAMES)]).as_matrix()
EVERY_PAIR = [(f, f + gap) for gap in (1, 2, 4) for f in range(NUM_FRAMES - gap)]


def _seen(
    step: float,
    num: int = 60,
    frames: list[tuple[int, int]] = EVERY_PAIR,
    nearest: float = 1.5,
    hand: float = 0.0,
) -> tuple[VerifiedPairs, Keypoints]:
    """Pairs that match all of `num` points at 1.5 to 5 units, and their keypoints.

    The camera moves by `step` units a frame, the hand that holds it by `hand`, per axis. Relative
    poses are not needed for a proof.
    """
    rng = np.random.default_rng(5)
    points = unit(rng.normal(size=(num, 3))) * rng.uniform(nearest, 5, (num, 1))
    at = rng.normal(0, hand, (NUM_FRAMES, 3)) + np.outer(np.arange(NUM_FRAMES), [step, 0, 0])
    rays = [
        with_noise(unit(points - at[f]) @ rotation, SIGMA, rng)
        for f, rotation in enumerate(ROTATIONS)
    ]
    keypoints = keypoints_of(np.arange(NUM_FRAMES + 1) * num, np.concatenate(rays), SIGMA)
    pairs, row = np.array(frames, np.int32).reshape(-1, 2), np.arange(num, dtype=np.int32)
    matches = Matches.of_rows(pairs, [np.column_stack([row, row])] * len(frames))
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    sigma = np.full(len(frames), np.inf)
    return VerifiedPairs(
        matches, poses, sigma, Counts(len(frames), len(frames), "pairs")
    ), keypoints


def _prove(pairs: VerifiedPairs, keypoints: Keypoints) -> turning.Turn | None:
    return turning.prove(pairs, keypoints, TwoViewLimits())


def test_a_turn_is_proved_and_its_rotations_are_right() -> None:
    turn = _prove(*_seen(0.0))
    assert turn is not None and turn.frames.all()
    found = turn.world_R_rigs[0].T @ turn.world_R_rigs
    errors = rotation_angle(np.swapaxes(ROTATIONS[0].T @ ROTATIONS, 1, 2) @ found)
    assert np.degrees(errors).max() < 0.1


@pytest.mark.parametrize("step", [0.2, 1.0])
def test_steps_of_a_walk_are_no_turn(step: float) -> None:
    assert _prove(*_seen(step)) is None
    assert _prove(*_seen(step, num=8)) is None  # few matches, as weak features leave


def test_parallax_that_adds_up_over_several_frames_is_no_turn() -> None:
    pairs, keypoints = _seen(0.02)
    near = [p for p, (f0, f1) in enumerate(pairs.matches.pairs) if f1 - f0 == 1]
    assert _prove(pairs.taken(near), keypoints) is not None  # .2 to .8 deg: no step shows it
    assert _prove(pairs, keypoints) is None


def test_a_hand_may_move_where_no_position_is_claimed_but_not_walk() -> None:
    """Over all gaps: a walk of 4 cm a frame, seen from 1.5 to 5 m, has 12 degrees of parallax."""
    frames = [(f, f + gap) for gap in (1, 2, 4, 8) for f in range(NUM_FRAMES - gap)]
    hand, walk = _seen(0.0, frames=frames, hand=0.05), _seen(0.04, frames=frames)
    assert _prove(*hand) is None
    most = turning.MAX_HAND_PARALLAX_RAD
    turn = turning.prove(*hand, TwoViewLimits(), most)
    assert turn is not None and turn.frames.all()
    assert turning.prove(*walk, TwoViewLimits(), most) is None


def test_few_matches_prove_a_turn_only_if_all_agree() -> None:
    assert _prove(*_seen(0.0, num=6)) is not None
    assert _prove(*_seen(0.0, num=4)) is None


def test_only_frames_that_matches_tie_together_turned() -> None:
    frames = [(0, 1), (2, 3), (3, 4), (4, 6), (6, 7)]
    turn = _prove(*_seen(0.0, frames=frames))
    assert np.flatnonzero(turn.frames).tolist() == [2, 3, 4, 6, 7]
    found = turn.world_R_rigs[2].T @ turn.world_R_rigs[7]
    assert np.degrees(rotation_angle(found.T @ (ROTATIONS[2].T @ ROTATIONS[7]))) < 0.1
    assert _prove(*_seen(0.0, frames=[(0, 1), (3, 4)])) is None  # two frames of nine are no turn
    assert _prove(*_seen(0.0, frames=[])) is None
