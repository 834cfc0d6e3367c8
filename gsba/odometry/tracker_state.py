"""State of the tracker between frames: it can be stored, and tracking continued from it."""

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from gsba.odometry.atlas import Atlas
from gsba.odometry.derotation import Miniature
from gsba.odometry.relocalisation import Described


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


SIGMA = float(np.deg2rad(0.25))  # of bearings, per axis, at first


@dataclass(slots=True)
class Keyframe:
    """A keyframe of the current map."""

    number: int  # of the keyframe in the whole recording
    frame: int  # index of its frame
    world_T_rig: np.ndarray  # (4, 4)
    ids: np.ndarray  # (N,) int64, features seen
    bearings: np.ndarray  # (N, 3) unit, rig frame
    atlas: Atlas | None  # None = dropped
    small: Miniature | None
    described: Described | None = None  # computed when a lost frame is first compared with it
    most_found: int = 0  # largest number of its features found in a later frame


@dataclass(slots=True)
class TrackedFeatures:
    """Tracked features of the last keyframe."""

    ids: np.ndarray  # (N,) int64
    bearings: np.ndarray  # (N, 3) unit, rig frame of the keyframe
    assumed_world: np.ndarray  # (N, 3) map units, assumed positions of features without a point: at
    # their last bearing and the distance of neighbouring points
    misses: np.ndarray  # (N,) int, frames since it was last found


@dataclass(slots=True)
class TrackerState:
    """All frames so far, and the window of keyframes that poses the next one."""

    records: list[FrameRecord] = field(default_factory=list)  # of all frames so far
    keyframe_poses: list[np.ndarray] = field(default_factory=list)  # (4, 4) each, of all keyframes
    # so far, in the world of their map
    keyframe_frames: list[int] = field(default_factory=list)  # index of each keyframe's frame
    keyframe_features: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)  # that
    # each keyframe sees: ids (N,) int64, bearings (N, 3) float32 in the rig frame
    window: list[Keyframe] = field(default_factory=list)  # the last keyframes
    features: TrackedFeatures | None = None  # tracked ones; None = the next frame begins a map
    points: np.ndarray = field(default_factory=lambda: np.full((4096, 3), np.nan))  # (ids, 3) of
    # features, world of the map; NaN = unknown
    num_ids: int = 0  # of features so far
    map_number: int = 0  # of the map that is being made
    has_points: bool = False  # whether it has some
    world_T_rig: np.ndarray = field(default_factory=lambda: np.eye(4))  # of the frame posed last
    motion: np.ndarray = field(
        default_factory=lambda: np.eye(4)
    )  # (4, 4) to it from the last but one
    small: Miniature | None = None  # of the frame posed last
    sigma: float = SIGMA  # radians, noise of bearings per axis
    pending: list[tuple[int, np.ndarray, np.ndarray]] = field(default_factory=list)  # frames before
    # the start of the map: index, ids (N,), bearings (N, 3)
    failures: int = 0  # frames in a row that show something and fit nothing
    cut_R_rig: np.ndarray | None = None  # (3, 3) axes along which frames are cut
