"""Several recordings, each with a clock, a trajectory and a gyro of its own, matched and judged
alone; laid back to back, they are parts of a map that nothing ties together yet: map merging joins
them."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from gsba.log import GsbaError
from gsba.pipeline import frontend, tour
from gsba.pipeline.prior import Prior
from gsba.pipeline.state import State
from gsba.similarity import Sim3
from gsba.trajectory import joining
from gsba.trajectory.joining import SegmentAlignment
from gsba.trajectory.judgement import StepChecks
from gsba.types import CoarsePoses, GyroConstraints, VerifiedPairs


def match_neighbours(state: State) -> State:
    """Neighbours in time of every recording, and what they say of its trajectory, clock and gyro;
    GsbaError names one whose images do not match, contradict it, or show no motion."""
    run = state.run
    apart = [_match(state, number) for number in range(len(run.evidence.recordings))]
    run.latest[:] = [name for one in apart for name in one.run.latest]
    begins = np.cumsum([0, *(len(one.run.frames) for one in apart)]).tolist()
    near = list[VerifiedPairs]()
    for one, first in zip(apart, begins, strict=False):
        matches = one.verified.matches
        pairs = (matches.pairs + first).astype(matches.pairs.dtype)
        near.append(replace(one.verified, matches=replace(matches, pairs=pairs)))
    verified = VerifiedPairs.joined(near)
    return state.begun(_combined([one.prior for one in apart]), verified)


@contextmanager
def naming_recording(name: str) -> Iterator[None]:
    """Name a recording in the message of a GsbaError, which stays what it is; "" = the only one,
    which needs no name."""
    try:
        yield
    except GsbaError as error:
        if name:
            error.begin_with(f"recording '{name}'")
        raise


def _match(state: State, number: int) -> State:
    """One recording with its neighbours matched, its trajectory judged, its gyro aligned."""
    with naming_recording(state.run.evidence.recordings[number].name):
        found = frontend.match_neighbours(frontend.of_recording(state, number))
        steps = frontend.check_steps(found)
        found = frontend.judge_trajectory(tour.check_order(found, steps), steps)
        found = frontend.align_gyro_to_neighbours(found)
        if found.prior.turning_only:
            raise GsbaError(
                "the camera only turned, so that its frames have no place among those of others: "
                "leave it out"
            )
    return found


def _combined(priors: Sequence[Prior]) -> Prior:
    """Priors of recordings as one, their worlds brought together by a guess."""
    apart = joined_poses([one.coarse for one in priors])
    coarse, guesses = joining.join(apart)
    moves = [Sim3(), *(Sim3.of(guess.scale, guess.world_T_own) for guess in guesses)]
    trusts = [one.trust for one in priors]
    trust = StepChecks(
        np.concatenate(
            [move.poses(one.world_T_rigs) for move, one in zip(moves, trusts, strict=True)]
        ),
        _steps([one.false_steps for one in trusts], True),
        np.concatenate([one.false_frames for one in trusts]),
        _steps([one.unseen_steps for one in trusts], True),
        _steps([move.scale * one.lengths for move, one in zip(moves, trusts, strict=True)], 0.0),
        None,
    )
    joints = _joints(priors, guesses, moves)
    return Prior(
        replace(coarse, segments=None),
        trust,
        joints=joints,
        lone_steps=tuple(step for one in priors for step in one.lone_steps),
        order_doubted=any(one.order_doubted for one in priors),
        turning=_turning([(one.turning, len(one.coarse.sources)) for one in priors]),
        of_recordings=tuple(priors),
    )


def joined_poses(parts: Sequence[CoarsePoses]) -> CoarsePoses:
    """Coarse poses of recordings back to back, each in its own world, a segment for each."""
    sizes = [len(part.sources) for part in parts]
    return CoarsePoses(
        np.concatenate([part.world_T_rigs for part in parts]),
        np.concatenate([part.sources for part in parts]),
        0.0,
        np.repeat(np.arange(len(parts), dtype=np.int32), sizes),
        parts[0].origin,
    )


def _steps(parts: Sequence[np.ndarray], between: object) -> np.ndarray:
    """Values (F - 1,) of the steps of recordings, with a value for the steps between these."""
    boundary = np.array([between], parts[0].dtype)
    rows = [piece for part in parts for piece in (part, boundary)]
    return np.concatenate(rows[:-1])


def _joints(
    priors: Sequence[Prior], guesses: Sequence[SegmentAlignment], moves: Sequence[Sim3]
) -> tuple[SegmentAlignment, ...]:
    """Alignments of all pieces of the trajectories of recordings but the very first one."""
    joints, begin = list[SegmentAlignment](), 0
    for number, (one, move) in enumerate(zip(priors, moves, strict=True)):
        if number:
            guess = guesses[number - 1]
            last = begin + one.joints[0].first - 1 if one.joints else guess.last
            joints.append(replace(guess, last=last))
        for joint in one.joints:
            own = move.after(Sim3.of(joint.scale, joint.world_T_own))
            first, last = begin + joint.first, begin + joint.last
            joints.append(SegmentAlignment(first, last, own.scale, own.new_T_old, joint.how))
        begin += len(one.coarse.sources)
    return tuple(joints)


def _turning(parts: Sequence[tuple[GyroConstraints | None, int]]) -> GyroConstraints | None:
    """Constraints by the gyros of recordings, with numbers of frames; None = none is believed."""
    known = [turning for turning, _ in parts if turning is not None]
    if not known:
        return None
    every = list[GyroConstraints]()
    for turning, num in parts:
        nothing = np.zeros((num - 1, 3)), np.full(num - 1, np.inf), np.full((num, 3), np.nan)
        every.append(turning or GyroConstraints(*nothing, 0.0))
    return GyroConstraints(
        _steps([one.steps for one in every], np.zeros(3)),
        _steps([one.step_sigmas for one in every], np.inf),
        np.concatenate([one.rates for one in every]),
        max(one.rate_sigma for one in every),
    )
