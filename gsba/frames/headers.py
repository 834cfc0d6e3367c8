"""Headers of image files, read without decoding pixels: JPEG, PNG, WebP and TIFF, with sizes on
display. Pillow does not notice here that a file's end is missing, skips damaged tags of a TIFF, of
equal ones takes the last where decoders take the first, and decodes a PNG for tags behind pixels.
"""

import mmap
import zlib
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import numpy as np

from gsba.frames.gpano import Crop, PanoramaTags, read_tags
from gsba.log import GsbaError

MAX_PIXELS = 1 << 28  # pixels of one image: 768 MB of colours

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"IEND\xaeB`\x82"  # chunk type and its constant CRC
_JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"
_JPEG_SCAN, _JPEG_APP1 = 0xDA, 0xE1  # SOS; where EXIF is
_EXIF = b"Exif\0\0"
_XMP, _PNG_XMP = b"http://ns.adobe.com/xap/1.0/\0", b"XML:com.adobe.xmp\0"
_TIFF_STARTS = b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"  # with +: BigTIFF
_TIFF_TYPES = {1: 1, 3: 2, 4: 4, 16: 8}  # bytes of an unsigned number


class _TiffTag(IntEnum):
    """Tags of a TIFF directory that are read."""

    WIDTH, HEIGHT, BITS, COMPRESSION, COLOURS = 256, 257, 258, 259, 262
    ORIENTATION, SAMPLES, PLANES, FORMAT = 274, 277, 284, 339
    STRIPS, STRIP_SIZES, TILES, TILE_SIZES = 273, 279, 324, 325


_TIFF_PARTS = {_TiffTag.STRIPS, _TiffTag.STRIP_SIZES, _TiffTag.TILES, _TiffTag.TILE_SIZES}
_MAX_TAGS, _MAX_VALUES = 4096, 64  # largest number of tags of a directory; of values of a tag
# that lists no parts
_NOTHING = np.zeros(0, np.uint64)
_TIFF_COMPRESSIONS = {1, 5, 7, 8, 32773, 32946}  # none, LZW, JPEG, deflate, PackBits, old deflate

Bytes = mmap.mmap | bytes


@dataclass(frozen=True, slots=True)
class Header:
    """The header of an image file."""

    kind: str  # "JPEG", "PNG", "WebP" or "TIFF"
    width: int  # pixels as shown
    height: int  # pixels as shown
    orientation: int = 1  # EXIF's, 1 (as stored) to 8
    plain: bool = False  # True for 8 bits of red, green and blue, which any program reads
    crop: Crop | None = None  # place of the stored picture in the panorama that is shown
    tags: PanoramaTags | None = None  # None = none

    @property
    def size(self) -> tuple[int, int]:
        """Width and height as shown."""
        return self.width, self.height

    @property
    def swapped(self) -> bool:
        """True if the orientation tag transposes the stored picture."""
        return self.orientation > 4


class _Unsupported(Exception):
    """The file is intact, but of a variant that is not supported."""


class _Truncated(Exception):
    """The end of the file is missing."""


def header_of(data: Bytes, path: Path) -> Header:
    """The header of an image file's content. Raises GsbaError: no such image, its end is missing,
    an unsupported variant, or more than MAX_PIXELS."""
    try:
        header = _header(data)
    except _Truncated:
        raise GsbaError(
            f"{path}: truncated image (its end is missing); copy or extract it again"
        ) from None
    except _Unsupported as what:
        raise GsbaError(f"{path}: {what}") from None
    except (IndexError, ValueError):  # ran past the end
        raise GsbaError(f"{path}: truncated or damaged image; copy or extract it again") from None
    if header.width * header.height > MAX_PIXELS:
        raise GsbaError(
            f"{path}: is {header.width}x{header.height}, "
            f"{header.width * header.height / 1e6:.0f} megapixels; "
            f"{MAX_PIXELS / 1e6:.0f} are read at most: make it smaller"
        )
    return header


def _header(data: Bytes) -> Header:
    if data[:8] == _PNG_SIGNATURE:
        return _png(data)
    if data[:2] == _JPEG_START:
        return _jpeg(data)
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return _webp(data)
    if data[:4] in _TIFF_STARTS:
        return _tiff(data)
    raise _Unsupported("not a JPEG, PNG, WebP or TIFF image; remove or convert it")


