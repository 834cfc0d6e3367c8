"""360-degree video to frames: exact presentation times, the sharpest of each window."""

from gsba.video.extraction import extract
from gsba.video.timeline import is_video

__all__ = ["extract", "is_video"]
