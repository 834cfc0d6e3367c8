"""What cameras append to their files, beside pictures: lenses, gyro, exposures, positions.

Takes a file as a camera wrote it.
Gives what its maker's records hold, in seconds, radians and metres, and notes on what is damaged.
"""

from gsba.containers.insta360 import Insta360Trailer, read_trailer

__all__ = ["Insta360Trailer", "read_trailer"]
