"""Raw fisheyes on disk: four layouts, lenses of unknown make, and what is refused."""

import json
import logging
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from refusals import refused
from scipy.spatial.transform import Rotation
from two_fisheyes import BEHIND, HALF_FOV, colours, made_pair, picture, turned, write

from gsba.camera.calibration import calibration_json
from gsba.camera.fisheye import Pair, rotation_of
from gsba.camera.sphere import erp_directions
from gsba.frames.image_circles import ImageCircle
from gsba.frames.pixels import load_erp
from gsba.frames.scan import scan
from gsba.frames.side_by_side import two_circles
from gsba.log import GsbaError
from gsba.types import FACES, Fisheye

PAIR = made_pair()
SIDE = 240
LAYOUTS = {
    "front": ("front/{}.png", "back/{}.png"),
    "Front": ("Front/{}.png", "BACK/{}.png"),
    "lens0": ("lens0/{}.png", "lens1/{}.png"),
    "files": ("VID_2024_00_007_{}.png", "VID_2024_10_007_{}.png"),
    "beside": ("{}.png", "{}.png"),
    "FR": ("FR/GPFR7_{}.png", "BK/GPBK7_{}.png"),
    "fr": ("fr/{}.png", "Bk/{}.png"),
    "fusion": ("GPFR0042_{}.png", "GPBK0042_{}.png"),
    "fusion photos": ("GF0100{}.png", "GB0100{}.png"),
}


@cache
def _moved(shift: float):
    """Colours of a sphere turned about its vertical, by frame."""
    turn = Rotation.from_euler("y", shift).as_matrix()
    return lambda directions: colours(directions @ turn)


def _write_pairs(root: Path, layout: str, pair: Pair = PAIR, num: int = 3, seen=_moved) -> Path:
    for frame in range(num):
        shown = [picture(lens, seen(0.4 * frame)) for lens in pair]
        front, back = (root / name.format(f"{frame:03d}") for name in LAYOUTS[layout])
        if front == back:
            write(front, np.concatenate(shown, axis=1))
        else:
            write(front, shown[0])
            write(back, shown[1])
    return root


def _calibration(path: Path, pair: Pair = PAIR) -> Path:
    path.write_text(json.dumps(calibration_json(pair, np.array(pair[0].centre), "m", {})))
    return path


def _nominal(side: int = SIDE, turn: int = 0) -> Pair:
    """Lenses of the kind that is taken where nothing is known, the back one turned by quarters."""
    focal, middle = 0.46 * side / HALF_FOV, side / 2
    none = (0.0, 0.0, 0.0, 0.0)
    front = Fisheye(side, side, focal, (middle + 3.3, middle - 1.7), none, (0.0, 0.0, 0.0))
    back = Fisheye(side, side, 1.02 * focal, (middle - 2.4, middle + 0.8), none, (0.0, 0.0, 0.0))
    spin = Rotation.from_euler("z", 90 * turn, degrees=True).as_matrix()
    return front, turned(back, BEHIND @ spin)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_is_read(tmp_path: Path, layout: str) -> None:
    root = _write_pairs(tmp_path / "raw", layout)
    frames = scan(root, fps=2, calibration=_calibration(tmp_path / "c.json"))
    assert frames.format.layout == "fisheye" and frames.format.panoramic
    assert (frames.format.width, frames.format.height) == (416, 208)
    assert len(frames) == 3 and all(name.endswith(f"00{f}") for f, name in enumerate(frames.names))
    named = [tuple(root / name.format(f"{f:03d}") for name in LAYOUTS[layout]) for f in range(3)]
    assert list(frames.paths) == named
    assert frames.format.fisheyes is not None
    for found, expected in zip(frames.format.fisheyes, PAIR, strict=True):
        np.testing.assert_allclose(rotation_of(found), rotation_of(expected), atol=1e-9)
        assert found.focal == pytest.approx(expected.focal)
        assert found.centre == pytest.approx(expected.centre)
    assert np.abs(load_erp(frames, 2) - _moved(0.8)(erp_directions(416))).mean() < 0.5


