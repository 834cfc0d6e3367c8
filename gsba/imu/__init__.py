"""A gyro and an accelerometer that ride with the camera.

Takes their readings from a table or a maker's file, and how the images turn.
Gives the turn between frames and during each, in the rig's axes, and which way is up.
"""

from gsba.imu.alignment import Alignment, align
from gsba.imu.files import read_imu
from gsba.imu.gravity import up_axis
from gsba.imu.readings import Readings

__all__ = ["Alignment", "Readings", "align", "read_imu", "up_axis"]
