"""Gaussian splats: render, train and measure them."""

from gsba.splat.camera import FaceCamera, face_camera
from gsba.splat.gaussians import Gaussians, from_cloud
from gsba.splat.ply import read_ply, write_ply

__all__ = ["FaceCamera", "Gaussians", "face_camera", "from_cloud", "read_ply", "write_ply"]
