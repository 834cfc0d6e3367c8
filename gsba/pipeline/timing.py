"""Neighbours matched under the given clock, and under the right one where that is another."""

import logging
from collections.abc import Callable, Sequence
from typing import Any

from gsba.config import RefineSettings
from gsba.matching import recovery
from gsba.pipeline.backend import Line
from gsba.trajectory import clock
from gsba.trajectory.clock import ClockEstimate
from gsba.types import CoarsePoses, FrameSet, PoseSource, Trajectory, VerifiedPairs

logger = logging.getLogger(__name__)

Associate = Callable[[FrameSet, Sequence[Trajectory], RefineSettings], CoarsePoses]


def match_neighbours(
    line: Line, given: Sequence[Trajectory], associate: Associate
) -> VerifiedPairs:
    """Verified neighbours in time, after the clock has been set right.

    Args:
        line: of the run; keeps the estimate, and starts from poses at the right times.
        given: all entries of the trajectory; of several, each piece may have a clock of its own,
            and all are taken as they are.
        associate: poses of frames from a trajectory.
    """
    guided = line.match_neighbours()
    settings, coarse, times = line.settings, line.coarse, line.frames.timestamps
    absent = len(given) != 1 or (coarse.sources == PoseSource.NONE).all()
    if absent or settings.read.clock == "given":
        return guided
    context, trajectory = line.context, given[0]

    def compute() -> ClockEstimate:
        return recovery.check_clock(context, guided, coarse, times, trajectory)

    key = [trajectory.timestamps.tolist(), trajectory.world_T_rigs.tolist()]
    estimate = line.store.stage("clock", key, compute, ClockEstimate, [line.latest])
    line.latest, line.clock = "clock", estimate
    if estimate.verdict != "corrected":
        return guided
    settled = settings.read.model_copy(update={"clock_offset_s": 0.0})
    settings = settings.model_copy(update={"read": settled})
    line.follow(associate(line.frames, [estimate.clock.on_frames(trajectory)], settings))
    return line.match_neighbours("neighbours_on_time")


def describe(
    estimate: ClockEstimate | None, judgement: dict[str, Any], notes: list[str]
) -> tuple[dict[str, Any], list[str]]:
    """What the report says of the trajectory, and the notes, with the clock's."""
    if estimate is None:
        return judgement, notes
    if estimate.verdict == "corrected":
        logger.warning(estimate.note)
        notes = [*notes, estimate.note]
    elif estimate.note:
        logger.info(estimate.note)
    return judgement | {"clock": clock.describe(estimate)}, notes