def test_times_and_masks_of_raw_pairs(tmp_path: Path) -> None:
    root = _write_pairs(tmp_path / "raw", "lens0")
    (root / "timestamps.csv").write_text("name,timestamp\n001,5\n000,7\n002,6\n")
    mask = write(tmp_path / "mask.png", np.full((208, 416, 3), 255, np.uint8))
    frames = scan(root, masks=mask, calibration=_calibration(tmp_path / "c.json"))
    assert frames.names == ("001", "002", "000")
    assert [paths[1].stem for paths in frames.paths] == ["001", "002", "000"]
    wrong = write(tmp_path / "wrong.png", np.full((120, 240, 3), 255, np.uint8))
    with pytest.raises(GsbaError, match=r"mask is 240x120, but frames are 416x208"):
        scan(root, masks=wrong, calibration=_calibration(tmp_path / "c.json"))


def _found_within_half_a_pixel(root: Path, pair: Pair) -> Pair:
    """Lenses of pictures whose circles are found where they are."""
    found = scan(root, fps=1).format.fisheyes
    assert found is not None
    for lens, true in zip(found, pair, strict=True):
        np.testing.assert_allclose(lens.principal, true.principal, atol=0.5)
        assert lens.focal * HALF_FOV == pytest.approx(true.focal * HALF_FOV, abs=0.5)
    return found


