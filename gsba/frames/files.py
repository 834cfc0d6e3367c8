"""Image files: size and completeness from the headers alone, and decoding."""

import mmap
import re
from functools import partial
from pathlib import Path

import numpy as np

from gsba.log import GsbaError

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
MAX_PIXELS = 1 << 28  # of one image: 768 MB of colours

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"IEND\xaeB`\x82"  # chunk type and its constant CRC
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_JPEG_BARE = {0x01, *range(0xD0, 0xD9)}  # markers without a segment: TEM, RST0-7, SOI
_JPEG_FRAME = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOF0-15; not DHT, JPG, DAC
_JPEG_SCAN = 0xDA  # SOS
_MOST_PADDING, _FILLS = 1024, (b"\0", b"\xff")  # bytes before the end, and what they are


def is_image(path: Path) -> bool:
    """Whether the name is that of a visible JPEG or PNG file."""
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of a JPEG or PNG as stored (EXIF orientation ignored), without decoding.

    Raises:
        GsbaError: unreadable, neither JPEG nor PNG, its end is missing (truncated), or it has more
            than MAX_PIXELS.
    """
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return _size_in(data, path)
    except OSError as error:
        raise GsbaError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError:  # mmap refuses an empty file
        raise GsbaError(f"{path}: truncated or damaged image; copy or extract it again") from None


def _size_in(data: mmap.mmap | bytes, path: Path) -> tuple[int, int]:
    """Width and height in an image file's content."""
    try:
        if data[:8] == _PNG_SIGNATURE:
            (width, height), complete = _png_header(data)
        elif data[:2] == _JPEG_START:
            (width, height), complete = _jpeg_header(data)
        else:
            raise GsbaError(f"{path}: not a JPEG or PNG image; remove or convert it")
    except (IndexError, ValueError):  # ran past the end
        raise GsbaError(f"{path}: truncated or damaged image; copy or extract it again") from None
    if not complete:
        raise GsbaError(f"{path}: truncated image (its end is missing); copy or extract it again")
    if width * height > MAX_PIXELS:
        raise GsbaError(
            f"{path}: is {width}x{height}, {width * height / 1e6:.0f} megapixels; "
            f"{MAX_PIXELS / 1e6:.0f} are read at most: make it smaller"
        )
    return width, height


def _png_header(data: mmap.mmap | bytes) -> tuple[tuple[int, int], bool]:
    """(width, height), and whether the end chunk is there. PNG 1.2, sections 3 and 4."""
    if len(data) < 33 or data[12:16] != b"IHDR":
        raise ValueError
    size = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    return size, data.rfind(_PNG_END) > 0


def _jpeg_header(data: mmap.mmap | bytes) -> tuple[tuple[int, int], bool]:
    """(width, height), and whether the end marker follows the scan. ITU T.81, annex B.

    The end marker cannot occur inside entropy-coded data, but does occur in EXIF thumbnails, so
    it only counts after the first scan has begun; cameras may append data after it.
    """
    position, size = 2, None
    while True:
        if data[position] != 0xFF:
            raise ValueError
        while data[position] == 0xFF:  # any number of fill bytes
            position += 1
        marker = data[position]
        position += 1
        if marker in _JPEG_BARE:
            continue
        length = int.from_bytes(data[position : position + 2], "big")
        if marker in _JPEG_FRAME:
            height, width = (
                int.from_bytes(data[position + k : position + k + 2], "big") for k in (3, 5)
            )
            size = width, height
        elif marker == _JPEG_SCAN:
            if size is None:
                raise ValueError
            return size, data.rfind(_JPEG_END, position) > 0
        position += max(length, 2)


def decode(
    path: Path, size: tuple[int, int], gray: bool = False, at_least: int | None = None
) -> np.ndarray:
    """Pixels of an image, orientation tags ignored.

    Args:
        path: JPEG or PNG.
        size: the width and height it must have.
        gray: one channel instead of RGB.
        at_least: width that is enough: a JPEG is decoded at a half, a quarter or an eighth of its
            size, which is fast, as long as it stays that wide.

    Returns:
        (H, W, 3) uint8 RGB, or (H, W) uint8.

    Raises:
        GsbaError: the file is gone, damaged, or has another size.
    """
    try:
        encoded = path.read_bytes()
    except OSError as error:
        raise GsbaError(
            f"{path}: cannot be read ({error.strerror}); it was there when the run began"
        ) from None
    found = _size_in(encoded, path)
    if found != size:
        raise GsbaError(
            f"{path}: is {found[0]}x{found[1]}, was {size[0]}x{size[1]} when the run began"
        )
    if encoded[:2] == _JPEG_START:
        part = max(k for k in (1, 2, 4, 8) if k == 1 or size[0] >= k * (at_least or size[0]))
        return _decoded_jpeg(encoded, path, size, part, gray)
    return _decoded(encoded, path, gray)


def _decoded(encoded: bytes, path: Path, gray: bool) -> np.ndarray:
    """Pixels of a PNG, or of a JPEG of printing inks."""
    import cv2

    flag = cv2.IMREAD_GRAYSCALE if gray else cv2.IMREAD_COLOR
    try:
        values = np.frombuffer(encoded, dtype=np.uint8)
        pixels = cv2.imdecode(values, flag | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise GsbaError(f"{path}: cannot be decoded; copy or extract it again")
    return pixels if gray else cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB, dst=pixels)


def _decoded_jpeg(
    encoded: bytes, path: Path, size: tuple[int, int], part: int, gray: bool
) -> np.ndarray:
    """Pixels of a JPEG at 1 / part of its size; what a decoder would make up is refused."""
    import simplejpeg

    try:
        if simplejpeg.decode_jpeg_header(encoded, strict=False)[2] in ("CMYK", "YCCK"):
            return _decoded(encoded, path, gray)
        least = {"min_width": -(-size[0] // part), "min_height": -(-size[1] // part)}
        wanted = partial(simplejpeg.decode_jpeg, encoded, "GRAY" if gray else "RGB", **least)
        try:
            pixels = wanted()
        except ValueError as error:
            if not _is_padding(str(error), encoded):
                raise
            pixels = wanted(strict=False)
    except (ValueError, KeyError) as error:  # KeyError: of a colour space that there is not
        raise GsbaError(
            f"{path}: damaged ({error}); copy or extract it again, or remove it"
        ) from None
    return pixels[..., 0] if gray else pixels


def _is_padding(complaint: str, encoded: bytes) -> bool:
    """Whether all that a decoder complains of is that some cameras fill up before the end."""
    found = re.search(r"(\d+) extraneous bytes before marker 0xd9", complaint)
    num = int(found[1]) if found else _MOST_PADDING + 1
    return num <= _MOST_PADDING and any(fill * num + _JPEG_END in encoded for fill in _FILLS)
