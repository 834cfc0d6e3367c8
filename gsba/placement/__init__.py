"""Placement of a run's world: upright, metric, georeferenced, or aligned to true poses or a scan.

Takes a finished result, and gravity, a length, GPS or a trajectory.
Gives a `Placement`, which moves poses, points and covariances.
"""

from gsba.placement.frame_fixes import EXIF, fixes_of_frames, read_fixes
from gsba.placement.gps import fixes_of, read_gps
from gsba.placement.placement import check, guess_in_scan

__all__ = [
    "EXIF",
    "check",
    "fixes_of",
    "fixes_of_frames",
    "guess_in_scan",
    "read_fixes",
    "read_gps",
]
