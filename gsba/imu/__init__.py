"""A gyro and an accelerometer fixed to the camera.

Takes their readings from a table or a maker's file, and rotations from images.
Gives rotations between frames, angular velocities during each, and the vertical, rig axes.
"""

from gsba.imu.alignment import Alignment, align, up_axis
from gsba.imu.files import read_imu
from gsba.imu.readings import Readings

__all__ = ["Alignment", "Readings", "align", "read_imu", "up_axis"]
