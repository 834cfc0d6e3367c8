"""Claims of video files about their pictures, each read from a file made here."""

import struct
from collections.abc import Callable
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from gopro_files import box
from refusals import refused
from two_fisheyes import made_pair, picture
from wave_panorama import wave_panorama

from gsba.frames.files import turned
from gsba.log import GsbaError
from gsba.video.colours import bgr
from gsba.video.recording import VideoPicture, VideoRecording, read_recording, shots

av = pytest.importorskip("av", reason="PyAV is not installed")

WIDTH, HEIGHT = 256, 128
_panorama = partial(wave_panorama, WIDTH)
ONE = 65536
MATRICES = {  # a, b, c, d of EXIF's orientations
    1: (1, 0, 0, 1),
    2: (-1, 0, 0, 1),
    3: (-1, 0, 0, -1),
    4: (1, 0, 0, -1),
    5: (0, 1, 1, 0),
    6: (0, 1, -1, 0),
    7: (0, -1, -1, 0),
    8: (0, -1, 1, 0),
}


def _write(path: Path, pictures: list[np.ndarray], orientation: int = 1, aspect: int = 1) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=2, options={"crf": "4"})
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv444p"
        stream.codec_context.sample_aspect_ratio = Fraction(aspect)
        for k, pixels in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
            frame = frame.reformat(format="yuv444p", dst_colorspace="itu709")
            frame.pts, frame.time_base = k, Fraction(1, 2)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    if orientation > 1:
        data = bytearray(path.read_bytes())
        at = data.find(b"tkhd") + 8 + 20 + 16
        a, b, c, d = (ONE * value for value in MATRICES[orientation])
        data[at : at + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
        path.write_bytes(bytes(data))
    return path


def _with_boxes(path: Path, boxes: bytes) -> Path:
    """Boxes appended to the sample entry of an MP4 whose `moov` lies at the end."""
    data = path.read_bytes()
    assert data.find(b"moov") > data.find(b"mdat")
    start = data.find(b"avc1", data.find(b"stsd")) - 4
    end = start + struct.unpack_from(">I", data, start)[0]
    out = bytearray(data[:end] + boxes + data[end:])
    names = b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"avc1"
    for at in (data.find(name, data.find(b"moov")) - 4 for name in names):
        struct.pack_into(">I", out, at, struct.unpack_from(">I", out, at)[0] + len(boxes))
    path.write_bytes(bytes(out))
    return path


def _stereo(mode: int) -> bytes:
    return box("st3d", bytes(4), bytes([mode]))


def _spherical(yaw: float = 0.0, bounds: tuple[float, float, float, float] = (0, 0, 0, 0)) -> bytes:
    """Boxes of an equirectangular projection; bounds top, bottom, left, right, parts of 1."""
    turn = struct.pack(">3i", round(yaw * ONE), 0, 0)
    edges = struct.pack(">4I", *(round(part * 2**32) for part in bounds))
    projection = box("proj", box("prhd", bytes(4), turn), box("equi", bytes(4), edges))
    return box("sv3d", box("svhd", bytes(4), b"made here\0"), projection)


def _first(recording: VideoRecording) -> VideoPicture:
    return next(shots(recording, [0]))[1][0]


@pytest.mark.parametrize("orientation", MATRICES)
def test_panoramas_are_turned_by_all_display_matrices(tmp_path: Path, orientation: int) -> None:
    shown = _panorama()
    inverse = {6: 8, 8: 6}.get(orientation, orientation)
    stored = turned(shown, inverse)
    recording = read_recording(_write(tmp_path / "a.mp4", [stored] * 3, orientation))
    pixels = _first(recording).bgr()[..., ::-1]
    assert (recording.width, pixels.shape) == (WIDTH, (HEIGHT, WIDTH, 3))
    assert np.abs(pixels.astype(int) - shown).mean() < 3
    assert (len(recording.notes) > 0) == (orientation > 1)


def test_a_panorama_shown_on_its_side_is_refused(tmp_path: Path) -> None:
    with pytest.raises(GsbaError, match="128x256, a panorama on its side"):
        read_recording(_write(tmp_path / "a.mp4", [_panorama()] * 3, 6))


def test_pixels_that_are_not_square_are_made_square(tmp_path: Path) -> None:
    shown = _panorama()
    stored = cv2.resize(shown, (WIDTH, WIDTH))  # pixels twice as wide as high
    recording = read_recording(_write(tmp_path / "a.mp4", [stored] * 3, aspect=2))
    pixels = _first(recording).bgr()[..., ::-1]
    assert pixels.shape == shown.shape
    assert np.abs(pixels.astype(int) - shown).mean() < 3


@pytest.mark.parametrize(("mode", "name"), [(1, "over-under"), (2, "side by side")])
def test_claimed_stereo_is_refused_by_name(tmp_path: Path, mode: int, name: str) -> None:
    path = _with_boxes(_write(tmp_path / "a.mp4", [_panorama()] * 3), _stereo(mode))
    refused(f"stereo, {name}, by its spherical video tags", read_recording, path)


def test_claimed_bounds_are_refused_with_their_angles(tmp_path: Path) -> None:
    boxes = _spherical(bounds=(0.125, 0.125, 0.125, 0.125))
    path = _with_boxes(_write(tmp_path / "a.mp4", [_panorama()] * 3), boxes)
    refused("cropped panorama of 270 x 135 degrees", read_recording, path)


def test_a_claimed_pose_is_noted_and_pixels_stay_as_stored(tmp_path: Path) -> None:
    shown = _panorama()
    boxes = _stereo(0) + _spherical(yaw=30)
    recording = read_recording(_with_boxes(_write(tmp_path / "a.mp4", [shown] * 3), boxes))
    assert "yaw, pitch, roll 30, 0, 0 deg" in recording.notes[0]
    assert np.abs(_first(recording).bgr()[..., ::-1].astype(int) - shown).mean() < 3


def _hdr_frame(signal: np.ndarray, transfer: int) -> Any:
    """Frame of 10 bits, BT.2020, with an HDR signal (H, W) 0..1 for grey."""
    frame = av.VideoFrame(signal.shape[1], signal.shape[0], "yuv444p10le")
    for plane, values in zip(frame.planes, (64 + 876 * signal, 512, 512), strict=True):
        levels = np.zeros((plane.height, plane.line_size // 2), np.uint16)
        levels[:, : plane.width] = np.rint(values)
        plane.update(levels.tobytes())
    frame.color_trc, frame.color_primaries, frame.colorspace = transfer, 9, 9
    return frame


@pytest.mark.parametrize(
    ("transfer", "signals"),
    [
        (18, (0.0, 0.3933, 0.75, 1.0)),  # HLG: black, a fifth of white, white, a highlight
        (16, (0.0, 0.4181, 0.5807, 0.9)),  # PQ: the same; 203 cd/m2 is white
    ],
)
def test_hdr_becomes_srgb(transfer: int, signals: tuple[float, ...]) -> None:
    """Light of 0.195 of white is sRGB's 122."""
    frame = _hdr_frame(np.repeat(np.array(signals), 16)[None].repeat(16, 0), transfer)
    colours = bgr(frame)[8, 8::16]
    assert np.abs(colours.astype(int) - np.array([0, 122, 255, 255])[:, None]).max() <= 2


def _halves(axis: int) -> np.ndarray:
    """Panoramas of two eyes, squeezed into one of 2:1."""
    both = np.concatenate([_panorama(), np.roll(_panorama(), -3, 1)], axis)
    return cv2.resize(both, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize(
    ("draw", "name"),
    [
        (lambda: _halves(0), "stereo, one eye above the other"),
        (lambda: wave_panorama(512)[32:224, 64:448], "a cropped panorama"),
        (
            lambda: np.concatenate([_panorama(), np.roll(_panorama(), -3, 1)]),
            "one eye above the other",
        ),
    ],
    ids=["over-under", "cropped", "square"],
)
def test_what_pictures_show_is_named(
    tmp_path: Path, draw: Callable[[], np.ndarray], name: str
) -> None:
    """More of them, see frames/test_panorama_tags.py: the pictures are judged alike."""
    pixels = draw()
    big = cv2.resize(pixels, (2 * WIDTH, 2 * WIDTH * pixels.shape[0] // pixels.shape[1]))
    refused(name, read_recording, _write(tmp_path / "a.mp4", [big] * 3))


def test_two_fisheyes_one_above_the_other_are_read(tmp_path: Path) -> None:
    front, back = (picture(lens) for lens in made_pair())
    path = _write(tmp_path / "a.mp4", [np.concatenate([front, back])] * 3)
    recording = read_recording(path)
    assert recording.lenses == ("front", "back")
    _, pictures = next(shots(recording, [1]))
    for seen, made in zip(pictures, (front, back), strict=True):
        assert np.abs(seen.bgr()[..., ::-1].astype(int) - made).mean() < 5


def test_a_size_rounded_by_an_encoder_is_named(tmp_path: Path) -> None:
    with pytest.raises(GsbaError, match=r"256x130, nearly 2:1: .*scale=256:128"):
        read_recording(_write(tmp_path / "a.mp4", [_panorama()[np.r_[0, :HEIGHT, -1]]] * 3))