def _shown(
    kind: str, width: int, height: int, orientation: int, plain: bool, xmp: bytes = b""
) -> Header:
    """Header with the size on display; a stored part of a panorama is shown as a whole."""
    if orientation > 4:
        width, height = height, width
    tags = read_tags(xmp) if xmp else None
    crop = tags.crop((width, height)) if tags and orientation == 1 else None
    if crop is not None:
        return Header(kind, crop.width, crop.height, orientation, False, crop, tags)
    return Header(kind, width, height, orientation, plain and orientation == 1, None, tags)


def _png(data: Bytes) -> Header:
    """PNG, third edition, sections 5 and 11."""
    if len(data) < 33 or data[12:16] != b"IHDR":
        raise ValueError
    if data.rfind(_PNG_END) <= 0:
        raise _Truncated
    width, height = (int.from_bytes(data[at : at + 4], "big") for at in (16, 20))
    plain = data[24] == 8 and data[25] in (2, 6)  # RGB, RGB with alpha
    xmp, exif = _png_tags(data)
    return _shown("PNG", width, height, _orientation(exif), plain, xmp)


def _png_tags(data: Bytes) -> tuple[bytes, bytes]:
    """The text chunk of XMP before the pixels, and the eXIf chunk there or behind them, near the
    end."""
    position, xmp, exif = 8, b"", b""
    while (kind := data[position + 4 : position + 8]) not in (b"IDAT", b"IEND", b""):
        length = int.from_bytes(data[position : position + 4], "big")
        start = position + 8
        if kind == b"iTXt" and data[start : start + len(_PNG_XMP)] == _PNG_XMP:
            xmp = xmp or data[start : start + length]
        elif kind == b"eXIf":
            exif = exif or data[start : start + length]
        position += 12 + length
    if exif:
        return xmp, exif
    at = data.rfind(b"eXIf", max(len(data) - (1 << 16), position))
    length = int.from_bytes(data[at - 4 : at], "big") if at > 0 else 0
    found = data[at : at + 4 + length]
    checksum = int.from_bytes(data[at + 4 + length : at + 8 + length], "big")
    return xmp, found[4:] if length and zlib.crc32(found) == checksum else b""


def _jpeg(data: Bytes) -> Header:
    """ITU T.81, annex B.

    The end marker cannot occur inside entropy-coded data, but does occur in EXIF thumbnails, so
    it only counts after the first scan has begun; cameras may append data after it.
    """
    position, size, exif, xmp, components = 2, None, b"", b"", 0
    while True:
        if data[position] != 0xFF:
            raise ValueError
        while data[position] == 0xFF:  # any number of fill bytes
            position += 1
        marker = data[position]
        position += 1
        # markers without a segment: TEM, RST0-7, SOI
        if marker in {0x01, *range(0xD0, 0xD9)}:
            continue
        length = int.from_bytes(data[position : position + 2], "big")
        if marker in set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}:  # SOF0-15; not DHT, JPG, DAC
            if data[position + 2] != 8:
                raise _Unsupported(
                    f"a JPEG of {data[position + 2]} bits; save it with 8, or as PNG"
                )
            height, width = (
                int.from_bytes(data[position + k : position + k + 2], "big") for k in (3, 5)
            )
            size, components = (width, height), data[position + 7]
        elif marker == _JPEG_APP1 and not exif and data[position + 2 : position + 8] == _EXIF:
            exif = data[position + 8 : position + length]
        elif marker == _JPEG_APP1 and data[position + 2 : position + 2 + len(_XMP)] == _XMP:
            xmp = xmp or data[position + 2 + len(_XMP) : position + length]
        elif marker == _JPEG_SCAN:
            if size is None:
                raise ValueError
            if data.rfind(JPEG_END, position) <= 0:
                raise _Truncated
            return _shown("JPEG", *size, _orientation(exif), components == 3, xmp)
        position += max(length, 2)


