"""Datasets for other programs: COLMAP, nerfstudio, PLY, TUM.

Takes a result, its frames, and where it is placed.
Gives a folder that the consumer reads as it is.
"""

from gsba.export.formats import ExportFormat, ExportOptions, export, export_all
from gsba.export.images import of_one_lens
from gsba.export.ply import write_points

__all__ = ["ExportFormat", "ExportOptions", "export", "export_all", "of_one_lens", "write_points"]
