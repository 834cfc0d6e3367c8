"""The coarse trajectory: its files, clock and pieces, and checks of its steps against images.

Takes files of other programs, frames' times, and relative poses from images.
Gives a pose for every frame, and the steps that images confirm or contradict.
"""

from gsba.trajectory.association import associate, matched_in_time, without_trajectory
from gsba.trajectory.clock import Clock, ClockEstimate
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.trajectory.joining import SegmentAlignment
from gsba.trajectory.judgement import StepChecks
from gsba.trajectory.keyframes import follow_keyframes
from gsba.trajectory.restarts import associate_pieces, split_restarts
from gsba.trajectory.steps import Steps, image_steps

__all__ = [
    "Clock",
    "ClockEstimate",
    "SegmentAlignment",
    "StepChecks",
    "Steps",
    "associate",
    "associate_pieces",
    "follow_keyframes",
    "image_steps",
    "matched_in_time",
    "read_trajectory",
    "split_restarts",
    "without_trajectory",
    "write_tum",
]
