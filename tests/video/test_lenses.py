"""Raw videos of two fisheyes made here: two tracks, two files, side by side; what is refused."""

import json
import logging
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from command import fails, run_gsba, succeed
from refusals import refused
from two_fisheyes import made_pair
from video_files import Track, encode, interrupt, steady, times_of

from gsba.camera.calibration import calibration_json
from gsba.config import RefineSettings, VideoSettings
from gsba.odometry import of_video
from gsba.pipeline.inputs import extract_video
from gsba.store.store import RunStore
from gsba.video import extract, is_video, recording
from gsba.video.recording import read_recording
from gsba.video.timeline import PictureClaims

av = pytest.importorskip("av", reason="PyAV is not installed")

SIDE, BITS = 96, 6
EVERY = VideoSettings(every=1, standing_deg=0)


@cache
def _texture(seed: int, height: int, width: int) -> np.ndarray:
    """Smooth noise (height, width, 3) uint8 that is nowhere black."""
    noise = np.random.default_rng(seed).normal(size=(height, width, 3))
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(140 + 30 * smooth / smooth.std(), 60, 255).astype(np.uint8)


def _radius(height: int = SIDE, width: int = SIDE) -> np.ndarray:
    v, u = np.ogrid[:height, :width]
    return np.hypot(u + 0.5 - width / 2, v + 0.5 - height / 2)


def _lens(name: str, index: int, blur: float = 0.0, shift: int | None = None) -> np.ndarray:
    """What a lens saw: its image circle, in it the instant as bits and the lens as a patch."""
    texture = np.roll(
        _texture(name == "back", SIDE, SIDE), 2 * index if shift is None else shift, 1
    )
    picture = texture.copy()
    for bit in range(BITS):
        picture[42:54, 12 + 12 * bit : 24 + 12 * bit] = 255 * (index >> bit & 1)
    picture[60:72, 42:54] = 255 * (name == "front")
    if blur:
        picture = cv2.GaussianBlur(picture, (0, 0), blur)
    picture[_radius() > SIDE / 2] = 0
    return picture


def _read(path: Path) -> tuple[str, int]:
    """Lens and instant that a picture shows."""
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    scale = grey.shape[0] / SIDE
    cells = [grey[int(48 * scale), int((18 + 12 * bit) * scale)] for bit in range(BITS)]
    lens = "front" if grey[int(66 * scale), int(48 * scale)] > 128 else "back"
    return lens, sum(int(cell > 128) << bit for bit, cell in enumerate(cells))


def _seen(name: str, indices: list[int] | range, ticks: list[int], ahead: int = 0) -> Track:
    """A lens's track of some instants, each at its tick."""
    return [_lens(name, i) for i in indices], [ticks[i] + ahead for i in indices]


def _beside(front: np.ndarray, back: np.ndarray) -> np.ndarray:
    return np.concatenate([front, back], axis=1)


