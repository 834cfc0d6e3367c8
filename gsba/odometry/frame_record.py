"""Status and pose of one frame of odometry."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np


class FrameStatus(IntEnum):
    """How the pose of a frame was found."""

    TRACKED = 0  # from known points
    TURNING = 1  # before the map had points: the rotation alone, the position is kept
    LOST = 2  # not at all: the pose of the frame before stands in for it


@dataclass(slots=True)
class FrameRecord:
    """Status, map and pose of one frame, relative to its keyframe."""

    status: FrameStatus
    map_number: int  # 0 = the first map
    keyframe: int  # number of the keyframe it hangs on
    key_T_rig: np.ndarray  # (4, 4) float64, pose in that keyframe
    distance: float  # median distance of the points, map units; NaN = not known
    inliers: int  # features that fit
