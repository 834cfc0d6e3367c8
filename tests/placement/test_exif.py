"""GPS tags of pictures, written here byte by byte, and by Pillow."""

import struct
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
from command import run_gsba
from PIL import Image
from refusals import refused
from walk_on_earth import ORIGIN, frame_set, geodetic_of, level_metres, walk_result

from gsba.config import PlacementSettings, RefineSettings
from gsba.frames.exif import read_exif
from gsba.log import GsbaError
from gsba.pipeline import refine
from gsba.placement.placement import check, place
from gsba.types import FrameSet

MUNICH = (48.137154, 11.576124, 519.25)
PIXELS = np.full((8, 16, 3), 90, np.uint8)


def gps_of(path: Path) -> tuple[float, float, float] | None:
    """Latitude, longitude and altitude of a picture's position; None = it has none."""
    tag = read_exif(path).gps
    return None if tag is None else (tag.latitude, tag.longitude, tag.altitude)


def _ratios(value: float, whole: int = 10**6) -> list[tuple[int, int]]:
    """Degrees, minutes and seconds, the last to a part in `whole`."""
    degrees, rest = divmod(abs(value) * 3600, 3600)
    minutes, seconds = divmod(rest, 60)
    return [(int(degrees), 1), (int(minutes), 1), (round(seconds * whole), whole)]


def _tiff(fix: tuple[float, float, float | None] | None, order: str, status: str = "A") -> bytes:
    """A TIFF structure with an orientation and, if there is a fix, its GPS directory."""
    gps: list[tuple[int, int, list]] = []
    if fix is not None:
        latitude, longitude, altitude = fix
        gps = [
            (1, 2, [b"N" if latitude >= 0 else b"S", b"\0"]),
            (2, 5, _ratios(latitude)),
            (3, 2, [b"E" if longitude >= 0 else b"W", b"\0"]),
            (4, 5, _ratios(longitude)),
        ]
        if altitude is not None:
            gps += [(5, 1, [int(altitude < 0)]), (6, 5, [(round(abs(altitude) * 1000), 1000)])]
        gps.append((9, 2, [status.encode(), b"\0"]))
    header = (b"II" if order == "<" else b"MM") + struct.pack(order + "HI", 42, 8)
    main = [(0x0112, 3, [1])]
    if fix is None:
        return header + _directory(main, 8, order)
    behind = 8 + 2 + 12 * 2 + 4
    main.append((0x8825, 4, [behind]))
    return header + _directory(main, 8, order) + _directory(gps, behind, order)


def _directory(entries: list[tuple[int, int, list]], at: int, order: str) -> bytes:
    table, data = struct.pack(order + "H", len(entries)), b""
    behind = at + 2 + 12 * len(entries) + 4
    for tag, kind, values in entries:
        if kind == 5:
            raw = b"".join(struct.pack(order + "II", *value) for value in values)
        else:
            raw = b"".join(
                struct.pack(order + {1: "B", 2: "c", 3: "H", 4: "I"}[kind], v) for v in values
            )
        if len(raw) > 4:
            place, data = struct.pack(order + "I", behind + len(data)), data + raw
        else:
            place = raw.ljust(4, b"\0")
        table += struct.pack(order + "HHI", tag, kind, len(values)) + place
    return table + b"\0\0\0\0" + data


def _jpeg(path: Path, tiff: bytes | None) -> Path:
    data = cv2.imencode(".jpg", PIXELS)[1].tobytes()
    if tiff is not None:
        exif = b"Exif\0\0" + tiff
        xmp = b"http://ns.adobe.com/xap/1.0/\0<x/>"  # an APP1 that is none
        segments = [b"\xff\xe1" + struct.pack(">H", len(s) + 2) + s for s in (xmp, exif)]
        app0 = 4 + int.from_bytes(data[4:6], "big")
        data = data[:app0] + b"".join(segments) + data[app0:]
    path.write_bytes(data)
    return path


def _set(folder: Path, fixes: Sequence[tuple[float, float, float | None] | None]) -> FrameSet:
    base = frame_set(len(fixes))
    paths = [
        _jpeg(folder / f"{name}.jpg", _tiff(fix, "<>"[f % 2]))
        for f, (name, fix) in enumerate(zip(base.names, fixes, strict=True))
    ]
    return replace(base, paths=tuple((path,) for path in paths))


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("signs", [(1, 1, 1), (-1, 1, -1), (1, -1, 1), (-1, -1, -1)])
def test_fixes_are_read_to_the_last_digit(
    tmp_path: Path, order: str, signs: tuple[int, ...]
) -> None:
    fix = tuple(s * v for s, v in zip(signs, MUNICH, strict=True))
    found = gps_of(_jpeg(tmp_path / "a.jpg", _tiff(fix, order)))  # type: ignore[arg-type]
    assert found == pytest.approx(fix, abs=2e-10)  # a millionth of a second of arc


def test_png_has_tags_too(tmp_path: Path) -> None:
    data = cv2.imencode(".png", PIXELS)[1].tobytes()
    tiff = _tiff(MUNICH, "<")
    chunk = struct.pack(">I", len(tiff)) + b"eXIf" + tiff + b"crc!"
    (tmp_path / "a.png").write_bytes(data[:-12] + chunk + data[-12:])
    assert gps_of(tmp_path / "a.png") == pytest.approx(MUNICH, abs=2e-10)
    (tmp_path / "b.png").write_bytes(data)
    assert gps_of(tmp_path / "b.png") is None


