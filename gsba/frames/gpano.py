"""Tags of panoramas in XMP (developers.google.com/streetview/spherical-metadata): the part of the
sphere that a picture shows, and the camera's attitude."""

import math
import re
from dataclasses import dataclass

_TAG = re.compile(rb"(?<!/)GPano:(\w+)\s*(?:=\s*[\"']\s*([^\"'<]*)[\"']|>([^<]*)<)")


@dataclass(frozen=True, slots=True)
class Crop:
    """Place of a picture in its whole panorama."""

    width: int  # pixels of the whole panorama
    height: int
    left: int  # columns and rows of it before the picture
    top: int


@dataclass(frozen=True, slots=True)
class PanoramaTags:
    """Tags of a panorama; NaN = not given."""

    projection: str  # "" = not given
    full: tuple[float, float]  # width and height, pixels, of the whole panorama
    area: tuple[float, float, float, float]  # left, top, width, height of the picture in it
    attitude_deg: tuple[float, float, float]  # heading, pitch, roll of the middle of the picture

    @property
    def whole(self) -> bool:
        """True if the tags state that the picture is the whole panorama."""
        return self.area == (0, 0, *self.full)

    def crop(self, size: tuple[int, int]) -> Crop | None:
        """Place in the whole panorama, 2:1, of a picture of a width and height, which may have been
        made smaller; None = it is the whole one, or the tags are of another picture."""
        left, top, width, height = self.area
        numbers = (*self.full, *self.area)
        if self.whole or not all(map(math.isfinite, numbers)) or min(width, height) <= 0:
            return None
        scale = size[0] / width
        inside = left >= 0 and top >= 0 and left + width <= self.full[0] + 0.5
        inside &= top + height <= self.full[1] + 0.5
        # between both sides of a picture that was made smaller
        alike = abs(size[1] / height / scale - 1) <= 0.01
        if not (inside and alike and abs(self.full[0] / self.full[1] / 2 - 1) < 0.01):
            return None
        high = max(round(scale * self.full[1]), size[1], -(-size[0] // 2))
        at = min(round(scale * left), 2 * high - size[0]), min(round(scale * top), high - size[1])
        return Crop(2 * high, high, *at)


def read_tags(xmp: bytes) -> PanoramaTags | None:
    """GPano tags of an XMP packet; None = it holds none.

    Numbers that are damaged are not given.
    """
    found = {m[1].decode(): (m[2] or m[3] or b"") for m in _TAG.finditer(xmp)}
    if not found:
        return None

    def number(name: str) -> float:
        try:
            value = float(found.get(name, b"nan"))
        except ValueError:
            return math.nan
        return value if math.isfinite(value) else math.nan

    area = ("LeftPixels", "TopPixels", "ImageWidthPixels", "ImageHeightPixels")
    attitude = ("PoseHeadingDegrees", "PosePitchDegrees", "PoseRollDegrees")
    left, top, width, height = (number(f"CroppedArea{name}") for name in area)
    heading, pitch, roll = map(number, attitude)
    return PanoramaTags(
        found.get("ProjectionType", b"").decode("ascii", "replace").strip().lower(),
        (number("FullPanoWidthPixels"), number("FullPanoHeightPixels")),
        (left, top, width, height),
        (heading, pitch, roll),
    )