def _check_shown(folder: Path, indices: list[int], ticks: list[int]) -> None:
    """The folder holds both lenses' pictures of just these instants, at their times."""
    times = times_of(folder)
    assert list(times) == [f"{i:06d}.jpg" for i in indices]
    expected = (np.array(ticks)[indices] - ticks[0]) / 90_000
    np.testing.assert_allclose(list(times.values()), expected, atol=1e-9)
    for lens in ("front", "back"):
        paths = sorted((folder / lens).iterdir())
        assert [path.name for path in paths] == list(times)
        assert [_read(path) for path in paths] == [(lens, i) for i in indices]
    left = {path.name for path in folder.iterdir()}
    assert left == {"front", "back", "timestamps.csv", "extract.json"}


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One file with a track for each lens, 40 instants at 30 fps."""
    path = tmp_path_factory.mktemp("film") / "VID_20240101_120000_00_001.insv"
    tracks = [_seen(lens, range(40), steady(40)) for lens in ("front", "back")]
    return encode(path, *tracks, container_format="mp4")


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_two_tracks(tmp_path: Path, suffix: str) -> None:
    """Variable frame rate, a start not at zero: equal names show one instant at its time."""
    rng = np.random.default_rng(1)
    ticks = (90 * (np.cumsum(rng.integers(20, 60, 40)) + 700)).tolist()
    tracks = [_seen(lens, range(40), ticks) for lens in ("front", "back")]
    video = encode(tmp_path / f"v.{suffix}", *tracks)
    counts = extract(video, tmp_path / "frames", VideoSettings(every=3, standing_deg=0))
    assert (counts.received, counts.kept) == (40, 14)
    _check_shown(tmp_path / "frames", list(range(0, 40, 3)), ticks)


def test_hdr_of_raw_lenses_is_noted(film: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "read_claims", lambda _: PictureClaims(hdr="HLG"))
    notes = read_recording(film).notes
    assert f"{film}: HDR (HLG), converted to sRGB; brighter than white clips" in notes


def test_tracks_out_of_step(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Frames pair by time, not by number: a lens late by a third of a frame, some frames gone."""
    front = [i for i in range(40) if i not in (7, 20)]
    back = [i for i in range(40) if i not in (5, 6, 20, 31)]
    ticks = steady(40)
    tracks = _seen("front", front, ticks), _seen("back", back, ticks, 1000)
    video = encode(tmp_path / "v.mp4", *tracks)
    with caplog.at_level(logging.INFO):
        counts = extract(video, tmp_path / "frames", EVERY)
    both = [i for i in front if i in back]
    assert counts.received == counts.kept == len(both)
    paths = [sorted((tmp_path / "frames" / lens).iterdir()) for lens in ("front", "back")]
    assert [path.name for path in paths[0]] == [path.name for path in paths[1]]
    assert [_read(path) for path in paths[0]] == [("front", i) for i in both]
    assert [_read(path) for path in paths[1]] == [("back", i) for i in both]
    np.testing.assert_allclose(
        list(times_of(tmp_path / "frames").values()), np.array(both) / 30, atol=1e-9
    )
    assert "4 instants are left out, which only one lens has (3 front, 1 back)" in caplog.text
    assert "two tracks of 96x96: front lens, back lens" in caplog.text


@pytest.mark.parametrize("given", [0, 1])
@pytest.mark.parametrize(
    "names",
    [
        ("VID_20200101_101010_00_007.insv", "VID_20200101_101010_10_007.insv"),
        ("GPFR0007.MP4", "GPBK0007.MP4"),
        ("GF010007.mp4", "GB010007.mp4"),
    ],
)
def test_two_files(tmp_path: Path, names: tuple[str, str], given: int) -> None:
    ticks = steady(20)
    for name, lens in zip(names, ("front", "back"), strict=True):
        encode(tmp_path / name, _seen(lens, range(20), ticks), container_format="mp4")
    video = tmp_path / names[given]
    assert is_video(video)
    extract(video, tmp_path / "frames", VideoSettings(fps=6, standing_deg=0))
    _check_shown(tmp_path / "frames", [0, 5, 10, 15], ticks)


def test_the_other_file_counts_for_what_was_extracted(tmp_path: Path) -> None:
    paths = [tmp_path / f"v{mark}1.mp4" for mark in ("_00_", "_10_")]
    for path, lens in zip(paths, ("front", "back"), strict=True):
        encode(path, _seen(lens, range(8), steady(8)))
    extract(paths[0], tmp_path / "frames", EVERY)
    extract(paths[1], tmp_path / "frames", EVERY)  # the same
    encode(paths[1], _seen("back", range(1, 9), steady(9), -3000))
    refused("another extraction", extract, paths[0], tmp_path / "frames", EVERY)


