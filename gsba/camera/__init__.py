"""The camera: six faces on one rig, the equirectangular picture, two lenses and their stitching.

Takes pixels of a face, a panorama or an equi-angular cube map.
Gives bearings in the rig frame, rays that start at the lens that saw them, and pixels back.
"""

from gsba.camera.lens import Lenses
from gsba.camera.rig import RIG_R_FACE, CubeRig, owner_faces
from gsba.camera.sphere import bearings_from_erp, erp_from_bearings
from gsba.camera.straighten import straightened

__all__ = [
    "RIG_R_FACE",
    "CubeRig",
    "Lenses",
    "bearings_from_erp",
    "erp_from_bearings",
    "owner_faces",
    "straightened",
]
