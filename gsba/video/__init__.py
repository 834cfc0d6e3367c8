"""360-degree video to frames: exact presentation times, the sharpest of each window.

Takes a 2:1 video.
Gives a folder of frames with their times.
"""

from gsba.video.extraction import extract
from gsba.video.timeline import is_video

__all__ = ["extract", "is_video"]
