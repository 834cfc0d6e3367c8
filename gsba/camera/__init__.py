"""The camera: six faces on one rig, the equirectangular picture, and what stitching bends.

Takes pixels of a face or a panorama.
Gives bearings in the rig frame, and pixels back.
"""

from gsba.camera.rig import RIG_R_FACE, CubeRig, owner_faces
from gsba.camera.sphere import bearings_from_erp, erp_from_bearings
from gsba.camera.straighten import straightened

__all__ = [
    "RIG_R_FACE",
    "CubeRig",
    "bearings_from_erp",
    "erp_from_bearings",
    "owner_faces",
    "straightened",
]
