"""Factors for 360-degree bundle adjustment on GTSAM: reference factors, batched blocks."""

from factors._observations import Term
from factors.bearing import (
    BearingFactor,
    BearingTerm,
    LensBearingFactor,
    bearing_residuals,
    tangent_basis,
)
from factors.block import Block, PoseSystem
from factors.check import jacobian_errors
from factors.landmark_residual import LandmarkResidual, LandmarkTerm
from factors.landmarks import LandmarkBlock
from factors.patch_windows import PatchPixels, PatchTable
from factors.patches import PatchSet
from factors.photometric import PhotometricBlock
from factors.photometric_factor import PhotometricFactor, photometric_residuals
from factors.reduced_factor import block_factor
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
    "LandmarkResidual",
    "LandmarkTerm",
    "LensBearingFactor",
    "PatchPixels",
    "PatchSet",
    "PatchTable",
    "PhotometricBlock",
    "PhotometricFactor",
    "PoseSystem",
    "ReprojectionFactor",
    "ReprojectionTerm",
    "RobustLoss",
    "SphereImage",
    "Term",
    "bearing_residuals",
    "block_factor",
    "jacobian_errors",
    "photometric_residuals",
    "reprojection_residuals",
    "tangent_basis",
]
