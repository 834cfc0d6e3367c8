"""Tracks of a GoPro MAX recording (`.360`) that hold its equi-angular cube map.

Such files also hold sound, telemetry and small images; the two tracks are recognised by their size.
They are streams 0 and 5 of videos and 0 and 4 of time lapses, so that their order, not their
number, distinguishes them.
"""

from collections.abc import Sequence
from pathlib import Path

from gsba.camera.equiangular import is_equiangular
from gsba.log import GsbaError

TRACKS = ("track0", "track5")  # folders of their frames, by GoPro's numbers


def cube_tracks(video: Path, sizes: Sequence[tuple[int, int]]) -> tuple[int, int] | None:
    """Find the two tracks of an equi-angular cube map in a video; None if it holds none.

    Args:
        video: the file.
        sizes: width and height of its tracks.

    Raises:
        GsbaError: a `.360` file does not hold exactly two such tracks of one size.
    """
    found = [n for n, size in enumerate(sizes) if is_equiangular(*size)]
    if len(found) == 2 and sizes[found[0]] == sizes[found[1]]:
        return found[0], found[1]
    panorama = len(sizes) == 1 and sizes[0][0] == 2 * sizes[0][1]
    if video.suffix.lower() != ".360" or panorama:
        return None
    shapes = " and ".join(f"{width}x{height}" for width, height in sizes)
    if len(sizes) == 1 and found:
        raise GsbaError(
            f"{video} holds one video track of {shapes}, but a .360 recording has two: the other "
            "half of the sphere is missing; copy the file again from the camera"
        )
    raise GsbaError(
        f"{video} holds video tracks of {shapes}; a .360 recording has two of one size, three "
        "squares wide and up to a twelfth more (4096x1344, 2272x736): copy it again from the "
        "camera, or export an equirectangular (2:1) video from GoPro Player"
    )