def test_no_fix_is_no_position(tmp_path: Path) -> None:
    assert gps_of(_jpeg(tmp_path / "bare.jpg", None)) is None
    assert gps_of(_jpeg(tmp_path / "exif.jpg", _tiff(None, "<"))) is None
    assert gps_of(_jpeg(tmp_path / "lost.jpg", _tiff(MUNICH, "<", "V"))) is None
    assert gps_of(_jpeg(tmp_path / "zero.jpg", _tiff((0.0, 0.0, 0.0), "<"))) is None
    low = gps_of(_jpeg(tmp_path / "flat.jpg", _tiff((*MUNICH[:2], None), "<")))
    assert low is not None and np.isnan(low[2])


def test_damage_is_told_apart_from_absence(tmp_path: Path) -> None:
    whole = _tiff(MUNICH, "<")
    for cut in range(8, len(whole)):  # wherever it ends behind its header
        path = _jpeg(tmp_path / "cut.jpg", whole[:cut])
        with pytest.raises(ValueError, match="damaged EXIF data"):
            gps_of(path)
    endless = whole[:8] + b"\xff\xff" + whole[10:]
    with pytest.raises(ValueError, match="damaged EXIF data"):
        gps_of(_jpeg(tmp_path / "endless.jpg", endless))
    (tmp_path / "text.jpg").write_text("no picture")
    refused(r"text\.jpg: cannot be read as a picture", gps_of, tmp_path / "text.jpg")


def test_what_pillow_writes_is_read(tmp_path: Path) -> None:
    exif = Image.Exif()
    thirds = (Fraction(48), Fraction(8), Fraction(13754, 1000))
    exif[0x8825] = {1: "N", 2: thirds, 3: "W", 4: (11.0, 34.0, 34.0464), 5: b"\x01", 6: 12.5}
    for name in ("a.jpg", "a.png"):
        Image.fromarray(PIXELS).save(tmp_path / name, exif=exif)
        wanted = (48 + 8 / 60 + 13.754 / 3600, -(11 + 34 / 60 + 34.0464 / 3600), -12.5)
        assert gps_of(tmp_path / name) == pytest.approx(wanted, abs=1e-8)


def test_frames_are_placed_by_their_tags(tmp_path: Path) -> None:
    result = walk_result()
    fixes: list = [tuple(map(float, fix)) for fix in geodetic_of(level_metres(result))]
    fixes[3] = fixes[17] = None
    fixes[20] = (48.2, 11.6, 600.0)  # a false one
    frames = _set(tmp_path, fixes)
    check(PlacementSettings(gps="exif"), frames)
    placed = place(result, frames, PlacementSettings(gps="exif"))
    assert (placed.unit, placed.up) == ("m", "z")
    assert placed.similarity.scale == pytest.approx(1 / 0.21, rel=1e-4)
    assert placed.grounds["gps"]["fixes"] == 38 and placed.grounds["gps"]["outliers"] == 1
    level = level_metres(result)
    moved = placed.similarity.points(result.world_T_rigs[:, :3, 3])
    assert np.allclose(moved - moved[0], level - level[0], atol=2e-3)  # altitudes are in mm
    assert placed.origin is not None and np.allclose(placed.origin[:2], ORIGIN[:2], atol=1e-3)


def test_too_few_positions_are_one_line(tmp_path: Path) -> None:
    for fixes, message in (
        ([None] * 5, "0 of 5 frames have GPS tags"),
        ([MUNICH, MUNICH, None, None], "2 of 4 frames have GPS tags"),
    ):
        frames = _set(tmp_path, fixes)
        for fails in (
            lambda frames=frames: check(PlacementSettings(gps="exif"), frames),
            lambda frames=frames: place(walk_result(), frames, PlacementSettings(gps="exif")),
        ):
            refused(message, fails)


def test_a_run_is_refused_before_it_begins(tmp_path: Path) -> None:
    settings = RefineSettings.model_validate({"placement": {"gps": "exif"}})
    folder = tmp_path / "frames"
    folder.mkdir()
    for k in range(4):
        _jpeg(folder / f"{k}.jpg", None)
    slam = tmp_path / "slam.tum"
    slam.write_text("".join(f"{k} {k} 0 0 0 0 0 1\n" for k in range(4)))
    refused("--gps exif: 0 of 4 frames", refine, folder, slam, tmp_path / "run", settings, fps=1)
    (tmp_path / "walk.mp4").write_bytes(b"")
    with pytest.raises(GsbaError, match="a video's frames have no tags"):
        refine(tmp_path / "walk.mp4", slam, tmp_path / "run", settings)
    arguments = [
        "refine",
        folder,
        slam,
        "--out",
        tmp_path / "run",
        "--fps",
        1,
        "--set",
        "placement.gps=exif",
    ]
    done = run_gsba(*arguments)
    assert done.exit_code == 1 and len(done.stderr.splitlines()) == 1, done.stderr
