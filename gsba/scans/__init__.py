"""Scans of the place: reading, and registration of a run's point cloud with them.

Takes a finished result, and a cloud or mesh from a file.
Gives the similarity from one to the other with its evidence, and distances.
"""

from gsba.scans.files import check_scan, read_pairs, read_scan
from gsba.scans.registration import in_file
from gsba.scans.types import distances_to

__all__ = ["check_scan", "distances_to", "in_file", "read_pairs", "read_scan"]
