"""Placement of a run's world: upright, metric, georeferenced, or aligned to true poses or a scan.

Takes a finished result, and gravity, a length, GPS or a trajectory.
Gives a `Placement`, which moves poses, points and covariances.
"""

from gsba.placement.exif import read_exif_gps
from gsba.placement.frame_fixes import EXIF, fixes_of_frames, read_fixes
from gsba.placement.gps import GpsFixes, fixes_of, local_from_geodetic, read_gps
from gsba.placement.placement import check, guess_in_scan, place
from gsba.placement.world import Placement, read_placement

__all__ = [
    "EXIF",
    "GpsFixes",
    "Placement",
    "check",
    "fixes_of",
    "fixes_of_frames",
    "guess_in_scan",
    "local_from_geodetic",
    "place",
    "read_exif_gps",
    "read_fixes",
    "read_gps",
    "read_placement",
]
