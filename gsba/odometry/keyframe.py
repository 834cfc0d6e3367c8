"""Keyframes of a map that is being made, their features, and one look for these in a frame."""

from dataclasses import dataclass

import numpy as np

from gsba.odometry.atlas import Atlas
from gsba.odometry.derotation import Miniature
from gsba.odometry.relocalisation import Described
from gsba.odometry.resection import Resection


@dataclass(slots=True)
class Keyframe:
    """A keyframe of the map that is being made."""

    number: int  # of the keyframe in the whole recording
    frame: int  # index of its frame
    world_T_rig: np.ndarray  # (4, 4)
    ids: np.ndarray  # (N,) int64, features seen
    bearings: np.ndarray  # (N, 3) unit, rig frame
    atlas: Atlas | None  # None = forgotten
    small: Miniature | None
    described: Described | None = None  # when a lost frame was first compared with it
    most_found: int = 0  # of its features in one of the frames after it


@dataclass(slots=True)
class Features:
    """Features of the last keyframe that are followed."""

    ids: np.ndarray  # (N,) int64
    bearings: np.ndarray  # (N, 3) unit, rig frame of the keyframe
    assumed_world: np.ndarray  # (N, 3) map units: where features without a point are assumed, by
    # their direction when last found and the distance of points beside them
    misses: np.ndarray  # (N,) int, frames since

    def taken(self, rows: np.ndarray) -> "Features":
        """Some rows."""
        return Features(
            self.ids[rows], self.bearings[rows], self.assumed_world[rows], self.misses[rows]
        )


@dataclass(frozen=True, slots=True)
class Attempt:
    """Where the features are in a frame, and the pose they give."""

    atlas: Atlas
    bearings: np.ndarray  # (N, 3)
    found: np.ndarray  # (N,) bool
    fit: Resection
