"""Metadata that cameras append to their files: lenses, gyro, exposures, positions.

Takes an original file of a camera.
Gives the records of its maker, in seconds, radians and metres, and notes on damaged ones.
"""

from gsba.containers.insta360 import Insta360Trailer, read_trailer

__all__ = ["Insta360Trailer", "read_trailer"]
