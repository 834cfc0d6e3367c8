"""Image files: size and completeness from the headers alone, and decoding."""

import mmap
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gsba.frames.gpano import Crop
from gsba.frames.headers import JPEG_END, Header, header_of
from gsba.log import GsbaError

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".insp")  # the last: JPEG
EXTRACTED = "extract.json"  # marker of a folder of extracted frames
Found = dict[str, tuple[Path, ...]]  # frame -> picture of each lens, the front one first

_MAX_PADDING_BYTES, _PADDING_VALUES = 1024, (b"\0", b"\xff")  # largest number of padding bytes
# before the end, and their values


def entries_of(folder: Path) -> list[Path]:
    """Files and folders in a folder, in the order of their names. Raises GsbaError: it is no
    folder, or cannot be read."""
    try:
        return sorted(folder.iterdir())
    except FileNotFoundError:
        raise GsbaError(f"{folder}: no such file or folder") from None
    except NotADirectoryError:
        raise GsbaError(f"{folder}: is a file; give the folder of extracted frames") from None
    except OSError as error:
        raise GsbaError(f"{folder}: cannot be read ({error.strerror})") from None


def images_in(folder: Path) -> list[Path]:
    """Images in a folder, in name order; none if it is no folder."""
    return list(filter(is_image, entries_of(folder))) if folder.is_dir() else []


def images_by_name(
    folder: Path, images: Iterable[Path], name_of: Callable[[str], str] = str
) -> dict[str, Path]:
    """Images by frame name, which is that of their stem. Raises GsbaError: two of them have one
    name in `folder`, the folder of all frames."""
    found: dict[str, Path] = {}
    for path in images:
        one = found.setdefault(name_of(path.stem), path)
        if one != path:
            raise GsbaError(
                f"{folder}: '{one.name}' and '{path.name}' are one frame's picture twice: keep one"
            )
    return found


def paired(folder: Path, found: Sequence[Mapping[str, Path]], kinds: Sequence[str]) -> Found:
    """Pictures of both lenses of each frame, of those of each one by frame name; kinds: what holds
    a lens's pictures, for messages. Raises GsbaError: one has no counterpart."""
    for ours, theirs, kind in ((*found, kinds[1]), (*found[::-1], kinds[0])):
        missing = sorted(ours.keys() - theirs.keys())
        if missing:
            raise GsbaError(
                f"{folder}: '{ours[missing[0]].relative_to(folder)}' has no picture in {kind} of "
                f"the other lens ({len(missing)} of {len(ours)}); remove it, or extract both alike"
            )
    return {name: (path, found[1][name]) for name, path in found[0].items()}


def is_image(path: Path) -> bool:
    """True if the name is that of a visible JPEG, PNG, WebP or TIFF file."""
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image as shown (EXIF orientation respected), without decoding. Raises
    GsbaError: see `image_header`."""
    return image_header(path).size


def image_header(path: Path) -> Header:
    """The header of a JPEG, PNG, WebP or TIFF file. Raises GsbaError: unreadable, no such image,
    its end is missing (truncated), an unsupported variant, or more than MAX_PIXELS."""
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return header_of(data, path)
    except OSError as error:
        raise GsbaError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError:  # mmap refuses an empty file
        raise GsbaError(f"{path}: truncated or damaged image; copy or extract it again") from None


def goes_out_as_it_is(source: Path, target: Path) -> bool:
    """True if every trainer can read a copy of an image under another name.

    That is an upright JPEG or PNG of 8 bits in colour. COLMAP and trainers ignore the orientation
    tag, COLMAP reads no WebP, and nerfstudio takes 16-bit grey modulo 256.
    """
    same = source.suffix.lower() == target.suffix.lower()
    return same and source.is_file() and image_header(source).plain


def decode(
    path: Path,
    size: tuple[int, int],
    gray: bool = False,
    at_least: int | None = None,
    room: np.ndarray | None = None,
) -> np.ndarray:
    """Pixels of an image as shown: turned by the orientation tag, 16 bits scaled to 8.

    Args:
        path: JPEG, PNG, WebP or TIFF.
        size: the width and height it must have, as shown.
        at_least: width that is enough: a JPEG is decoded at a half, a quarter or an eighth of its
            size, which is fast, as long as it stays that wide.
        room: (N,) uint8, one for each value of the result: most JPEGs are decoded into it.

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
    header = header_of(encoded, path)
    if header.size != size:
        raise GsbaError(
            f"{path}: is {header.width}x{header.height}, was {size[0]}x{size[1]} when the run began"
        )
    if header.kind != "JPEG":
        pixels = _decoded(encoded, path, gray)
    elif header.crop is not None:
        pixels = _decoded_jpeg(encoded, path, (0, 0), 1, gray, None)
    else:
        part = max(k for k in (1, 2, 4, 8) if k == 1 or size[0] >= k * (at_least or size[0]))
        stored = (size[1], size[0]) if header.swapped else size
        pixels = _decoded_jpeg(encoded, path, stored, part, gray, room)
    if header.crop is not None:
        return _padded(pixels, header.crop)
    upright = header.kind == "TIFF"  # OpenCV turns TIFFs by their tag in any case
    return pixels if upright else turned(pixels, header.orientation)


