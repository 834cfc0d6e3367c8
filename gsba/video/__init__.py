"""360-degree video to frames: exact presentation times, the sharpest of each window.

Takes a 2:1 video, or the raw one of two fisheyes: two tracks, two files or side by side.
Gives a folder of frames with their times, of raw videos one of each lens.
"""

from gsba.video.extraction import extract
from gsba.video.timeline import claimed_duration_s, is_video

__all__ = ["claimed_duration_s", "extract", "is_video"]