def _webp(data: Bytes) -> Header:
    """RFC 9649, section 2."""
    end = 8 + int.from_bytes(data[4:8], "little")
    if len(data) < end:
        raise _Truncated
    kind, body = data[12:16], data[20:30]
    if len(body) < 10:
        raise ValueError
    if kind == b"VP8X":
        if body[0] & 0x02:
            raise _Unsupported("an animated WebP; extract its pictures to files of their own")
        width, height = (int.from_bytes(body[at : at + 3], "little") + 1 for at in (4, 7))
    elif kind == b"VP8L":
        bits = int.from_bytes(body[1:5], "little")
        width, height = (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    elif kind == b"VP8 ":
        width, height = (int.from_bytes(body[at : at + 2], "little") & 0x3FFF for at in (6, 8))
    else:
        raise ValueError
    exif, position = b"", 12
    while not exif and position + 8 < end:
        length = int.from_bytes(data[position + 4 : position + 8], "little")
        if data[position : position + 4] == b"EXIF":
            exif = data[position + 8 : position + 8 + length].removeprefix(_EXIF)
        position += 8 + length + length % 2
    return _shown("WebP", width, height, _orientation(exif), False)


def _tiff(data: Bytes) -> Header:
    """TIFF 6.0, sections 2, 3 and 8, of its first picture."""
    tags = _directory(data)
    bits, planes = tags.get(_TiffTag.BITS, (1,)), tags.get(_TiffTag.PLANES, (1,))[0]
    colours, samples = tags.get(_TiffTag.COLOURS, (1,))[0], tags.get(_TiffTag.SAMPLES, (1,))[0]
    deep = max(bits) > 8
    what = ""
    if any(form != 1 for form in tags.get(_TiffTag.FORMAT, (1,))):
        what = "signed or floating-point numbers"
    elif deep and (set(bits) != {16} or colours not in (1, 2) or (planes != 1 and samples > 1)):
        what = f"{max(bits)} bits in an order of its own"
    elif tags.get(_TiffTag.COMPRESSION, (1,))[0] not in _TIFF_COMPRESSIONS:
        what = f"compression {tags[_TiffTag.COMPRESSION][0]}"
    if what:
        raise _Unsupported(f"a TIFF of {what}; save it as PNG, or as TIFF of 8 or 16 bits with LZW")
    for parts, part_sizes in (
        (_TiffTag.STRIPS, _TiffTag.STRIP_SIZES),
        (_TiffTag.TILES, _TiffTag.TILE_SIZES),
    ):
        starts, sizes = tags.get(parts, _NOTHING), tags.get(part_sizes, _NOTHING)
        starts, sizes = (values[: min(len(starts), len(sizes))] for values in (starts, sizes))
        if ((starts > len(data)) | (sizes > len(data) - np.minimum(starts, len(data)))).any():
            raise _Truncated
    if _TiffTag.STRIPS not in tags and _TiffTag.TILES not in tags:
        raise ValueError
    width, height = (int(tags.get(tag, (0,))[0]) for tag in (_TiffTag.WIDTH, _TiffTag.HEIGHT))
    return _shown("TIFF", width, height, _turn(tags), False)


def _directory(data: Bytes) -> dict[int, np.ndarray]:
    """Supported tags of a TIFF's first directory, or of EXIF; of equal tags the first counts."""
    starts = {b"II": "little", b"MM": "big"}
    order = starts.get(data[:2])
    if order not in ("little", "big"):
        raise ValueError

    def number(at: int, size: int) -> int:
        if at + size > len(data):
            raise ValueError
        return int.from_bytes(data[at : at + size], order)

    big = number(2, 2) == 43
    wide, of_count, entry = (8, 8, 20) if big else (4, 2, 12)
    first = number(8 if big else 4, wide)
    tags, wanted = dict[int, np.ndarray](), set(_TiffTag)
    num = number(first, of_count)
    if num > _MAX_TAGS:
        raise ValueError
    for k in range(num):
        at = first + of_count + k * entry
        tag, size, count = number(at, 2), _TIFF_TYPES.get(number(at + 2, 2)), number(at + 4, wide)
        if tag not in wanted or tag in tags or size is None or not count:
            continue
        if count > _MAX_VALUES and tag not in _TIFF_PARTS:
            raise ValueError
        at += 4 + wide
        place = at if size * count <= wide else number(at, wide)
        if place + size * count > len(data):
            raise _Truncated
        kind = np.dtype(f"{'<' if order == 'little' else '>'}u{size}")
        tags[tag] = np.frombuffer(data[place : place + size * count], kind).astype(np.uint64)
    return tags


def _orientation(exif: bytes) -> int:
    """Orientation 1 to 8 in EXIF data; 1 where they hold none that can be read."""
    try:
        return _turn(_directory(exif))
    except (ValueError, _Truncated):
        return 1


def _turn(tags: dict[int, np.ndarray]) -> int:
    turn = int(tags.get(_TiffTag.ORIENTATION, (1,))[0])
    return turn if 1 <= turn <= 8 else 1
