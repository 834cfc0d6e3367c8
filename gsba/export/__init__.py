"""Datasets for other programs: COLMAP, nerfstudio, OpenSfM, Metashape, glTF, PLY, TUM.

Takes a result, its frames, and its placement.
Gives a folder that the other program reads without conversion.
"""

from gsba.export.dataset import ExportFormat, ExportOptions
from gsba.export.formats import export, export_all
from gsba.export.images import of_one_lens, seen_by
from gsba.export.motion import Shutter
from gsba.export.ply import write_points

__all__ = [
    "ExportFormat",
    "ExportOptions",
    "Shutter",
    "export",
    "export_all",
    "of_one_lens",
    "seen_by",
    "write_points",
]