@pytest.mark.parametrize(
    ("layout", "turn"), [("front", 0), ("front", 1), ("front", 2), ("front", 3), ("beside", 1)]
)
def test_lenses_of_unknown_make(
    tmp_path: Path, layout: str, turn: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Circles within half a pixel; the quarter by which the back lens is turned."""
    pair = _nominal(turn=turn)
    root = _write_pairs(tmp_path, layout, pair)
    with caplog.at_level(logging.INFO):
        found = _found_within_half_a_pixel(root, pair)
    for lens, true in zip(found, pair, strict=True):
        np.testing.assert_allclose(rotation_of(lens), rotation_of(true), atol=1e-9)
        assert lens.radial == (0, 0, 0, 0) and lens.centre == (0, 0, 0)
    assert "unknown lenses, assumed to cover 200 degrees in circles" in caplog.text
    assert ("side by side" in caplog.text) == (layout == "beside")


def test_circles_that_the_frame_cuts_off(tmp_path: Path) -> None:
    pair = tuple(
        Fisheye(SIDE, SIDE, 0.54 * SIDE / HALF_FOV, (121.5, 119.0), (0, 0, 0, 0), lens.rotation)
        for lens in _nominal()
    )
    _found_within_half_a_pixel(_write_pairs(tmp_path, "front", pair), pair)  # type: ignore


@cache
def _four_alike(shift: float):
    """The same after every quarter turn about the lenses' axes."""

    def seen(directions: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis(directions, -1, 0)
        grey = 150 + 60 * np.cos(4 * np.arctan2(y, x)) + 30 * np.sin(9 * z + shift)
        return np.stack([grey] * 3, axis=-1)

    return seen


def _flat(shift: float):
    return lambda directions: np.full(directions.shape, 120 + shift)


@pytest.mark.parametrize("seen", [_four_alike, _flat])
def test_what_does_not_tell_a_turn_is_refused(tmp_path: Path, seen) -> None:
    root = _write_pairs(tmp_path / "raw", "front", _nominal(), seen=seen)
    refused(r"does not determine how one is turned .* --calibration FILE", scan, root, fps=1)
    frames = scan(root, fps=1, calibration=_calibration(tmp_path / "c.json"))
    assert frames.format.fisheyes is not None


def test_a_fusion_folder_is_said_to_be_one(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO):
        scan(_write_pairs(tmp_path, "FR", _nominal()), fps=1)
    assert "raw pairs of a GoPro Fusion, front lens in FR/, back in BK/" in caplog.text


def test_squeezed_pairs_are_read_unsqueezed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    pair = _nominal()
    plain = _write_pairs(tmp_path / "plain", "beside", pair)
    for path in sorted(plain.iterdir()):
        image = cv2.imread(str(path))
        image = cv2.resize(image, (2 * SIDE, 9 * SIDE // 8))
        write(tmp_path / "squeezed" / f"360_{path.name}", image[..., ::-1])
    with caplog.at_level(logging.INFO):
        frames = scan(tmp_path / "squeezed", fps=1)
    assert "they are ellipses: 480x270 is read as 480x240" in caplog.text
    assert "Samsung Gear 360" in caplog.text
    assert frames.format.fisheyes is not None and frames.format.lenses_nominal
    for lens, true in zip(frames.format.fisheyes, pair, strict=True):
        assert (lens.width, lens.height) == (SIDE, SIDE)
        np.testing.assert_allclose(lens.principal, true.principal, atol=1)
        assert lens.focal == pytest.approx(true.focal, rel=0.01)
    assert np.abs(load_erp(frames, 1) - load_erp(scan(plain, fps=1), 1).astype(float)).mean() < 3


def test_circles_that_are_given(tmp_path: Path) -> None:
    pair = _nominal()
    root = _write_pairs(tmp_path, "front", pair)
    circles = [ImageCircle(*lens.principal, lens.focal * HALF_FOV) for lens in pair]
    found = scan(root, fps=1, circles=circles).format.fisheyes
    assert found is not None
    for lens, true in zip(found, pair, strict=True):
        assert lens.principal == true.principal
        assert lens.focal == pytest.approx(true.focal, rel=0.005)
    both = scan(root, fps=1, circles=circles[:1]).format.fisheyes
    assert both is not None and both[0].principal == both[1].principal
    for wrong in (ImageCircle(-5, 100, 90), ImageCircle(100, 300, 90), ImageCircle(100, 100, 400)):
        with pytest.raises(GsbaError, match=r"--circle .*: lies outside of the pictures.* 240x240"):
            scan(root, fps=1, circles=[wrong])


@cache
def _fine(shift: float):
    """Fine structure: what is smooth looks alike under any focal length."""
    waves = np.random.default_rng(5).normal(size=(40, 3)) * 9 + shift

    def seen(directions: np.ndarray) -> np.ndarray:
        grey = 150 + 12 * np.sin(directions @ waves.T).sum(axis=-1)
        return np.clip(np.stack([grey] * 3, axis=-1), 40, 255)

    return seen


@pytest.mark.parametrize("degrees", [95.0, 104.0])
def test_the_seam_tells_how_wide_circles_are(tmp_path: Path, degrees: float) -> None:
    half_fov = np.deg2rad(degrees)
    pair = [replace(lens, focal=0.46 * SIDE / half_fov) for lens in _nominal()]
    for frame in range(3):
        for lens, name in zip(pair, ("front", "back"), strict=True):
            write(tmp_path / name / f"{frame}.png", picture(lens, _fine(frame), half_fov))
    found = scan(tmp_path, fps=1).format.fisheyes
    assert found[0].focal == pytest.approx(pair[0].focal, rel=0.01)


@pytest.mark.parametrize("off", [0.95, 1.05, 1.0])
def test_a_calibration_that_the_seam_contradicts(
    tmp_path: Path, off: float, caplog: pytest.LogCaptureFixture
) -> None:
    pair = _nominal()
    root = _write_pairs(tmp_path / "raw", "front", pair, seen=_fine)
    given = tuple(replace(lens, focal=off * lens.focal) for lens in pair)
    frames = scan(root, fps=1, calibration=_calibration(tmp_path / "c.json", given))  # type: ignore
    assert frames.format.lenses_nominal == (off != 1)
    assert frames.format.fisheyes[0].focal == pytest.approx(pair[0].focal, rel=0.01)
    assert ("c.json does not fit these pictures" in caplog.text) == (off != 1)


@pytest.mark.parametrize(
    ("shown", "name"), [("lit", "front"), ("lit", "back"), ("dark", "back"), ("lamp", "front")]
)
def test_pictures_without_a_circle(tmp_path: Path, shown: str, name: str) -> None:
    root = _write_pairs(tmp_path, "front")
    pixels = np.zeros((SIDE, SIDE, 3), np.uint8)
    if shown == "lit":
        pixels += 100
    if shown == "lamp":
        cv2.circle(pixels, (80, 150), 9, (255, 255, 255), -1)
    for f in range(3):
        write(root / name / f"{f:03d}.png", pixels)
    message = rf"its {name} pictures show no bright circle .*median grey .* --circle X,Y,R .*"
    message += r"--calibration FILE; of a cube, its"
    refused(message, scan, root, fps=1)


def test_a_picture_of_another_size(tmp_path: Path) -> None:
    root = _write_pairs(tmp_path, "front")
    write(root / "back" / "001.png", np.zeros((200, 200, 3), np.uint8))
    message = r"back/001\.png: is 200x200, but 'front/000\.png' is 240x240: both lenses"
    refused(message, scan, root, fps=1)


@pytest.mark.parametrize(
    ("layout", "lens"), [("lens0", 0), ("lens0", 1), ("files", 0), ("files", 1)]
)
def test_a_picture_that_is_missing(tmp_path: Path, layout: str, lens: int) -> None:
    root = _write_pairs(tmp_path, layout)
    names = [name.format("001") for name in LAYOUTS[layout]]
    (root / names[lens]).unlink()
    left, place = names[1 - lens], "_(00|10)_" if layout == "files" else names[lens][:4]
    message = rf"'{left}' has no picture in .*{place}.* of the other lens \(1 of 3\)"
    refused(message, scan, root, fps=1)


def test_one_lens_alone(tmp_path: Path) -> None:
    for layout, left, empty in (
        ("front", "back", "front"),
        ("lens0", "lens0", "lens1"),
        ("FR", "FR", "BK"),
        ("FR", "BK", "FR"),
    ):
        root = _write_pairs(tmp_path / f"without {empty}", layout)
        for path in (root / empty).iterdir():
            path.unlink()
        message = rf"holds {left}/ but no pictures in {empty}/: of raw pairs"
        refused(message, scan, root, fps=1)
    root = _write_pairs(tmp_path / "files", "files")
    for path in root.glob("*_10_*"):
        path.unlink()
    refused(r"no picture in a file _10_ of the other lens \(3 of 3\)", scan, root, fps=1)


def test_a_picture_twice(tmp_path: Path) -> None:
    for layout in ("front", "files"):
        root = _write_pairs(tmp_path / layout, layout)
        path = root / LAYOUTS[layout][1].format("001")
        path.with_suffix(".jpg").write_bytes(path.read_bytes())
        refused(r"001\.jpg' and '.*001\.png' are one frame's picture twice", scan, root, fps=1)


def test_images_that_are_of_neither_lens(tmp_path: Path) -> None:
    root = _write_pairs(tmp_path / "folders", "front")
    write(root / "cover.png", np.zeros((20, 40, 3), np.uint8))
    refused(r"holds both images \('cover.png'\) and folders of lenses", scan, root, fps=1)
    root = _write_pairs(tmp_path / "files", "files")
    write(root / "cover.png", np.zeros((20, 40, 3), np.uint8))
    refused(r"'cover.png' lies among pictures of two lenses", scan, root, fps=1)


def test_other_folders_do_not_hide_the_lenses(tmp_path: Path) -> None:
    root = _write_pairs(tmp_path / "raw", "front")
    write(root / "masks" / "000.png", np.zeros((20, 40, 3), np.uint8))
    frames = scan(root, fps=1, calibration=_calibration(tmp_path / "c.json"))
    assert frames.format.layout == "fisheye"


def test_panoramas_and_cubes_named_by_the_clock_stay_such(tmp_path: Path) -> None:
    grey = np.full((32, 64, 3), 90, np.uint8)
    for second in range(3):
        for minute in ("00", "10"):
            write(tmp_path / "erp" / f"walk_12_{minute}_{second:02d}.jpg", grey)
            for face in FACES:
                name = f"walk_{minute}_{second}_{face}.jpg"
                write(tmp_path / "cube" / name, grey[:, :32])
    frames = scan(tmp_path / "erp", order_suffices=True)
    assert (frames.format.layout, len(frames)) == ("erp", 6)
    frames = scan(tmp_path / "cube", order_suffices=True)
    assert (frames.format.layout, len(frames)) == ("cube", 6)


def test_side_by_side_is_told_from_panoramas(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    raw = _write_pairs(tmp_path / "raw", "beside", _nominal(), num=12)
    for dark in (1, 3):  # two of the five looked at say nothing
        write(raw / f"{dark:03d}.png", np.zeros((SIDE, 2 * SIDE, 3), np.uint8))
    with caplog.at_level(logging.INFO):
        frames = scan(raw, fps=1)
    assert frames.format.layout == "fisheye" and all(one == other for one, other in frames.paths)
    assert "two fisheyes side by side, front left and back right" in caplog.text
    lit = np.rint(_moved(0)(np.random.default_rng(0).normal(size=(SIDE, 2 * SIDE, 3)))) / 9
    write(raw / "006.png", np.clip(lit, 60, 250).astype(np.uint8))  # one with lit corners
    assert scan(raw, fps=1).format.layout == "erp"


def _panorama(kind: str) -> np.ndarray:
    pixels = np.full((SIDE, 2 * SIDE, 3), 130, np.uint8)
    if kind == "black above and below":
        pixels[: SIDE // 4] = pixels[-SIDE // 4 :] = 0
    if kind == "black caps and a lit middle":
        pixels[: SIDE // 10] = pixels[-SIDE // 10 :] = 0
    if kind == "night":
        pixels[:] = 8
        cv2.circle(pixels, (200, 120), 40, (255, 255, 255), -1)
    if kind == "black":
        pixels[:] = 0
    return pixels


@pytest.mark.parametrize(
    "kind", ["lit", "black above and below", "black caps and a lit middle", "night", "black"]
)
def test_panoramas_are_no_circles(
    tmp_path: Path, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    for f in range(3):
        write(tmp_path / f"{f}.png", _panorama(kind))
    with caplog.at_level(logging.INFO):
        assert scan(tmp_path, fps=1).format.layout == "erp"
    black = kind in ("black above and below", "night", "black")
    assert ("around no circles: read as a panorama" in caplog.text) == black


def test_no_more_pictures_are_looked_at_than_needed() -> None:
    taken = []

    def greys():
        for f in range(5):
            taken.append(f)
            yield _panorama("lit")[..., 0]

    assert two_circles(greys(), Path("x")) == (False, ())
    assert taken == [0]
    assert two_circles([], Path("x")) == (False, ())


def test_a_damaged_picture_is_refused_when_it_is_used(tmp_path: Path) -> None:
    raw = _write_pairs(tmp_path / "raw", "beside", _nominal())
    whole = (raw / "001.png").read_bytes()
    (raw / "001.png").write_bytes(whole[:2000] + bytes(500) + whole[2500:])
    frames = scan(raw, fps=1, calibration=_calibration(tmp_path / "c.json"))
    assert frames.format.layout == "fisheye"
    refused(r"001\.png: cannot be decoded", load_erp, frames, 1)


def test_a_calibration_settles_that_dark_pictures_are_side_by_side(tmp_path: Path) -> None:
    for f in range(3):
        write(tmp_path / "raw" / f"{f}.png", _panorama("night"))
    frames = scan(tmp_path / "raw", fps=1, calibration=_calibration(tmp_path / "c.json"))
    assert frames.format.layout == "fisheye"


def test_a_calibration_for_what_is_not_raw(tmp_path: Path) -> None:
    calibration = _calibration(tmp_path / "c.json")
    for f in range(3):
        write(tmp_path / "erp" / f"{f}.jpg", _panorama("lit"))
        for face in FACES:
            write(tmp_path / "cube" / face / f"{f}.jpg", _panorama("lit")[:, :SIDE])
    message = r"erp: holds 2:1 pictures that are lit up to the corners, so panoramas .* c\.json is"
    refused(message, scan, tmp_path / "erp", fps=1, calibration=calibration)
    with pytest.raises(GsbaError, match=r"calibration is for raw fisheyes, but .* cube faces"):
        scan(tmp_path / "cube", fps=1, calibration=calibration)


@pytest.mark.parametrize("layout", ["front", "beside"])
def test_a_calibration_of_another_shape_or_size(tmp_path: Path, layout: str) -> None:
    root = _write_pairs(tmp_path / "raw", layout)
    tree = json.loads(_calibration(tmp_path / "c.json", made_pair(480)).read_text())
    found = scan(root, fps=1, calibration=tmp_path / "c.json").format.fisheyes
    assert found is not None and found[0].width == 240
    assert found[0].focal == pytest.approx(PAIR[0].focal)
    for lens in tree["lenses"].values():
        lens["height"] = 270
    (tmp_path / "c.json").write_text(json.dumps(tree))
    message = r"c\.json: calibrates pictures of 480x270, but these are 240x240: another aspect"
    refused(message, scan, root, fps=1, calibration=tmp_path / "c.json")
