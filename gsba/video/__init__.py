"""Extraction of frames from 360-degree video, with exact presentation times.

Takes a video: 2:1, GoPro's `.360`, or raw of two fisheyes in two tracks, two files or side by side.
Gives a folder of frames with their times; of raw videos, a folder for each lens or track.
"""

from gsba.video.extraction import check_video, extract
from gsba.video.timeline import claimed_duration_s, is_video

__all__ = ["check_video", "claimed_duration_s", "extract", "is_video"]
