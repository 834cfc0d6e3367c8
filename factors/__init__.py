"""Factors for 360-degree bundle adjustment on GTSAM: reference factors, batched blocks."""

from factors.bearing import BearingFactor, BearingTerm, bearing_residuals, tangent_basis
from factors.block import Block, PoseSystem
from factors.check import jacobian_errors
from factors.landmarks import LandmarkBlock
from factors.patches import PatchSet
from factors.reprojection import (
    FaceCameras,
    ReprojectionFactor,
    ReprojectionTerm,
    reprojection_residuals,
)
from factors.robust import RobustLoss
from factors.sphere_image import SphereImage

__all__ = [
    "BearingFactor",
    "BearingTerm",
    "Block",
    "FaceCameras",
    "LandmarkBlock",
    "PatchSet",
    "PoseSystem",
    "ReprojectionFactor",
    "ReprojectionTerm",
    "RobustLoss",
    "SphereImage",
    "bearing_residuals",
    "jacobian_errors",
    "reprojection_residuals",
    "tangent_basis",
]
