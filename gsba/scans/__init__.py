"""Scans of the place: reading, and registration of a run's point cloud with them.

Takes a finished result, and a cloud or mesh from a file.
Gives the similarity from one to the other with its evidence, and distances.
"""

from gsba.scans.distances import Distances, distances_to
from gsba.scans.files import check_scan, normals_of, read_mesh, read_pairs, read_scan, upwards
from gsba.scans.registration import Registration, in_file, register
from gsba.scans.search import Guess
from gsba.scans.types import Cloud, Scan, cloud_of

__all__ = [
    "Cloud",
    "Distances",
    "Guess",
    "Registration",
    "Scan",
    "check_scan",
    "cloud_of",
    "distances_to",
    "in_file",
    "normals_of",
    "read_mesh",
    "read_pairs",
    "read_scan",
    "register",
    "upwards",
]
