"""GPano tags of stills, and pictures without tags that are no panoramas."""

import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, PngImagePlugin
from refusals import refused
from two_fisheyes import made_pair, picture
from wave_panorama import wave_panorama

from gsba.frames.files import goes_out_as_it_is, image_header
from gsba.frames.gpano import Crop, read_tags
from gsba.frames.panorama_checks import VR180, unlike_panorama
from gsba.frames.pixels import load_erp
from gsba.frames.scan import scan
from gsba.log import GsbaError
from gsba.masks.borders import find_borders, padded

WIDTH, HEIGHT = 1024, 512
_panorama = partial(wave_panorama, WIDTH)
ROWS, COLUMNS = slice(64, 448), slice(128, 896)  # 135 x 270 degrees, 2:1 again


def _packet(full: tuple[int, int], area: tuple[int, int, int, int], more: str = "") -> bytes:
    left, top, width, height = area
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description '
        f'GPano:ProjectionType="equirectangular" GPano:FullPanoWidthPixels="{full[0]}" '
        f'GPano:FullPanoHeightPixels="{full[1]}" GPano:CroppedAreaLeftPixels="{left}" '
        f'GPano:CroppedAreaTopPixels="{top}"><GPano:CroppedAreaImageWidthPixels>{width}'
        "</GPano:CroppedAreaImageWidthPixels><GPano:CroppedAreaImageHeightPixels>"
        f"{height}</GPano:CroppedAreaImageHeightPixels>{more}</rdf:Description></x:xmpmeta>"
    ).encode()


def _write(path: Path, pixels: np.ndarray, packet: bytes | None) -> None:
    if path.suffix == ".png":
        chunks = PngImagePlugin.PngInfo()
        if packet:
            chunks.add_itxt("XML:com.adobe.xmp", packet.decode())
        Image.fromarray(pixels).save(path, pnginfo=chunks)
        return
    Image.fromarray(pixels).save(path, quality=97)
    if packet:
        data, body = path.read_bytes(), b"http://ns.adobe.com/xap/1.0/\0" + packet
        segment = b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body
        path.write_bytes(data[:2] + segment + data[2:])


def _folder(folder: Path, pictures: list[np.ndarray], packet: bytes | None, suffix: str) -> Path:
    folder.mkdir()
    for n, pixels in enumerate(pictures):
        _write(folder / f"{n}{suffix}", np.ascontiguousarray(pixels), packet)
    return folder


CROPPED = _packet((WIDTH, HEIGHT), (128, 64, 768, 384))


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_a_cropped_panorama_is_padded_to_the_sphere(tmp_path: Path, suffix: str) -> None:
    whole = [_panorama(n) for n in range(3)]
    folder = _folder(tmp_path / "a", [each[ROWS, COLUMNS] for each in whole], CROPPED, suffix)
    frames = scan(folder, order_suffices=True)
    assert (frames.format.width, frames.format.height) == (WIDTH, HEIGHT)
    seen = load_erp(frames, 1)
    assert np.abs(seen[ROWS, COLUMNS].astype(int) - whole[1][ROWS, COLUMNS]).mean() < 2
    outside = np.ones((HEIGHT, WIDTH), bool)
    outside[ROWS, COLUMNS] = False
    assert not seen[outside].any()
    assert padded(frames)
    mask = cv2.resize(find_borders(frames).mask.astype(np.uint8), (WIDTH, HEIGHT)) > 0
    assert not mask[outside].any()
    assert mask[80:432, 144:880].all()
    assert not goes_out_as_it_is(frames.paths[0][0], tmp_path / f"b{suffix}")


def test_a_crop_that_was_made_smaller_keeps_its_angles(tmp_path: Path) -> None:
    small = cv2.resize(_panorama()[ROWS, COLUMNS], (384, 192), interpolation=cv2.INTER_AREA)
    _write(tmp_path / "a.jpg", small, CROPPED)
    assert image_header(tmp_path / "a.jpg").crop == Crop(512, 256, 64, 32)


def test_the_attitude_of_the_camera_is_read() -> None:
    names = zip(("PoseHeading", "PosePitch", "PoseRoll"), ("90.5", "-3", "nan"), strict=True)
    more = "".join(f"<GPano:{n}Degrees>{v}</GPano:{n}Degrees>" for n, v in names)
    tags = read_tags(_packet((8, 4), (0, 0, 8, 4), more))
    assert tags is not None and tags.whole
    np.testing.assert_equal(tags.attitude_deg, (90.5, -3.0, np.nan))
    assert read_tags(b"<x:xmpmeta/>") is None


def test_another_projection_is_named(tmp_path: Path) -> None:
    packet = CROPPED.replace(b'"equirectangular"', b'"cylindrical"').replace(b"GPano:Full", b"x")
    folder = _folder(tmp_path / "a", [_panorama(n) for n in range(3)], packet, ".jpg")
    refused("GPano tags say 'cylindrical'", scan, folder, order_suffices=True)


