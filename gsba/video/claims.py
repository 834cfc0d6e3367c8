"""Claims of a video file about its pictures: display matrix, pixel aspect, stereo, projection.

FFmpeg reads them from MP4 (`tkhd`, `pasp`, `st3d`, `sv3d`), Matroska and the bitstream, and hands
them over with each frame. Layouts of their records: AVStereo3D and AVSphericalMapping of libavutil.
"""

import struct
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from gsba.video.colours import hdr_name

_STEREO = {
    1: "side by side",
    2: "over-under",
    3: "frame by frame",
    4: "checkerboard",
    5: "side by side",
    6: "line by line",
    7: "column by column",
}  # AVStereo3DType
_PROJECTIONS = {
    0: "",
    1: "cube map",
    2: "",
    3: "half equirectangular",
    4: "rectilinear",
    5: "fisheye",
}  # AVSphericalProjection; 2: equirectangular with bounds
_ORIENTATIONS = {  # EXIF's, of the signs of a, b, c, d of a display matrix
    (1, 0, 0, 1): 1,
    (-1, 0, 0, 1): 2,
    (-1, 0, 0, -1): 3,
    (1, 0, 0, -1): 4,
    (0, 1, 1, 0): 5,
    (0, 1, -1, 0): 6,
    (0, -1, -1, 0): 7,
    (0, -1, 1, 0): 8,
}


@dataclass(frozen=True, slots=True)
class PictureClaims:
    """Claims about the pictures of a video track."""

    orientation: int = 1  # of EXIF, 1 to 8, in which stored pictures are shown
    pixel_aspect: Fraction = Fraction(1)  # width over height of a pixel
    stereo: str = ""  # arrangement of two eyes; "" = one eye, or not stated
    projection: str = ""  # other than equirectangular; "" = equirectangular, or not stated
    spherical: bool = False  # True if a projection is stated
    bounds: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # parts of the sphere that
    # are missing at the left, top, right and bottom
    pose_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)  # yaw, pitch, roll by which pictures
    # are to be turned for display
    hdr: str = ""  # transfer function, "PQ" or "HLG"; "" = no HDR

    def shown_size(self, size: tuple[int, int]) -> tuple[int, int]:
        """Width and height as shown of pictures stored with a width and height: pixels are square,
        and no row becomes longer."""
        width, height = size
        if self.orientation > 4:
            return height, round(width * self.pixel_aspect)
        return width, round(height / self.pixel_aspect)

    @property
    def whole(self) -> bool:
        """True if the file states that pictures are whole panoramas for one eye."""
        return self.spherical and not (self.stereo or self.projection or any(self.bounds))


def claims_of(frame: Any, pixel_aspect: Fraction | None) -> PictureClaims:
    """Claims that come with a decoded frame.

    Args:
        frame: av.VideoFrame.
        pixel_aspect: of its stream; None = not stated.
    """
    records = {part.type.name: bytes(part) for part in frame.side_data}
    orientation = 1
    if len(matrix := records.get("DISPLAYMATRIX", b"")) >= 36:
        a, b, _, c, d = struct.unpack("=5i", matrix[:20])
        most = max(abs(value) for value in (a, b, c, d))
        signs = tuple(round(value / most) if most else 0 for value in (a, b, c, d))
        orientation = _ORIENTATIONS.get(signs, 1)  # type: ignore[arg-type]
    stereo, spherical = records.get("STEREO3D", b""), records.get("SPHERICAL", b"")
    eyes = _STEREO.get(struct.unpack("=i", stereo[:4])[0], "") if len(stereo) >= 4 else ""
    aspect = pixel_aspect if pixel_aspect else Fraction(1)
    hdr = hdr_name(frame.color_trc)
    if len(spherical) < 32:
        return PictureClaims(orientation, aspect, eyes, hdr=hdr)
    kind, *turns = struct.unpack("=4i", spherical[:16])
    bounds = [part / 2**32 for part in struct.unpack("=4I", spherical[16:32])]
    return PictureClaims(
        orientation,
        aspect,
        eyes,
        _PROJECTIONS.get(kind, "unknown"),
        True,
        tuple(bounds) if kind == 2 else (0.0,) * 4,  # type: ignore[arg-type]
        tuple(turn / 2**16 for turn in turns),  # type: ignore[arg-type]
        hdr,
    )
