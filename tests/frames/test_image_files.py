"""Image files of every kind, depth and orientation: decoded as shown, or refused by name."""

import struct
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps
from refusals import refused

from gsba.frames.files import decode, image_header, image_size
from gsba.frames.pixels import load_erp, load_faces
from gsba.frames.scan import scan
from gsba.log import GsbaError
from gsba.types import FACES

WIDTH, HEIGHT = 64, 32
KINDS = ("a.jpg", "a.png", "a.webp", "a.tif")


def picture(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """RGB (h, w, 3) uint8: smooth, and unlike itself however it is turned or mirrored."""
    across, down = np.linspace(0, 1, width), np.linspace(0, 1, height)[:, None]
    channels = [200 * across + 50 * down, 120 * down + 60 * across**2, 255 - 180 * across * down]
    return np.stack(np.broadcast_arrays(*channels), axis=-1).astype(np.uint8)


def deep(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """RGB (h, w, 3) uint16 with low bits that matter to rounding."""
    noise = np.random.default_rng(0).integers(0, 256, (height, width, 3)).astype(np.uint16)
    return picture(width, height).astype(np.uint16) * 256 + noise


def save(path: Path, pixels: np.ndarray, orientation: int = 1, **options) -> Path:
    """An image by Pillow; without loss where the kind can."""
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    if orientation != 1:
        exif[0x0112] = orientation
    how = {".jpg": {"quality": 100, "subsampling": 0}, ".webp": {"lossless": True}}
    Image.fromarray(pixels).save(path, exif=exif, **how.get(path.suffix, {}), **options)
    return path


def save_tiff(
    path: Path,
    pixels: np.ndarray,
    order: str = "<",
    changed: dict[int, int | Sequence[int]] | None = None,
) -> Path:
    """A TIFF in one strip, written here, with some tags changed."""
    height, width = pixels.shape[:2]
    samples = 1 if pixels.ndim == 2 else pixels.shape[2]
    raw = pixels.astype(f"{order}u{pixels.itemsize}").tobytes()
    bits = 8 * pixels.itemsize
    tags: dict[int, int | Sequence[int]] = {256: width, 257: height, 258: [bits] * samples, 259: 1}
    tags |= {262: 2 if samples == 3 else 1, 273: 8, 274: 1, 277: samples, 278: height}
    tags |= {279: len(raw), 284: 1, 339: [1] * samples} | (changed or {})
    at = 8 + len(raw)
    behind, table = at + 2 + 12 * len(tags) + 4, struct.pack(order + "H", len(tags))
    data = b""
    for tag, value in sorted(tags.items()):
        values = [value] if isinstance(value, int) else list(value)
        long = tag in (256, 257, 273, 278, 279)
        packed = struct.pack(order + ("I" if long else "H") * len(values), *values)
        if len(packed) > 4:
            packed, data = struct.pack(order + "I", behind + len(data)), data + packed
        table += struct.pack(order + "HHI", tag, 4 if long else 3, len(values))
        table += packed.ljust(4, b"\0")
    mark = {"<": b"II", ">": b"MM"}[order]
    header = mark + struct.pack(order + "HI", 42, at)
    path.write_bytes(header + raw + table + bytes(4) + data)
    return path


def check(path: Path, wanted: np.ndarray, off: int) -> None:
    """A file holds pixels RGB, also in grey, to so many levels."""
    size = wanted.shape[1::-1]
    assert image_size(path) == size
    found = decode(path, size)
    assert found.shape == wanted.shape and found.dtype == np.uint8 and found.flags["C_CONTIGUOUS"]
    assert np.abs(found.astype(int) - wanted).max() <= off
    grey = decode(path, size, gray=True)
    assert grey.shape == wanted.shape[:2]
    assert np.abs(grey.astype(int) - cv2.cvtColor(wanted, cv2.COLOR_RGB2GRAY)).max() <= off + 1


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("orientation", range(1, 9))
def test_every_kind_is_read_as_it_is_to_be_shown(
    tmp_path: Path, name: str, orientation: int
) -> None:
    path = save(tmp_path / name, picture(), orientation)
    header = image_header(path)
    assert header.orientation == orientation
    assert header.plain == (orientation == 1 and name in ("a.jpg", "a.png"))
    with Image.open(path) as stored:
        wanted = np.array(ImageOps.exif_transpose(stored.convert("RGB")))
    check(path, wanted, 3 if name == "a.jpg" else 0)
    assert orientation == 1 or not np.array_equal(wanted, picture())


def test_a_turned_jpeg_is_made_smaller_by_its_shown_width(tmp_path: Path) -> None:
    path = save(tmp_path / "a.jpg", picture(256, 512), 6)
    whole = decode(path, (512, 256))
    half = decode(path, (512, 256), at_least=256)
    assert half.shape == (128, 256, 3)
    mean = cv2.resize(whole, (256, 128), interpolation=cv2.INTER_AREA)
    assert np.abs(half.astype(int) - mean).max() <= 3


@pytest.mark.parametrize("name", KINDS)
def test_grey_images_have_three_equal_colours(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    levels = picture()[..., 0]
    save(path, levels)
    check(path, np.repeat(levels[..., None], 3, axis=2), 2)
    assert not image_header(path).plain


@pytest.mark.parametrize("name", ["a.png", "a.tif"])
@pytest.mark.parametrize("colours", [1, 3])
def test_sixteen_bits_are_scaled_to_eight(tmp_path: Path, name: str, colours: int) -> None:
    stored = deep() if colours == 3 else deep()[..., 0]
    assert cv2.imwrite(str(tmp_path / name), stored[..., ::-1] if colours == 3 else stored)
    wanted = np.rint(stored / 257).astype(np.uint8)
    check(tmp_path / name, wanted if colours == 3 else np.repeat(wanted[..., None], 3, axis=2), 0)
    assert not image_header(tmp_path / name).plain


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("pixels", [picture(), deep(), picture()[..., 0], deep()[..., 0]])
def test_tiffs_of_either_byte_order_turn(tmp_path: Path, order: str, pixels: np.ndarray) -> None:
    eight = pixels if pixels.dtype == np.uint8 else np.rint(pixels / 257).astype(np.uint8)
    rgb = eight if eight.ndim == 3 else np.repeat(eight[..., None], 3, axis=2)
    for orientation, wanted in ((1, rgb), (2, rgb[:, ::-1]), (6, np.rot90(rgb, -1))):
        path = save_tiff(tmp_path / "a.tif", pixels, order, {274: orientation})
        check(path, wanted, 0)


@pytest.mark.parametrize("how", ["tiff_lzw", "tiff_adobe_deflate", "packbits", "jpeg"])
def test_packed_tiffs_are_read(tmp_path: Path, how: str) -> None:
    check(save(tmp_path / "a.tif", picture(), compression=how), picture(), 9 * (how == "jpeg"))


def test_sizes_of_lossy_and_extended_webp(tmp_path: Path) -> None:
    for k, exif in enumerate((b"", b"Exif\0\0II*\0\x08\0\0\0\0\0")):
        path = tmp_path / f"{k}.webp"
        Image.fromarray(picture(300, 150)).save(path, quality=90, exif=exif)
        assert image_size(path) == (300, 150)
        assert np.abs(decode(path, (300, 150)).astype(int) - picture(300, 150)).max() < 20


def test_a_tag_behind_the_pixels_of_a_png_counts(tmp_path: Path) -> None:
    path = save(tmp_path / "a.png", picture(), 8)
    whole = path.read_bytes()
    at = whole.index(b"eXIf") - 4
    length = 12 + int.from_bytes(whole[at : at + 4], "big")
    moved = whole[:at] + whole[at + length : -12] + whole[at : at + length] + whole[-12:]
    path.write_bytes(moved)
    assert image_header(path).orientation == 8
    path.write_bytes(moved.replace(b"eXIf", b"eXIg"))
    assert image_header(path).orientation == 1


def test_damaged_tags_turn_nothing(tmp_path: Path) -> None:
    path = save(tmp_path / "a.jpg", picture(), 6)
    whole = path.read_bytes()
    at = whole.index(b"Exif\0\0") + 6
    for junk in (b"XX*\0", b"MM\0*\xff\xff\xff\xff"):
        path.write_bytes(whole[:at] + junk + whole[at + len(junk) :])
        assert image_size(path) == (WIDTH, HEIGHT)


def _animated(path: Path) -> None:
    pages = [Image.fromarray(picture()), Image.fromarray(255 - picture())]
    pages[0].save(path, save_all=True, append_images=pages[1:])


def _twelve_bits(path: Path) -> None:
    data = bytearray(save(path, picture()).read_bytes())
    data[data.index(b"\xff\xc0") + 4] = 12
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("name", "write", "message"),
    [
        ("a.webp", _animated, "an animated WebP; extract"),
        ("a.jpg", _twelve_bits, "a JPEG of 12 bits; save it with 8"),
        ("a.tif", lambda p: save_tiff(p, picture(), changed={339: [3] * 3}), "floating-point"),
        ("a.tif", lambda p: save_tiff(p, deep(), changed={284: 2}), "16 bits in an order"),
        ("a.tif", lambda p: save_tiff(p, deep()[..., 0], changed={262: 0}), "16 bits in an order"),
        ("a.tif", lambda p: save_tiff(p, picture(), changed={259: 50000}), "compression 50000"),
        ("a.webp", lambda p: p.write_bytes(b"x"), "not a JPEG, PNG, WebP or TIFF image"),
    ],
)
def test_what_is_not_read_is_named(tmp_path: Path, name: str, write, message: str) -> None:
    write(tmp_path / name)
    refused(rf"{name}: .*{message}", image_size, tmp_path / name)


@pytest.mark.parametrize("name", KINDS)
def test_files_that_end_early_are_refused(tmp_path: Path, name: str) -> None:
    whole = save(tmp_path / name, picture(), 6).read_bytes()
    for part in (1, 9, len(whole) // 3, len(whole) // 2, len(whole) - 20):
        (tmp_path / name).write_bytes(whole[:part])
        refused(rf"{name}: (truncated|not a JPEG|damaged)", image_size, tmp_path / name)


def _tiff_of(entries: list[tuple[int, int, int, int]], size: int) -> bytes:
    """A little-endian TIFF of tags (number, type, count, value or place) and many zeros."""
    directory = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    start = b"II*\0" + struct.pack("<IH", 8, len(entries)) + directory
    return start + bytes(max(size - len(start), 0))


@pytest.mark.parametrize(
    "entries",
    [
        [(273, 4, 499_000, 0)] * 3000,
        [(258, 3, 900_000, 0)] * 3000,
        [(273, 1, 1_900_000, 0), (279, 1, 1_900_000, 0), (256, 3, 1, 8), (257, 3, 1, 4)],
        [(256, 4, 1, 8)] * 60_000,
        [(256, 4, 1, 2**31), (257, 4, 1, 2**31), (273, 4, 1, 8), (279, 4, 1, 8)],
        [(256, 3, 1, 8), (257, 3, 1, 4), (273, 4, 2, 2_000_000), (279, 4, 2, 2**32 - 1)],
    ],
)
def test_a_tiff_is_read_in_time_that_its_size_allows(
    tmp_path: Path, entries: list[tuple[int, int, int, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """3,000 tags in 2 MB, each of half a million values, are 1.5e9 numbers if read one by one."""
    asked, kept = [], np.frombuffer
    monkeypatch.setattr(np, "frombuffer", lambda data, kind: asked.append(data) or kept(data, kind))
    path = tmp_path / "a.tif"
    path.write_bytes(_tiff_of(entries, 2_000_000))
    with suppress(GsbaError):
        image_header(path)
    assert sum(map(len, asked)) <= 2 * 2_000_000


def test_the_first_of_equal_tags_counts(tmp_path: Path) -> None:
    entries = [(256, 3, 1, 8), (257, 3, 1, 4), (256, 3, 1, 80), (273, 4, 1, 8), (279, 4, 1, 32)]
    path = tmp_path / "a.tif"
    path.write_bytes(_tiff_of(entries, 500))
    assert image_size(path) == (8, 4)


def test_a_tiff_whose_pixels_are_cut_off_is_refused(tmp_path: Path) -> None:
    path = save_tiff(tmp_path / "a.tif", picture(), changed={273: 4000})
    refused(r"a\.tif: truncated image", image_size, path)


@pytest.mark.parametrize("suffix", ["webp", "tif", "png"])
def test_folders_of_every_kind(tmp_path: Path, suffix: str) -> None:
    levels = picture(32, 32)[..., 0]
    for i in range(3):
        save(tmp_path / "pano" / f"{i}.{suffix}", picture(), 3 if i == 1 else 1)
        for face in FACES:
            path = tmp_path / "cube" / face / f"{i}.{suffix}"
            path.parent.mkdir(parents=True, exist_ok=True)
            if suffix == "webp":
                save(path, levels)
            else:
                assert cv2.imwrite(str(path), levels.astype(np.uint16) * 257)
    panoramas = scan(tmp_path / "pano", fps=1)
    assert (panoramas.format.width, panoramas.format.height) == (WIDTH, HEIGHT)
    assert np.array_equal(load_erp(panoramas, 1), picture()[::-1, ::-1])
    cube = scan(tmp_path / "cube", fps=1)
    assert cube.format.faces == FACES
    assert np.array_equal(load_faces(cube, 0), [np.repeat(levels[..., None], 3, axis=2)] * 6)


def test_a_panorama_that_its_tag_stands_on_end_is_named(tmp_path: Path) -> None:
    for i in range(3):
        save(tmp_path / f"{i}.jpg", picture(), 6)
    message = r"0\.jpg: is 32x64 as its EXIF orientation 6 shows it; .* 2:1: remove that tag"
    refused(message, scan, tmp_path, fps=1)
