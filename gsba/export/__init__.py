"""Datasets for other programs: COLMAP, nerfstudio, PLY, TUM."""

from gsba.export.formats import ExportFormat, export
from gsba.export.ply import write_points

__all__ = ["ExportFormat", "export", "write_points"]