def test_a_panorama_named_like_one_of_a_pair_is_a_panorama(tmp_path: Path) -> None:
    panorama = [_texture(i, SIDE, 2 * SIDE) for i in range(4)]
    for mark in ("_00_", "_10_"):
        encode(tmp_path / f"v{mark}1.mp4", (panorama, steady(4)))
    extract(tmp_path / "v_00_1.mp4", tmp_path / "frames", EVERY)
    assert (tmp_path / "frames/000003.jpg").is_file()
    assert "lenses" not in json.loads((tmp_path / "frames/extract.json").read_text())


def test_side_by_side(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    pictures = [_beside(_lens("front", i), _lens("back", i)) for i in range(20)]
    pictures[10] = np.zeros_like(pictures[10])  # dark for a moment
    video = encode(tmp_path / "v.insv", (pictures, steady(20)), container_format="mp4")
    with caplog.at_level(logging.INFO):
        extract(video, tmp_path / "frames", VideoSettings(every=3, standing_deg=0))
    _check_shown(tmp_path / "frames", list(range(0, 20, 3)), steady(20))
    assert "two fisheyes side by side, front left and back right" in caplog.text


@pytest.mark.parametrize("radius", [0.46, 0.55])
def test_circles_smaller_and_larger_than_the_frame(tmp_path: Path, radius: float) -> None:
    lens = _texture(0, SIDE, SIDE)
    lens[_radius() > radius * SIDE] = 0
    video = encode(tmp_path / "v.mp4", ([_beside(lens, lens)] * 6, steady(6)))
    assert read_recording(video).lenses == ("front", "back")


def _panorama(kind: str, index: int) -> np.ndarray:
    picture = np.roll(_texture(0, SIDE, 2 * SIDE), 2 * index, axis=1)
    if kind == "nadir":
        picture[-SIDE // 4 :] = 0
    elif kind == "bands":  # a stitched field of view of 100 degrees up and down
        picture[: 2 * SIDE // 9] = picture[-2 * SIDE // 9 :] = 0
    elif kind == "night":
        picture //= 8
    elif kind == "all but once" and index != 6:
        picture = _beside(_lens("front", index), _lens("back", index))
    return picture


@pytest.mark.parametrize("kind", ["nadir", "bands", "night", "all but once"])
def test_black_parts_make_no_fisheyes(tmp_path: Path, kind: str) -> None:
    pictures = [_panorama(kind, i) for i in range(12)]
    video = encode(tmp_path / "v.mp4", (pictures, steady(12)))
    assert read_recording(video).lenses == ()
    extract(video, tmp_path / "frames", EVERY)
    assert cv2.imread(str(tmp_path / "frames/000004.jpg")).shape == (SIDE, 2 * SIDE, 3)


def test_sharpness_is_that_of_both_lenses(tmp_path: Path) -> None:
    """One lens is sharpest at the first instant, the other far sharper at the second."""
    front = [_lens("front", i, blur) for i, blur in enumerate((0, 1.0, 3.0))]
    back = [_lens("back", i, blur) for i, blur in enumerate((3.0, 0, 3.0))]
    video = encode(tmp_path / "v.mp4", (front, steady(3)), (back, steady(3)))
    extract(video, tmp_path / "frames", VideoSettings(every=3, sharpest=True))
    assert _read(tmp_path / "frames/front/000001.jpg") == ("front", 1)
    assert _read(tmp_path / "frames/back/000001.jpg") == ("back", 1)
    assert len(times_of(tmp_path / "frames")) == 1


def test_tracking_goes_on_with_the_same_lenses_alone(tmp_path: Path) -> None:
    """Checkpoints of odometry are of the lenses that the pictures are joined by."""
    front, back = (_seen(lens, range(4), steady(4)) for lens in ("front", "back"))
    video, found = encode(tmp_path / "v.mp4", front, back), []
    for stretch in (1.0, 1.03, 1.0):
        pair = tuple(replace(lens, focal=stretch * lens.focal) for lens in made_pair(SIDE))
        calibration = tmp_path / "calibration.json"
        calibration.write_text(json.dumps(calibration_json(pair, np.zeros(3), "m", {})))
        found.append(of_video(video, calibration=calibration).contents)
    assert found[0] == found[2] != found[1]


def test_a_standing_camera_is_left_out(tmp_path: Path) -> None:
    shifts = [2 * min(i, 10) + 2 * max(i - 30, 0) for i in range(42)]
    tracks = []
    for lens in ("front", "back"):
        pictures = [_lens(lens, 0, shift=shift) for shift in shifts]
        tracks.append((pictures, steady(42)))
    video = encode(tmp_path / "v.mp4", *tracks)
    counts = extract(video, tmp_path / "frames", VideoSettings(every=1))
    assert counts.dropped["while the camera stood"] == 20
    kept = [int(name[:6]) for name in times_of(tmp_path / "frames")]
    assert kept == [*range(11), *range(31, 42)]


def test_range_and_width(film: Path, tmp_path: Path) -> None:
    settings = VideoSettings(every=5, from_s=0.5, to_s=1.0, width=64, standing_deg=0)
    extract(film, tmp_path / "frames", settings)
    _check_shown(tmp_path / "frames", [15, 20, 25, 30], steady(40))
    assert cv2.imread(str(tmp_path / "frames/back/000015.jpg")).shape == (64, 64, 3)
    refused("has only 96 pixels", extract, film, tmp_path / "wide", VideoSettings(width=128))


def test_nearly_square_pictures_stay_whole(tmp_path: Path) -> None:
    """As their lenses are calibrated; GoPro Fusion's are 2704x2624, its circles 2670 across."""
    tracks = []
    for lens in ("front", "back"):
        pictures = [cv2.copyMakeBorder(_lens(lens, i), 0, 0, 4, 4, 0) for i in range(6)]
        tracks.append((pictures, steady(6)))
    video = encode(tmp_path / "v.mp4", *tracks)
    extract(video, tmp_path / "frames", EVERY)
    for n in range(6):
        for lens in ("front", "back"):
            shown = cv2.imread(str(tmp_path / f"frames/{lens}/{n:06d}.jpg"))
            assert shown is not None and shown.shape == (SIDE, SIDE + 8, 3)
            off = np.abs(shown[:, 4:-4, ::-1].astype(int) - _lens(lens, n))
            assert off.mean() < 8


def test_an_interrupted_extraction_goes_on(
    film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = VideoSettings(every=4, sharpest=True)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    extract(film, whole, settings)
    # the front lens of the third frame is there, the back one is not
    calls = interrupt(monkeypatch, "write_bytes", 6)
    with pytest.raises(KeyboardInterrupt):
        extract(film, parts, settings)
    assert (
        len(list((parts / "front").iterdir())) == 3 and len(list((parts / "back").iterdir())) == 2
    )
    other = tmp_path / "other"
    (other / "front").parent.mkdir()
    for path in [p for p in parts.rglob("*") if p.is_file()]:
        (other / path.relative_to(parts)).parent.mkdir(exist_ok=True)
        (other / path.relative_to(parts)).write_bytes(path.read_bytes())
    extract(film, parts, settings)
    assert len(calls) == 6 + 16  # 20 in all: the first two frames are not done again
    for path in [p for p in whole.rglob("*") if p.is_file()]:
        assert (parts / path.relative_to(whole)).read_bytes() == path.read_bytes(), path
    extract(film, parts, settings)  # complete: nothing to do
    assert len(calls) == 6 + 16
    extract(film, other, VideoSettings(every=20, standing_deg=0), replace=True)
    _check_shown(other, [0, 20], steady(40))  # nothing of the interrupted call is left


def test_raw_and_stitched_extractions_replace_each_other(film: Path, tmp_path: Path) -> None:
    panorama = [_texture(i, SIDE, 2 * SIDE) for i in range(4)]
    stitched = encode(tmp_path / "v.mp4", (panorama, steady(4)))
    out = tmp_path / "frames"
    extract(film, out, VideoSettings(every=10))
    refused("another extraction", extract, stitched, out, EVERY)
    extract(stitched, out, EVERY, replace=True)
    assert not (out / "front").exists() and len(list(out.glob("*.jpg"))) == 4
    extract(film, out, VideoSettings(every=10), replace=True)
    assert not list(out.glob("*.jpg")) and len(list((out / "back").iterdir())) == 4
    (out / "back" / "000010.jpg").unlink()  # taken away: made again
    extract(film, out, VideoSettings(every=10))
    assert len(list((out / "back").iterdir())) == 4


def test_frames_of_a_run(film: Path, tmp_path: Path) -> None:
    run, settings = tmp_path / "run", RefineSettings(video=VideoSettings(every=10))
    with RunStore(run, {"frames": film}) as store:
        extract_video(store, film, settings, None)
    _check_shown(run / "frames", [0, 10, 20, 30], steady(40))
    with RunStore(run, {"frames": film}, fresh=True):
        assert not (run / "frames").exists()  # all of it was claimed


def _of_size(width: int, height: int, num: int = 4) -> Track:
    return [_texture(i, height, width) for i in range(num)], steady(num)


@pytest.mark.parametrize(
    ("tracks", "message"),
    [
        ([_of_size(96, 96), _of_size(64, 64)], "tracks of 96x96 and 64x64; those of two lenses"),
        (
            [_of_size(128, 64), _of_size(128, 64)],
            "two stitched video tracks of 2:1 (128x64 and 128x64)",
        ),
        ([_of_size(160, 64), _of_size(160, 64)], "neither fisheyes (square) nor panoramas (2:1)"),
        ([_of_size(96, 96)] * 3, "holds 3 video tracks"),
    ],
)
def test_other_tracks_are_refused(tmp_path: Path, tracks: list[Track], message: str) -> None:
    _refuses(encode(tmp_path / "v.mp4", *tracks), tmp_path / "f", message)


def test_lenses_that_do_not_match_are_refused(tmp_path: Path) -> None:
    out = tmp_path / "f"
    front, ticks = _seen("front", range(20), steady(60)), steady(60)
    later = ([_lens("back", i) for i in range(20)], ticks[30:50])
    video = encode(tmp_path / "later.mp4", front, later)
    _refuses(video, out, "the lenses share no times (front 0 to 0.633 s, back 1.0")
    video = encode(tmp_path / "short.mp4", front, _seen("back", range(17), ticks))
    message = "the back lens's pictures last 0.567 s, the front one's 0.667 s: one is truncated"
    assert "pass --to 0.533" in _refuses(video, out, message)
    succeed("extract", video, "--out", out, "--to", 0.533, "--every", 4)
    video = encode(tmp_path / "alike.mp4", front, _seen("back", range(18), ticks))
    succeed("extract", video, "--out", tmp_path / "g")


def _refuses(video: Path, out: Path, message: str) -> str:
    """The line in which `gsba extract` refuses a video."""
    result = run_gsba("extract", video, "--out", out)
    fails(result, message)
    return result.stderr


def test_files_that_do_not_match_are_refused(tmp_path: Path) -> None:
    front, back, out = (tmp_path / name for name in ("v_00_1.insv", "v_10_1.insv", "f"))
    encode(front, _seen("front", range(20), steady(20)), container_format="mp4")
    _refuses(front, out, "v_10_1.insv is not beside it: copy the other lens's")
    encode(back, _of_size(64, 64, 20), container_format="mp4")
    for given in (front, back):
        _refuses(given, out, "v_10_1.insv is 64x64, but v_00_1.insv, the front lens's")
    encode(back, _seen("back", range(10), steady(20)), container_format="mp4")
    _refuses(front, out, "v_10_1.insv: the back lens's pictures last 0.333 s")
    back.write_bytes(b"no video")
    _refuses(front, out, "v_10_1.insv: cannot be read as video")
    front.unlink()
    encode(back, _seen("back", range(4), steady(4)), container_format="mp4")
    _refuses(back, out, "v_00_1.insv is not beside it")
