"""Masks of pixels outside the scene: the carrier, moving objects, and a user's own masks.

Takes frames, and a first solution to detect moving objects.
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
