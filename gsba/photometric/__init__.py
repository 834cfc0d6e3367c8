"""Grey values: patches aligned to frames, and direct refinement of poses by them.

Takes a solved map and the frames' pictures.
Gives observations accurate to a hundredth of a pixel, or the map refined by pixels.
"""

from gsba.photometric.direct import PhotometricResult

__all__ = ["PhotometricResult"]
