"""A gyro that rode along: its clock, axes and noise, and the turns of frames that it measured."""

from dataclasses import replace

import numpy as np

from gsba.imu.alignment import Alignment, align, turning_of
from gsba.pipeline.state import State
from gsba.trajectory.steps import image_steps


def align_to_neighbours(state: State) -> State:
    """Constraints on the frames' turning from a gyro, aligned to how neighbours turn in images."""
    readings, times = state.run.evidence.imu, state.run.frames.timestamps
    if readings is None:
        return state
    steps = image_steps(state.verified, state.observed.keypoints)

    def compute() -> Alignment:
        return align(times, steps.f_T_nexts[:, :3, :3], steps.verified, readings)

    found = state.run.stage("imu", readings.digest, compute, Alignment)
    turning = None if found.reason else turning_of(readings, found, times)
    return replace(state, prior=replace(state.prior, gyro=found, turning=turning))


def align_to_map(state: State, name: str, *, with_noise: bool = True) -> State:
    """The gyro aligned anew, to the map's poses, which are better than those before.

    Args:
        state: of the run; it stays as it is where no gyro is believed.
        with_noise: measure the gyro's noise, too. Poses have followed it by as much as it was
            believed: the noise that they leave is measured once where they have become much better.
    """
    prior, times = state.prior, state.run.frames.timestamps
    readings, former = state.run.evidence.imu, prior.gyro
    if readings is None or former is None or former.reason:
        return state
    rotations = state.solution.world_T_rigs[:, :3, :3]
    steps = np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:]

    def compute() -> Alignment:
        return align(times, steps, ~prior.trust.unseen_steps, readings, former)

    found = state.run.stage(name, readings.digest, compute, Alignment)
    if found.reason:
        return state
    if not with_noise:
        found = replace(found, noise=former.noise)
    turning = turning_of(readings, found, times)
    return replace(state, prior=replace(prior, gyro=found, turning=turning))
