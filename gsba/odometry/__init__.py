"""Visual odometry: the trajectory of a 360-degree camera, from its video alone.

Takes small panoramas in time order.
Gives a pose for every frame, and a selection of frames to refine.
"""

from gsba.odometry.panoramas import WIDTH, masked, of_frames, of_video, without_carrier
from gsba.odometry.walk import Odometry, choose_frames, track_panoramas

__all__ = [
    "WIDTH",
    "Odometry",
    "choose_frames",
    "masked",
    "of_frames",
    "of_video",
    "track_panoramas",
    "without_carrier",
]
