"""Gaussian splats: rendered, trained, scored, and poses refined against them.

Takes posed frames and a cloud.
Gives Gaussians, pictures and scores, or the map refined against a splat.
"""

from gsba.splat.camera import FaceCamera
from gsba.splat.gaussians import Gaussians, from_cloud, read_ply, write_ply

__all__ = ["FaceCamera", "Gaussians", "from_cloud", "read_ply", "write_ply"]
