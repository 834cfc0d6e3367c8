"""The coarse trajectory: its files, clock and pieces, and checks of its steps against images.

Takes files of other programs, frames' times, and relative poses from images.
Gives a pose for every frame, and the steps that images confirm or contradict.
"""

from gsba.trajectory.files import read_trajectory, write_tum
from gsba.trajectory.restarts import associate_pieces
from gsba.trajectory.steps import image_steps

__all__ = ["associate_pieces", "image_steps", "read_trajectory", "write_tum"]