def _padded(pixels: np.ndarray, crop: Crop) -> np.ndarray:
    """Whole panorama (H, 2H[, 3]) uint8, black where a part (h, w[, 3]) does not show it."""
    whole = np.zeros((crop.height, crop.width, *pixels.shape[2:]), np.uint8)
    rows, columns = pixels.shape[:2]
    whole[crop.top : crop.top + rows, crop.left : crop.left + columns] = pixels
    return whole


def turned(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Stored pixels (h, w[, 3]) turned for display. Exif 3.0, section 4.6.5, tag 0x0112."""
    if orientation == 1:
        return pixels
    if orientation > 4:  # 5 to 8 are 1 to 4 of the transposed picture
        pixels, orientation = pixels.swapaxes(0, 1), orientation - 4
    down = -1 if orientation in (3, 4) else 1
    across = -1 if orientation in (2, 3) else 1
    return np.ascontiguousarray(pixels[::down, ::across])


def _decoded(encoded: bytes, path: Path, gray: bool) -> np.ndarray:
    """Pixels of a file that is no JPEG, or of a JPEG in printing inks."""
    import cv2

    flag = cv2.IMREAD_GRAYSCALE if gray else cv2.IMREAD_COLOR
    try:
        values = np.frombuffer(encoded, dtype=np.uint8)
        how = flag | cv2.IMREAD_IGNORE_ORIENTATION | cv2.IMREAD_ANYDEPTH
        pixels = cv2.imdecode(values, how)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise GsbaError(f"{path}: cannot be decoded; copy or extract it again")
    if pixels.dtype == np.uint16:
        pixels = cv2.convertScaleAbs(pixels, alpha=1 / 257)  # 65535 becomes 255
    return pixels if gray else cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB, dst=pixels)


def _decoded_jpeg(
    encoded: bytes,
    path: Path,
    size: tuple[int, int],
    part: int,
    gray: bool,
    room: np.ndarray | None,
) -> np.ndarray:
    """Pixels of a JPEG at 1 / part of its size; damage that a decoder would fill in is refused."""
    import simplejpeg

    try:
        if simplejpeg.decode_jpeg_header(encoded, strict=False)[2] in ("CMYK", "YCCK"):
            return _decoded(encoded, path, gray)
        least = {"min_width": -(-size[0] // part), "min_height": -(-size[1] // part)}
        how: dict[str, Any] = {**least, "buffer": room}
        wanted = partial(simplejpeg.decode_jpeg, encoded, "GRAY" if gray else "RGB", **how)
        try:
            pixels = wanted()
        except ValueError as error:
            # Some cameras write padding before the end, which is no damage.
            found = re.search(r"(\d+) extraneous bytes before marker 0xd9", str(error))
            num = int(found[1]) if found else _MAX_PADDING_BYTES + 1
            if not (
                num <= _MAX_PADDING_BYTES
                and any(fill * num + JPEG_END in encoded for fill in _PADDING_VALUES)
            ):
                raise
            pixels = wanted(strict=False)
    except (ValueError, KeyError) as error:  # KeyError: unknown colour space
        raise GsbaError(
            f"{path}: damaged ({error}); copy or extract it again, or remove it"
        ) from None
    return pixels[..., 0] if gray else pixels