def _stereo(axis: int) -> np.ndarray:
    both = np.concatenate([_panorama(), np.roll(_panorama(), -8, 1)], axis)
    return cv2.resize(both, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize(
    ("draw", "name"),
    [
        (lambda: _panorama()[ROWS, COLUMNS], "a cropped panorama"),
        (lambda: _panorama()[:384, COLUMNS], "a cropped panorama"),
        (lambda: _panorama()[128:, COLUMNS], "a cropped panorama"),
        (lambda: _stereo(0), "stereo, one eye above the other"),
        (lambda: _stereo(1), "stereo, an eye on the left"),
        (lambda: np.tile(_panorama()[:, 256:768], (1, 2, 1)), "VR180"),
        (
            lambda: np.concatenate([_panorama(), np.roll(_panorama(), -8, 1)]),
            "one eye above the other",
        ),
        (lambda: np.concatenate([picture(lens) for lens in made_pair()]), "two fisheyes one above"),
    ],
    ids=[
        "cropped",
        "zenith kept",
        "nadir kept",
        "over-under",
        "side by side",
        "vr180",
        "square",
        "stacked",
    ],
)
def test_what_pictures_show_is_named(
    tmp_path: Path, draw: Callable[[], np.ndarray], name: str
) -> None:
    folder = _folder(tmp_path / "a", [draw()] * 3, None, ".jpg")
    refused(name, scan, folder, order_suffices=True)


@pytest.mark.parametrize("change", ["none", "blurred", "dark", "bright", "stitched", "covered"])
def test_true_panoramas_are_read(tmp_path: Path, change: str) -> None:
    pixels, rng = _panorama(), np.random.default_rng(1)
    if change == "blurred":
        pixels = cv2.GaussianBlur(np.tile(pixels, (1, 3, 1)), (0, 0), 5)[:, WIDTH : 2 * WIDTH]
    elif change == "dark":
        pixels = np.clip(0.08 * pixels + rng.normal(0, 2, pixels.shape), 0, 255).astype(np.uint8)
    elif change == "bright":
        pixels = np.clip(4.0 * pixels, 0, 255).astype(np.uint8)
    elif change == "stitched":  # the back lens 2 degrees off and brighter
        pixels[:, :512] = np.clip(1.1 * np.roll(pixels, 5, 0)[:, :512], 0, 255)
    elif change == "covered":  # a fisheye's carrier at the bottom, and a stripe of text on top
        cv2.ellipse(pixels, (340, HEIGHT), (130, 130), 0, 0, 360, (40, 40, 40), -1)
        pixels[:30, :512] = 255 * (np.arange(512)[None, :, None] // 16 % 2)
    folder = _folder(tmp_path / "a", [pixels] * 3, None, ".jpg")
    assert scan(folder, order_suffices=True).format.layout == "erp"


def test_black_poles_and_painted_shapes_become_mask(tmp_path: Path) -> None:
    pictures = [_panorama(n) for n in range(3)]
    for pixels in pictures:
        pixels[:50], pixels[-70:] = 0, 0
        cv2.ellipse(pixels, (300, 400), (60, 60), 0, 0, 360, (0, 0, 0), -1)
        pixels[200, 300] = 0
    borders = find_borders(scan(_folder(tmp_path / "a", pictures, None, ".jpg"), fps=1.0))
    mask = cv2.resize(borders.mask.astype(np.uint8), (WIDTH, HEIGHT)) > 0
    assert not (mask[:52].any() or mask[-72:].any() or mask[400, 300])
    assert mask[70:330].all()


def test_panoramas_have_no_black_borders(tmp_path: Path) -> None:
    frames = scan(_folder(tmp_path / "a", [_panorama(n) for n in range(3)], None, ".jpg"), fps=1.0)
    assert find_borders(frames).share == 0


def test_folders_of_pictures_are_offered_as_recordings(tmp_path: Path) -> None:
    for name in ("01", "02"):
        _folder(tmp_path / name, [_panorama()], None, ".jpg")
    with pytest.raises(GsbaError, match=r"in 2 folders \(01, 02\).*gsba refine .*01 .*02 --out"):
        scan(tmp_path, order_suffices=True)


def test_photos_of_gopro_are_named(tmp_path: Path) -> None:
    (tmp_path / "GS010001.36P").write_bytes(b"\xff\xd8")
    refused(r"but 1 GoPro \.36P image: convert them first", scan, tmp_path, order_suffices=True)


def test_pictures_without_contrast_do_not_tell_half_spheres_from_whole_ones() -> None:
    half = cv2.cvtColor(_panorama()[:, 256:768], cv2.COLOR_RGB2GRAY)
    pale = (128 + 0.1 * (half.astype(np.float32) - 128)).astype(np.uint8)
    pale[::9, ::9] += 20  # detail that repeats, but no contrast between far columns
    shown = [np.tile(one, (1, 2)) for one in (pale, half, pale, half, pale)]
    assert unlike_panorama(shown) == VR180
