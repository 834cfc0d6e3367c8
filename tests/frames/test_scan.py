"""Frames and masks: layouts, order, times, and every input that must be refused."""

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from refusals import refused

from gsba.frames import masks
from gsba.frames.masks import load_mask
from gsba.frames.pixels import load_erp, load_faces
from gsba.frames.scan import scan, warn_of_repeats
from gsba.log import GsbaError
from gsba.types import FACES, PictureFormat


def write_image(path: Path, width: int = 64, height: int = 32, level: int = 90) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.full((height, width, 3), level, np.uint8)
    pixels[: height // 2, :, 2] = 255  # upper half red (OpenCV order is BGR)
    assert cv2.imwrite(str(path), pixels)
    return path


def write_images(folder: Path, *names: str) -> None:
    for name in names:
        write_image(folder / f"{name}.jpg")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for i in range(4):
        write_image(tmp_path / "frames" / f"{i:04d}.jpg", level=20 * i)
    return tmp_path / "frames"


def test_frames_are_found_again_from_elsewhere(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_image(folder.parent / "mask.png")
    monkeypatch.chdir(folder.parent)
    frames = scan(Path("frames"), fps=1, masks=Path("mask.png"))
    monkeypatch.chdir("/")
    assert load_erp(frames, 1).shape == (32, 64, 3)
    assert load_mask(frames, 1) is not None


@pytest.mark.parametrize(("suffix", "width"), [("jpg", 128), ("jpg", 96), ("png", 128)])
def test_narrower_panoramas_are_averages_of_the_wide_ones(
    tmp_path: Path, suffix: str, width: int
) -> None:
    waves = [np.cos(2 * np.pi * k * np.linspace(0, 1, 512)) for k in (2, 3, 5)]
    rows = np.linspace(0.2, 1, 256)[:, None, None]
    pixels = (127 + 100 * rows * np.stack(waves, axis=-1)).astype(np.uint8)
    for i in range(3):
        path = tmp_path / f"{i}.{suffix}"
        assert cv2.imwrite(str(path), pixels, [cv2.IMWRITE_JPEG_QUALITY, 100])
    frames = scan(tmp_path, fps=1)
    for gray in (False, True):
        whole, found = load_erp(frames, 0, gray), load_erp(frames, 0, gray, width=width)
        mean = cv2.resize(whole, (width, width // 2), interpolation=cv2.INTER_AREA)
        assert found.shape == mean.shape
        assert np.abs(found.astype(int) - mean).max() <= 3  # a pixel of 512 aside would be 6
    assert load_erp(frames, 0, width=1024).shape == (256, 512, 3)


def test_erp_folder_in_order_with_other_files_ignored(folder: Path, caplog) -> None:
    (folder / "README.md").write_text("hello")
    (folder / ".DS_Store").write_bytes(b"\0")
    (folder / "._0000.jpg").write_bytes(b"\0")
    frames = scan(folder, fps=10)
    assert ".DS_Store" in caplog.text  # which stella counts
    assert frames.names == ("0000", "0001", "0002", "0003")
    assert frames.format == PictureFormat("erp", 64, 32)
    np.testing.assert_array_equal(frames.timestamps, [0.0, 0.1, 0.2, 0.3])
    assert frames.mask_paths == (None,) * 4
    image = load_erp(frames, 1)
    assert image.shape == (32, 64, 3) and image.dtype == np.uint8
    assert image[4, 8, 0] > 200 > 100 > image[4, 8, 2]  # red comes first


def test_numbers_without_leading_zeros_are_in_numeric_order(tmp_path: Path, caplog) -> None:
    for i in (9, 10, 11):
        write_image(tmp_path / f"f{i}.PNG")
    assert scan(tmp_path, fps=1).names == ("f9", "f10", "f11")
    assert "numeric order" in caplog.text


def test_pictures_that_are_there_twice_are_named(folder: Path, caplog) -> None:
    warn_of_repeats(scan(folder, fps=1))
    assert "once more" not in caplog.text
    shutil.copy(folder / "0001.jpg", folder / "0001_copy.jpg")
    warn_of_repeats(scan(folder, fps=1))
    assert "1 of 5 frames are the picture before them once more, 0001_copy first" in caplog.text


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_appended_data_is_no_truncation(folder: Path, suffix: str) -> None:
    path = write_image(folder / f"zz9{suffix}")
    path.write_bytes(path.read_bytes() + b"trailer" * 1000)
    assert len(scan(folder, timestamps=_list(folder, 5))) == 5


def _list(folder: Path, n: int) -> Path:
    path = folder.parent / "times.txt"
    path.write_text("\n".join(str(0.5 * i) for i in range(n)))
    return path


def _cube_folders(root: Path, faces: tuple[str, ...]) -> None:
    for face in faces:
        for i in range(3):
            write_image(root / face / f"{i:03d}.png", 32, 32, level=10 * FACES.index(face))


@pytest.mark.parametrize("missing", [(), ("up",), ("down",), ("up", "down")])
def test_cube_subfolders(tmp_path: Path, missing: tuple[str, ...]) -> None:
    faces = tuple(face for face in FACES if face not in missing)
    _cube_folders(tmp_path, faces)
    frames = scan(tmp_path, fps=2)
    assert frames.format == PictureFormat("cube", 32, 32, faces)
    assert frames.names == ("000", "001", "002")
    images = load_faces(frames, 2)
    assert images.shape == (len(faces), 32, 32, 3)
    assert [int(level) for level in images[:, -1, 0, 1]] == [10 * FACES.index(f) for f in faces]


def test_cube_files_with_suffixes(tmp_path: Path) -> None:
    for i in range(3):
        for face in FACES[:5]:
            write_image(tmp_path / f"n_{i}_{face}.jpg", 32, 32)
    frames = scan(tmp_path, fps=2)
    assert frames.names == ("n_0", "n_1", "n_2") and frames.format.faces == FACES[:5]
    assert [path.name for path in frames.paths[1]] == [f"n_1_{f}.jpg" for f in FACES[:5]]


def test_cube_face_missing_from_one_frame(tmp_path: Path) -> None:
    _cube_folders(tmp_path, FACES)
    (tmp_path / "left" / "001.png").unlink()
    refused(r"frame '001' has no left face \(1 of 3", scan, tmp_path, fps=1)
    shutil.rmtree(tmp_path / "left")
    refused(r"no left face", scan, tmp_path, fps=1)


def test_images_that_are_no_cube_faces(tmp_path: Path) -> None:
    _cube_folders(tmp_path / "folders", FACES)
    write_image(tmp_path / "folders" / "pano.jpg")
    refused(r"both images", scan, tmp_path / "folders", fps=1)
    (tmp_path / "folders" / "pano.jpg").unlink()
    write_image(tmp_path / "folders" / "back" / "002.png", 32, 16)
    refused(r"back/002.png: is 32x16; a cube face is square", scan, tmp_path / "folders", fps=1)
    for face in FACES:
        write_image(tmp_path / "files" / f"a_{face}.jpg", 32, 32)
    write_image(tmp_path / "files" / "cover.jpg")
    refused(r"'cover.jpg' lies among cube faces", scan, tmp_path / "files", fps=1)


def test_refused_folders(tmp_path: Path, folder: Path) -> None:
    refused(r"no such file or folder", scan, tmp_path / "none", fps=1)
    refused(r"is a file", scan, folder / "0000.jpg", fps=1)
    (tmp_path / "empty").mkdir()
    refused(r"no JPEG, PNG, WebP or TIFF", scan, tmp_path / "empty", fps=1)
    refused(rf"its pictures are in {folder}: give that folder", scan, tmp_path, fps=1)
    write_image(tmp_path / "mask.png")
    refused(rf"1 frame; .* needed \(its pictures are in {folder}: give", scan, tmp_path, fps=1)
    write_images(tmp_path / "other", "a")
    refused(r"in 2 folders \(frames, other\): give one of them, or all", scan, tmp_path, fps=1)
    for name in ("0002.jpg", "0003.jpg"):
        (folder / name).unlink()
    refused(r"2 frames; at least 3 are needed$", scan, folder, fps=1)


def test_refused_frames(folder: Path) -> None:
    bad = folder / "0002.jpg"
    whole = bad.read_bytes()
    thumbnail = b"\xff\xe1\x00\x06\xff\xd8\xff\xd9"  # an end marker before the scan
    for content, message in [
        (b"", "truncated"),
        (b"plain text, not an image at all", "not a JPEG, PNG"),
        (whole[:-2], "truncated"),
        (whole[: len(whole) // 3], "truncated"),
        (whole[:2] + thumbnail + whole[2:-2], "truncated"),
        (whole[:3], "truncated"),
    ]:
        bad.write_bytes(content)
        refused(f"0002.jpg: .*{message}", scan, folder, fps=1)
    write_image(bad, 66, 32)
    refused(r"0002.jpg: is 66x32; an equirectangular frame is 2:1", scan, folder, fps=1)
    write_image(bad, 48, 32)
    refused(r"48x32; .* cut out its faces, as front/NAME.jpg", scan, folder, fps=1)
    write_image(bad, 128, 64)
    refused(r"0002.jpg: is 128x64, but '0000.jpg' is 64x32: frames", scan, folder, fps=1)
    bad.unlink()
    png = write_image(folder / "0002.png")
    png.write_bytes(png.read_bytes()[:-12])
    refused(r"0002.png: truncated", scan, folder, fps=1)


def test_one_name_twice(folder: Path) -> None:
    write_image(folder / "0001.png")
    refused(r"'0001.jpg' and '0001.png'", scan, folder, fps=1)


def test_frame_that_vanishes_or_breaks_after_the_scan(folder: Path) -> None:
    frames = scan(folder, fps=1)
    (folder / "0000.jpg").unlink()
    refused(r"0000.jpg: cannot be read", load_erp, frames, 0)
    (folder / "0001.jpg").write_bytes(b"\xff\xd8 nothing \xff\xd9")
    refused(r"0001.jpg: truncated or damaged", load_erp, frames, 1)
    write_image(folder / "0002.jpg", 128, 64)
    refused(r"0002.jpg: is 128x64, was 64x32", load_erp, frames, 2)


def test_times_by_name_reorder_frames(folder: Path) -> None:
    (folder / "timestamps.csv").write_text("name,timestamp\n0000.jpg,3\n0001,2\n0002,0\n0003,1\n")
    frames = scan(folder)
    assert frames.names == ("0002", "0003", "0001", "0000")
    np.testing.assert_array_equal(frames.timestamps, [0, 1, 2, 3])
    np.testing.assert_array_equal(scan(folder, fps=4).timestamps, np.arange(4) / 4)


@pytest.mark.parametrize(
    "text",
    [
        "timestamp,name\n0.5,0000\n1.0,0001\n1.5,0002\n2.0,0003\n",
        "# TUM list\r\n0.5 0000.jpg\r\n1.0 0001.jpg\r\n1.5 0002.jpg\r\n2.0 0003.jpg\r\n",
        "0000 0.5\n0001 1.0\n0002 1.5\n0003 2.0\n0004 2.5\n",
        "\n0.5\n1.0\n\n1.5\n2.0\n",
        "\ufefftimestamp\n0.5\n1\n1.5\n2\n",
    ],
)
def test_tables_of_times(folder: Path, tmp_path: Path, text: str) -> None:
    (tmp_path / "t.txt").write_text(text, encoding="utf-8")
    frames = scan(folder, timestamps=tmp_path / "t.txt")
    np.testing.assert_array_equal(frames.timestamps, [0.5, 1.0, 1.5, 2.0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no times"),
        ("name,timestamp\n", "holds no times"),
        ("0\n1\n2\n", "3 times for 4 frames"),
        ("0\n1\nx\n3\n", r"t.txt:3: 'x' is not a time"),
        ("0\n1\nnan\n3\n", r"t.txt:3: 'nan' is not a time"),
        ("0000,0\n0001,1\n0002\n", r"t.txt:3: 1 columns"),
        ("0000,0\n0001,1\n0003,2\n", r"no time for frame '0002' \(1 of 4"),
        ("0000,0\n0001,1\n0002,2\n0002.jpg,3\n0003,4\n", r"t.txt:4: a second time"),
        ("0000,0\n0001,1\n0002,1\n0003,2\n", "'0001' and '0002' have the same time"),
        ("a,b,c\n1,2,3\n", "3 columns"),
    ],
)
def test_refused_tables_of_times(folder: Path, tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "t.txt").write_text(text)
    refused(message, scan, folder, timestamps=tmp_path / "t.txt")


def test_refused_ways_to_give_times(folder: Path, tmp_path: Path) -> None:
    refused(r"cannot be read", scan, folder, timestamps=tmp_path / "none.csv")
    refused(r"pass one", scan, folder, timestamps=_list(folder, 4), fps=1)
    for fps in (0.0, -1.0, float("nan"), float("inf"), 1e-300, 1e300):
        refused(r"positive", scan, folder, fps=fps)
    refused(r"no source gives the times of .* --fps", scan, folder)


def test_fps_refuses_skipped_numbers_but_not_even_steps(tmp_path: Path) -> None:
    write_images(tmp_path, "000", "008", "016")
    np.testing.assert_array_equal(scan(tmp_path, fps=2).timestamps, [0, 0.5, 1])
    write_image(tmp_path / "032.jpg")
    refused(r"skip between '016' and '032'", scan, tmp_path, fps=2)


def test_the_order_of_names_suffices_without_a_trajectory(tmp_path: Path) -> None:
    write_images(tmp_path, "f1", "f2", "f10", "f11")
    frames = scan(tmp_path, order_suffices=True)
    assert frames.names == ("f1", "f2", "f10", "f11") and not frames.timed
    np.testing.assert_array_equal(frames.timestamps, [0, 1, 9, 10])  # seven are missing
    frames = scan(tmp_path, fps=2, order_suffices=True)
    assert not frames.timed
    np.testing.assert_array_equal(frames.timestamps, [0, 0.5, 4.5, 5])
    (tmp_path / "timestamps.csv").write_text("f1,5\nf2,6\nf10,9\nf11,7\n")
    frames = scan(tmp_path, order_suffices=True)
    assert frames.timed and frames.names == ("f1", "f2", "f11", "f10")


@pytest.mark.parametrize(
    ("names", "told"),
    [("a_1 a_2 a_3 b2_1 b2_2 b2_3", "anew after 'a_', 'b2_'"), ("a_1 a_2 a_3 b_1 b_2", "")],
)
def test_names_of_two_films_are_told(
    names: str, told: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_images(tmp_path, *names.split())
    scan(tmp_path, order_suffices=True)
    warnings = [one.getMessage() for one in caplog.records if one.levelname == "WARNING"]
    assert len(warnings) == bool(told) and told in "".join(warnings)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ("0030 0060 0120 0150 0180", [0, 1, 3, 4, 5]),
        ("0 1 2 7 11 12 20", [0, 1, 2, 3, 4, 5, 6]),  # half of them skip: they count otherwise
        ("a1 a2 b1 b3", [0, 1, 2, 3]),
        ("20261126_101558 20261126_101559 20261126_101600 20261126_101601", [0, 1, 2, 3]),
        ("one three two", [0, 1, 2]),
    ],
)
def test_numbers_that_names_skip_are_missing_frames(
    names: str, expected: list[float], tmp_path: Path
) -> None:
    write_images(tmp_path, *names.split())
    np.testing.assert_array_equal(scan(tmp_path, order_suffices=True).timestamps, expected)


@pytest.mark.parametrize("name", [b"a\xff.jpg", b"a\n.jpg"])
def test_names_that_no_table_holds_are_refused(folder: Path, name: bytes) -> None:
    source = folder / "0000.jpg"
    Path(os.fsdecode(os.fsencode(folder) + b"/" + name)).write_bytes(source.read_bytes())
    refused(r"the file name 'a\\(udcff|n)' holds .*: rename it", scan, folder, fps=1)


@pytest.mark.parametrize(
    ("names", "times"),
    [
        (["1651.25", "1651.5", "1652.0"], [1651.25, 1651.5, 1652.0]),
        (
            ["1403636579763555584", "1403636579813555456", "1403636579863555584"],
            [1403636579.763555584, 1403636579.813555456, 1403636579.863555584],
        ),
        (
            ["cam_1700000000000", "cam_1700000000500", "cam_1700000001000"],
            [1700000000.0, 1700000000.5, 1700000001.0],
        ),
    ],
)
def test_names_that_are_times(tmp_path: Path, names: list[str], times: list[float]) -> None:
    write_images(tmp_path, *names)
    np.testing.assert_array_equal(scan(tmp_path).timestamps, times)


@pytest.mark.parametrize(
    "names",
    [
        ["1.0001", "1.0002", "1.0003"],  # a version and a number
        ["20240105123045", "20240105123046", "20240105123047"],  # dates
        ["R0010210", "R0010211", "R0010212"],
        ["a1700000000000", "b1700000000500", "c1700000001000"],
    ],
)
def test_names_that_might_be_times_are_not_guessed(tmp_path: Path, names: list[str]) -> None:
    write_images(tmp_path, *names)
    refused(r"pass --timestamps FILE or --fps", scan, tmp_path)


def write_mask(path: Path, width: int = 64, height: int = 32, white: int = 255) -> Path:
    path.parent.mkdir(exist_ok=True)
    mask = np.full((height, width), white, np.uint8)
    mask[height // 2 :] = 0
    assert cv2.imwrite(str(path), mask)
    return path


def test_one_mask_for_all(folder: Path, tmp_path: Path) -> None:
    path = write_mask(tmp_path / "mask.png")
    frames = scan(folder, fps=1, masks=path)
    mask = load_mask(frames, 3)
    assert mask is not None and mask.dtype == bool and mask.shape == (32, 64)
    assert mask[:16].all() and not mask[16:].any()
    assert load_mask(scan(folder, fps=1), 0) is None


def test_a_mask_of_all_frames_is_decoded_once_as_long_as_it_stays(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, read, decode = write_mask(tmp_path / "mask.png"), [], masks.decode
    monkeypatch.setattr(masks, "decode", lambda *a, **k: read.append(a) or decode(*a, **k))
    frames = scan(folder, fps=1, masks=path)
    first, second = load_mask(frames, 0), load_mask(frames, 1)
    assert first is not None and second is not None and np.array_equal(first, second)
    assert len(read) == 1
    write_mask(path, white=0)
    os.utime(path, ns=(0, 0))
    changed = load_mask(frames, 1)
    assert changed is not None and not changed.any()
    path.unlink()
    refused(r"mask.png: cannot be read", load_mask, frames, 0)


@pytest.mark.parametrize("pattern", ["{}.png", "{}.jpg.png"])
def test_mask_for_each_frame(folder: Path, tmp_path: Path, pattern: str) -> None:
    for i in range(4):
        write_mask(tmp_path / "masks" / pattern.format(f"{i:04d}"))
    frames = scan(folder, fps=1, masks=tmp_path / "masks")
    assert [p.name for p in frames.mask_paths if p] == [
        pattern.format(f"{i:04d}") for i in range(4)
    ]
    (tmp_path / "masks" / pattern.format("0002")).unlink()
    refused(r"no mask for frame '0002' \(1 of 4", scan, folder, fps=1, masks=tmp_path / "masks")


def test_refused_masks(folder: Path, tmp_path: Path) -> None:
    refused(r"cannot be read", scan, folder, fps=1, masks=tmp_path / "none.png")
    small = write_mask(tmp_path / "small.png", 32, 16)
    refused(r"small.png: mask is 32x16, but frames are 64x32", scan, folder, fps=1, masks=small)
    binary = write_mask(tmp_path / "binary.png", white=1)
    refused(r"holds 0 and 1", scan, folder, fps=1, masks=binary)


def test_a_mask_that_hides_the_rest_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder, path, levels = tmp_path / "frames", tmp_path / "mask.png", np.zeros((32, 64), np.uint8)
    folder.mkdir()
    for f in range(3):
        write_image(folder / f"{f:04d}.jpg")
    cv2.imwrite(str(path), levels)
    with pytest.raises(GsbaError, match=r"mask.png: the mask hides all of each picture: 255 = use"):
        scan(folder, fps=1, masks=path)
    levels[24:] = 255  # a carrier: an inverted mask
    cv2.imwrite(str(path), levels)
    scan(folder, fps=1, masks=path)
    assert "hides 85 % of each picture" in caplog.text
    caplog.clear()
    cv2.imwrite(str(path), 255 - levels)
    scan(folder, fps=1, masks=path)
    assert not caplog.records


def test_masks_of_cube_frames_are_panoramas_of_any_size(tmp_path: Path) -> None:
    _cube_folders(tmp_path / "cube", FACES)
    mask = load_mask(scan(tmp_path / "cube", fps=1, masks=write_mask(tmp_path / "m.png")), 0)
    assert mask is not None and mask.shape == (32, 64)
    square = write_mask(tmp_path / "square.png", 32, 32)
    refused(r"equirectangular, 2:1", scan, tmp_path / "cube", fps=1, masks=square)


def _textured(path: Path) -> bytes:
    """A JPEG whose pixels take some kilobytes."""
    pixels = np.random.default_rng(0).integers(0, 255, (64, 128, 3)).astype(np.uint8)
    assert cv2.imwrite(str(path), pixels)
    return path.read_bytes()


@pytest.mark.parametrize("damage", ["zeros", "noise", "cut"])
@pytest.mark.parametrize("width", [None, 64])
def test_a_jpeg_destroyed_in_its_middle_is_named(
    tmp_path: Path, damage: str, width: int | None, capfd: pytest.CaptureFixture[str]
) -> None:
    for i in range(3):
        whole = _textured(tmp_path / f"{i}.jpg")
    middle = len(whole) // 2
    instead = {"zeros": bytes(500), "noise": np.random.default_rng(1).bytes(500), "cut": b""}
    (tmp_path / "1.jpg").write_bytes(whole[:middle] + instead[damage] + whole[middle + 500 :])
    frames = scan(tmp_path, fps=1)
    assert load_erp(frames, 0, width=width).std() > 20
    for gray in (False, True):
        with pytest.raises(GsbaError, match=r"1\.jpg: damaged \(.+\); copy or extract it again"):
            load_erp(frames, 1, gray, width)
    assert capfd.readouterr().err == ""  # no word of the decoder's without a name


@pytest.mark.parametrize("fill", [b"\0", b"\xff"])
def test_bytes_that_fill_a_jpeg_up_are_no_damage(tmp_path: Path, fill: bytes) -> None:
    for i in range(3):
        whole = _textured(tmp_path / f"{i}.jpg")
    (tmp_path / "1.jpg").write_bytes(whole[:-2] + 40 * fill + whole[-2:])
    frames = scan(tmp_path, fps=1)
    np.testing.assert_array_equal(load_erp(frames, 1), load_erp(frames, 0))


def test_jpegs_of_printing_inks_and_of_one_channel(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (64, 128, 3)).astype(np.uint8)
    for i, mode in enumerate(("RGB", "CMYK", "L")):
        Image.fromarray(pixels // 8 + 100).convert(mode).save(tmp_path / f"{i}.jpg", quality=95)
    frames = scan(tmp_path, fps=1)
    first, *others = (load_erp(frames, f) for f in range(3))
    for other in others:
        assert other.shape == first.shape
        assert abs(other.mean() - first.mean()) < 10


def test_too_many_pixels_are_refused_by_the_header(tmp_path: Path) -> None:
    header = b"\0\0\0\rIHDR" + (40000).to_bytes(4, "big") + (20000).to_bytes(4, "big")
    png = b"\x89PNG\r\n\x1a\n" + header + b"\x08\x02\0\0\0" + bytes(30) + b"\0\0\0\0IEND\xaeB`\x82"
    for i in range(3):
        (tmp_path / f"{i}.png").write_bytes(png)
    refused(r"0\.png: is 40000x20000, 800 megapixels; 268 are read", scan, tmp_path, fps=1)


def test_pictures_of_other_kinds_are_counted(folder: Path, caplog) -> None:
    for name in ("a.avif", "b.AViF", "c.jxl", "d.jxl", "e.heic", "notes.txt"):
        (folder / name).write_bytes(b"x")
    assert len(scan(folder, fps=10)) == 4
    (record,) = [
        one for one in caplog.records if one.levelname == "WARNING" and "AVIF" in one.message
    ]
    assert "2 AVIF, 1 HEIC and 2 JPEG XL images" in record.message


def test_pictures_of_other_kinds_alone_are_named(tmp_path: Path) -> None:
    for name in ("a.heic", "b.heic", "notes.txt"):
        (tmp_path / name).write_bytes(b"x")
    message = r"no JPEG, PNG, WebP or TIFF images, but 2 HEIC images: convert them"
    refused(message, scan, tmp_path, fps=1)
    for face in FACES:
        (tmp_path / "faces" / face).mkdir(parents=True)
        (tmp_path / "faces" / face / "a.jp2").write_bytes(b"x")
    refused(r"but 6 JPEG 2000 images", scan, tmp_path / "faces", fps=1)
    (tmp_path / "videos").mkdir()
    (tmp_path / "videos" / "walk.mp4").write_bytes(b"x")
    refused(r"WebP or TIFF images \(it holds 1 \.mp4\); extract", scan, tmp_path / "videos", fps=1)


def test_a_jpeg_of_unknown_colours_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The decoder looks such colours up where there are none."""
    for i in range(3):
        write_image(tmp_path / f"{i}.jpg")
    frames = scan(tmp_path, fps=1)
    colours: dict[int, str] = {}
    monkeypatch.setattr("simplejpeg.decode_jpeg_header", lambda *_, **__: colours[-1])
    refused(r"1\.jpg: damaged \(-1\)", load_erp, frames, 1)
