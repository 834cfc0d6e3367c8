"""What is no part of the scene: what carries the camera, what moves, what a user masks.

Takes frames, and for what moves a first solution.
Gives frames with masks on disk.
"""

from gsba.masks.carrier import Carrier, find_carrier, write_carrier
from gsba.masks.distractors import Distractors
from gsba.masks.merging import Choice, Masks, choose
from gsba.masks.segmentation import Segment

__all__ = [
    "Carrier",
    "Choice",
    "Distractors",
    "Masks",
    "Segment",
    "choose",
    "find_carrier",
    "write_carrier",
]
