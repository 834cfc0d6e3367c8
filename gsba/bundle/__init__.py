"""Bundle adjustment on GTSAM: poses, points, and what all frames share.

Takes matches, keypoints, a start and what is believed of the trajectory.
Gives solutions with their noise and covariances, and the result in the trajectory's world.
"""

from gsba.bundle.adjustment import AdjustmentContext, adjust, adjust_sighted, pose_covariances
from gsba.bundle.map_strength import MapStrength
from gsba.bundle.optimizer import OptimizeResult, optimize
from gsba.bundle.pose_variables import X
from gsba.bundle.reconstruction import assemble
from gsba.bundle.stitching import Stitching
from gsba.bundle.triangulation import triangulate

__all__ = [
    "AdjustmentContext",
    "MapStrength",
    "OptimizeResult",
    "Stitching",
    "X",
    "adjust",
    "adjust_sighted",
    "assemble",
    "optimize",
    "pose_covariances",
    "triangulate",
]
