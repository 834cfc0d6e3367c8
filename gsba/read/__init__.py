"""What a run starts from: frames, masks and a coarse trajectory on one clock."""

from gsba.read.associate import associate, without_trajectory
from gsba.read.exif import read_exif_gps
from gsba.read.frames import load_erp, load_faces, scan
from gsba.read.gps import GpsFixes, local_from_geodetic, read_gps
from gsba.read.keyframes import follow_keyframes
from gsba.read.masks import levels_of, load_mask, load_weights
from gsba.read.segments import associate_pieces, split_restarts
from gsba.read.times import check_fps
from gsba.read.trajectory import read_trajectory, write_tum

__all__ = [
    "GpsFixes",
    "associate",
    "associate_pieces",
    "check_fps",
    "follow_keyframes",
    "levels_of",
    "load_erp",
    "load_faces",
    "load_mask",
    "load_weights",
    "local_from_geodetic",
    "read_exif_gps",
    "read_gps",
    "read_trajectory",
    "scan",
    "split_restarts",
    "without_trajectory",
    "write_tum",
]
