"""Records that stages pass to one another: arrays, with one comment per field.

Takes arrays of one stage.
Gives them to the next one under names, with shapes and units.
"""

from gsba.types.frame_set import (
    FACES,
    NO_FILE_NAME,
    Fisheye,
    FrameSet,
    PictureFormat,
    cameras_of,
    rows_across,
)
from gsba.types.records import (
    CoarsePoses,
    Counts,
    FamilyVariables,
    Features,
    GyroConstraints,
    Iteration,
    JointErrors,
    Keypoints,
    KnownPoints,
    Landmarks,
    Matches,
    PoseSource,
    PoseStatus,
    Reconstruction,
    Round,
    RunStart,
    Sighted,
    Solution,
    Tracks,
    Trajectory,
    VerifiedPairs,
)

__all__ = [
    "FACES",
    "NO_FILE_NAME",
    "CoarsePoses",
    "Counts",
    "FamilyVariables",
    "Features",
    "Fisheye",
    "FrameSet",
    "GyroConstraints",
    "Iteration",
    "JointErrors",
    "Keypoints",
    "KnownPoints",
    "Landmarks",
    "Matches",
    "PictureFormat",
    "PoseSource",
    "PoseStatus",
    "Reconstruction",
    "Round",
    "RunStart",
    "Sighted",
    "Solution",
    "Tracks",
    "Trajectory",
    "VerifiedPairs",
    "cameras_of",
    "rows_across",
]
