"""Status and pose of one frame of odometry."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np


class FrameStatus(IntEnum):
    """Source of a frame's pose."""

    TRACKED = 0  # from known points
    TURNING = 1  # before the map had points: the rotation alone, at the position before
    LOST = 2  # no pose: that of the frame before stands in


@dataclass(slots=True)
class FrameRecord:
    """Status, map and pose of one frame, relative to its keyframe."""

    status: FrameStatus
    map_number: int  # 0 = the first map
    keyframe: int  # number of the keyframe that it is relative to
    key_T_rig: np.ndarray  # (4, 4) float64, pose in that keyframe
    distance: float  # median distance of the points, map units; NaN = not known
    inliers: int  # features that fit the pose
