"""Frames from videos made here: which, when, how sharp, resumed, and what is refused."""

import json
from fractions import Fraction
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from command import fails, run_gsba, succeed
from refusals import refused
from video_files import encode, interrupt, steady, times_of

from gsba.config import VideoSettings
from gsba.frames.scan import scan
from gsba.log import GsbaError
from gsba.pipeline import inputs
from gsba.trajectory.conventions import Convention
from gsba.trajectory.files import write_tum
from gsba.types import Trajectory
from gsba.video import extract, extraction, recording
from gsba.video.colours import luma
from gsba.video.likeness import apparent_motion_deg, miniature, sharpness

av = pytest.importorskip("av", reason="PyAV is not installed")

HEIGHT, WIDTH, BITS = 128, 256, 10
NTSC = 3003  # ticks between frames at 29.97 per second


@cache
def _world(seed: int = 0, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """A smooth random panorama (H, W, 3) uint8, continuous over the seam."""
    rng = np.random.default_rng(seed)
    noise = np.tile(rng.normal(size=(height, width, 3)), (1, 3, 1))
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)[:, width : 2 * width]
    return np.clip(128 + 40 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def _picture(index: int, yaw: float, blur: float = 0.0) -> np.ndarray:
    """The world turned by `yaw` pixels, with the index written above the horizon."""
    shift = np.array([[1, 0, yaw % WIDTH], [0, 1, 0]], np.float32)
    picture = cv2.warpAffine(np.tile(_world(), (1, 2, 1)), shift, (2 * WIDTH, HEIGHT))[:, WIDTH:]
    picture = np.ascontiguousarray(picture)
    if blur:
        picture = cv2.GaussianBlur(picture, (0, 0), blur)
    for bit in range(BITS):
        picture[:16, 24 * bit : 24 * bit + 24] = 255 * (index >> bit & 1)
    return picture


def _index_in(image: np.ndarray) -> int:
    scale = image.shape[0] / HEIGHT
    cells = [image[int(8 * scale), int((24 * bit + 12) * scale)].mean() for bit in range(BITS)]
    return sum(int(cell > 128) << bit for bit, cell in enumerate(cells))


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """90 frames of a turning camera at 29.97 fps; every seventh is sharp, the others blurred."""
    pictures = [_picture(i, 1.5 * i, 0 if i % 7 == 3 else 1.5) for i in range(90)]
    return encode(tmp_path_factory.mktemp("film") / "walk.mp4", (pictures, steady(90, NTSC)))


def _indices(folder: Path) -> list[int]:
    return [_index_in(cv2.imread(str(p))) for p in sorted(folder.glob("*.jpg"))]


@pytest.mark.parametrize(
    ("suffix", "codec"), [("mp4", "libx264"), ("mov", "libx265"), ("mkv", "libx264")]
)
def test_times_are_those_of_presentation(tmp_path: Path, suffix: str, codec: str) -> None:
    """Variable frame rate, B-frames, a first frame not at zero: each image has its own time."""
    if codec not in av.codecs_available:
        pytest.skip(f"this FFmpeg has no {codec}")
    rng = np.random.default_rng(1)
    milliseconds = np.cumsum(rng.integers(20, 60, 40)) + 700  # what Matroska can express
    pictures = [_picture(i, 2 * i) for i in range(40)]
    video = encode(tmp_path / f"v.{suffix}", (pictures, 90 * milliseconds), codec=codec)
    counts = extract(video, tmp_path / "frames", VideoSettings(every=3))
    assert (counts.received, counts.kept) == (40, 14)
    times = times_of(tmp_path / "frames")
    expected = (milliseconds - milliseconds[0])[::3] / 1e3
    np.testing.assert_allclose(list(times.values()), expected, atol=1e-9)
    assert list(times) == [f"{i:06d}.jpg" for i in range(0, 40, 3)]
    assert _indices(tmp_path / "frames") == list(range(0, 40, 3))
    frames = scan(tmp_path / "frames")
    np.testing.assert_array_equal(frames.timestamps, list(times.values()))
    assert (frames.format.width, frames.format.height) == (WIDTH, HEIGHT)


@pytest.mark.parametrize(("codec", "reorders"), [("libx264", True), ("mpeg4", False)])
def test_times_of_the_stored_order_are_refused(tmp_path: Path, codec: str, reorders: bool) -> None:
    """As of H.264 with B-frames in AVI, which would give pictures the times of others."""
    video = tmp_path / "walk.avi"
    with av.open(str(video), "w") as container:
        stream = container.add_stream(codec, rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.max_b_frames = 2
        for index in range(30):
            frame = av.VideoFrame.from_ndarray(_picture(index, 2 * index), format="rgb24")
            frame.pts, frame.time_base = index, Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    if reorders:
        refused(
            r"walk\.avi: it states times.*stored", extract, video, tmp_path / "no", VideoSettings()
        )
        return
    extract(video, tmp_path / "frames", VideoSettings(every=7))
    assert _indices(tmp_path / "frames") == [0, 7, 14, 21, 28]


def test_one_frame_a_second_and_the_sharpest_of_it(film: Path, tmp_path: Path) -> None:
    extract(film, tmp_path / "first", VideoSettings(fps=3))
    assert _indices(tmp_path / "first") == [0, 10, 20, 30, 40, 50, 60, 70, 80]
    extract(film, tmp_path / "sharp", VideoSettings(fps=3, sharpest=True))
    chosen = _indices(tmp_path / "sharp")
    assert len(chosen) == 9 and all(i % 7 == 3 for i in chosen)
    times = list(times_of(tmp_path / "sharp").values())
    np.testing.assert_allclose(times, np.array(chosen) * 1001 / 30_000, atol=1e-9)


def test_range_and_width(film: Path, tmp_path: Path) -> None:
    settings = VideoSettings(every=5, from_s=1.0, to_s=2.0, width=128)
    counts = extract(film, tmp_path / "frames", settings)
    assert _indices(tmp_path / "frames") == [30, 35, 40, 45, 50, 55]
    assert counts.dropped["not chosen"] == counts.received - 6
    assert cv2.imread(str(tmp_path / "frames/000030.jpg")).shape == (64, 128, 3)


def test_frames_at_the_times_of_a_trajectory(film: Path, tmp_path: Path) -> None:
    wanted = np.array([3, 4, 40, 89])
    poses = np.tile(np.eye(4), (5, 1, 1))
    times = np.append(wanted * 1001 / 30_000 + 1e-4, 99.0)  # stella's clock rounds; one is outside
    write_tum(tmp_path / "keyframes.tum", Trajectory(times, poses))
    settings = VideoSettings(at=str(tmp_path / "keyframes.tum"))
    extract(film, tmp_path / "frames", settings)
    assert _indices(tmp_path / "frames") == list(wanted)
    write_tum(tmp_path / "late.tum", Trajectory(times + 50, poses))
    with pytest.raises(GsbaError, match=r"late\.tum: none of its times"):
        extract(film, tmp_path / "none", VideoSettings(at=str(tmp_path / "late.tum")))


def test_a_standing_camera_is_left_out_even_while_people_pass(tmp_path: Path) -> None:
    yaws = [2.0 * min(i, 10) + 2.0 * max(i - 30, 0) for i in range(42)]
    pictures = [_picture(i, yaw) for i, yaw in enumerate(yaws)]
    for i, picture in enumerate(pictures):  # somebody walks through
        cv2.rectangle(picture, (6 * i, 50), (6 * i + 20, 90), (200, 30, 30), -1)
    video = encode(tmp_path / "v.mp4", (pictures, steady(42, NTSC)))
    counts = extract(video, tmp_path / "frames", VideoSettings(every=1))
    assert _indices(tmp_path / "frames") == [*range(11), *range(31, 42)]
    assert counts.dropped["while the camera stood"] == 20
    extract(video, tmp_path / "all", VideoSettings(every=1, standing_deg=0))
    assert _indices(tmp_path / "all") == list(range(42))


def test_likeness_measures() -> None:
    grey = cv2.cvtColor(_world(), cv2.COLOR_RGB2GRAY)
    blurred = cv2.GaussianBlur(grey, (0, 0), 1.0)
    assert sharpness(grey) > 1.5 * sharpness(blurred)
    wide = cv2.resize(grey, (2048, 1024), interpolation=cv2.INTER_CUBIC)
    wide = cv2.GaussianBlur(wide, (0, 0), 12)
    small = miniature(wide)
    assert apparent_motion_deg(small, miniature(wide // 2)) < 0.03  # exposure is no motion
    for pixels in (1, 2):  # of 2048: 0.18 and 0.35 degrees around the horizon
        moved = apparent_motion_deg(small, miniature(np.roll(wide, pixels, axis=1)))
        assert 0.3 * pixels * 360 / 2048 < moved <= pixels * 360 / 2048
    assert apparent_motion_deg(np.ones((64, 128), np.float32), np.ones((64, 128), np.float32)) == 0


def test_an_interrupted_extraction_goes_on(
    film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = VideoSettings(fps=6, sharpest=True)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    extract(film, whole, settings)
    calls = interrupt(monkeypatch, "_encoded", 5)
    with pytest.raises(KeyboardInterrupt):
        extract(film, parts, settings)
    assert len(list(parts.glob("*.jpg"))) == 4 and not (parts / "timestamps.csv").exists()
    extract(film, parts, settings)
    assert len(calls) == 5 + 14  # 18 in all: the first four are not done again
    for path in sorted(whole.iterdir()):
        assert (parts / path.name).read_bytes() == path.read_bytes(), path.name
    extract(film, parts, settings)  # complete: nothing to do
    assert len(calls) == 5 + 14
    assert sorted(p.name for p in parts.iterdir()) == sorted(p.name for p in whole.iterdir())


def test_frames_of_two_extractions_do_not_mix(film: Path, tmp_path: Path) -> None:
    out = tmp_path / "frames"
    extract(film, out, VideoSettings(every=30))
    refused(r"another extraction.*--fresh", extract, film, out, VideoSettings(every=20))
    extract(film, out, VideoSettings(every=20), replace=True)
    assert _indices(out) == [0, 20, 40, 60, 80]
    assert json.loads((out / "extract.json").read_text())["counts"]["kept"] == 5
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/holiday.jpg").write_bytes(b"mine")
    with pytest.raises(GsbaError, match="not empty and not an extraction"):
        extract(film, tmp_path / "photos", VideoSettings(), replace=True)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("extract.json", "[]", "not an extraction"),
        ("extract.json", '{"counts": {"received": []}, "key": 1}', "not an extraction"),
        ("extract.json", '{"counts": [3], "key": 1}', "not an extraction"),
        ("extract.json", "[" * 99_999, "not an extraction"),
        ("extract.json", '{"counts": null, "key": 1}', "another extraction"),
        ("extract.partial.csv", "000000.jpg\n", "damaged"),
        ("extract.partial.csv", "000000.jpg,x,y,z\n", "damaged"),
        ("timestamps.csv", "000000.jpg,x\n", "holds no times"),
    ],
)
def test_edited_extractions_are_refused(
    film: Path, tmp_path: Path, name: str, content: str, message: str
) -> None:
    out = tmp_path / "frames"
    settings = VideoSettings(every=30)
    extract(film, out, settings)
    if name == "extract.partial.csv":  # as if it had been interrupted
        marker = json.loads((out / "extract.json").read_text()) | {"counts": None}
        (out / "extract.json").write_text(json.dumps(marker))
    (out / name).write_text(content)
    refused(message, extract, film, out, settings)


@pytest.mark.parametrize("gone", ["timestamps.csv", "000030.jpg"])
def test_what_an_extraction_lacks_is_made_again(film: Path, tmp_path: Path, gone: str) -> None:
    """Frames without their table would have no times, or those of another rate."""
    out = tmp_path / "frames"
    extract(film, out, VideoSettings(every=30))
    whole = {path.name: path.read_bytes() for path in out.iterdir()}
    (out / gone).unlink()
    extract(film, out, VideoSettings(every=30))
    assert {path.name: path.read_bytes() for path in out.iterdir()} == whole


def test_colours_survive(tmp_path: Path) -> None:
    """What names no colour matrix is taken for BT.709; flat colours come back within JPEG's."""
    flat = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    flat[:, : WIDTH // 2], flat[:, WIDTH // 2 :] = (180, 60, 40), (40, 90, 170)
    path = tmp_path / "v.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "4"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        frame = av.VideoFrame.from_ndarray(flat, format="rgb24")
        frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709")
        for i in range(3):
            frame.pts = i
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    extract(path, tmp_path / "frames", VideoSettings(every=1, standing_deg=0))
    back = cv2.imread(str(tmp_path / "frames/000001.jpg"))[..., ::-1]
    np.testing.assert_allclose(back[64, 64].astype(int), (180, 60, 40), atol=4)
    np.testing.assert_allclose(back[64, 192].astype(int), (40, 90, 170), atol=4)


def test_command(film: Path, tmp_path: Path) -> None:
    result = succeed("extract", film, "--out", tmp_path / "f", "--every", 30, "--width", 64)
    assert result.stdout.startswith("3 of 90 frames kept")
    fails(run_gsba("extract", film, "--out", tmp_path / "f"), "holds another extraction")
    assert run_gsba("extract", film, "--out", tmp_path / "f", "--fresh").exit_code == 0


def test_bad_options(film: Path, tmp_path: Path) -> None:
    out = ("--out", tmp_path / "f")
    fails(run_gsba("extract", film, *out, "--fps", 1, "--every", 2), "pass one")
    fails(run_gsba("extract", film, *out, "--fps", -1), "video.fps = -1.0 is not allowed")
    fails(run_gsba("extract", film, *out, "--width", 999), "video.width")
    fails(run_gsba("extract", film, *out, "--width", 99999), "use an even integer >= 64")
    fails(run_gsba("extract", tmp_path, *out), "is a folder: give a video")
    fails(run_gsba("extract", film, *out, "--width", 512), "has only 256 pixels")
    fails(run_gsba("extract", film, *out, "--from", 2, "--to", 1), "later than --from")
    fails(run_gsba("extract", film, *out, "--from", 20), "no frame between 20 and inf s")
    fails(run_gsba("extract", film, *out, "--at", tmp_path / "x.tum"), "x.tum: ")
    fails(run_gsba("extract", film, *out, "--at", "x.tum", "--sharpest"), "leave out --sharpest")
    fails(run_gsba("extract", tmp_path / "none.mp4", *out), "none.mp4: no such file")
    fails(run_gsba("extract", film, "--out", film), "is a file")


@pytest.mark.parametrize(
    ("size", "message"),
    [((256, 144), "is 256x144; an equirectangular video is 2:1"), ((128, 128), "square: one lens")],
)
def test_other_shapes_are_refused(tmp_path: Path, size: tuple[int, int], message: str) -> None:
    pictures = [_world(i, *size) for i in range(3)]
    video = encode(tmp_path / "v.mp4", (pictures, steady(3, NTSC)))
    fails(run_gsba("extract", video, "--out", tmp_path / "f"), message)


def test_broken_files_are_one_line(film: Path, tmp_path: Path) -> None:
    data = film.read_bytes()
    files = {"text.mp4": b"not a video" * 99, "empty.mp4": b"", "cut.mp4": data[: len(data) // 2]}
    for name, content in files.items():  # an MP4 has its index at the end: half of it has none
        (tmp_path / name).write_bytes(content)
        result = run_gsba("extract", tmp_path / name, "--out", tmp_path / "f")
        fails(result, f"{name}: cannot be read as video")
    odd = tmp_path / "odd.mp4"
    odd.write_bytes(data.replace(b"avc1", b"zzzz").replace(b"avcC", b"zzzC"))
    fails(run_gsba("extract", odd, "--out", tmp_path / "f"), "there is no decoder for its codec")


def test_names_of_another_encoding_do_not_matter(film: Path, tmp_path: Path) -> None:
    """Or a byte of the metadata that is damaged."""
    data = film.read_bytes()
    assert b"VideoHandler" in data
    odd = tmp_path / "odd.mp4"
    odd.write_bytes(data.replace(b"VideoHandler", b"Vid\xe9oHandle\xff"))
    assert run_gsba("extract", odd, "--out", tmp_path / "f").exit_code == 0
    assert _indices(tmp_path / "f")


def test_a_truncated_video_says_how_far_it_goes(film: Path, tmp_path: Path) -> None:
    whole = tmp_path / "whole.mkv"
    with av.open(str(film)) as source, av.open(str(whole), "w") as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                target.mux(packet)
    cut = tmp_path / "cut.mkv"
    cut.write_bytes(whole.read_bytes()[: int(0.5 * whole.stat().st_size)])
    result = run_gsba("extract", cut, "--out", tmp_path / "f")
    fails(result, "truncated; copy it again, or pass --to")
    end = result.stderr.split("--to ")[1].split()[0]
    assert run_gsba("extract", cut, "--out", tmp_path / "f", "--to", end).exit_code == 0
    assert 0 in _indices(tmp_path / "f")
    assert f"(--set video.to_s={end} of refine and splat)" in result.stderr


def test_a_black_video_is_refused_before_it_is_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*given: object) -> None:
        raise AssertionError("followed")

    monkeypatch.setattr("gsba.odometry.of_video", never)
    black = [np.zeros((HEIGHT, WIDTH, 3), np.uint8)] * 8
    video = encode(tmp_path / "v.mp4", (black, steady(8, NTSC)))
    done = run_gsba("refine", video, "--out", tmp_path / "run")
    assert done.exit_code == 1 and "its frames are black" in done.stderr, done.stderr
    chosen = "extract", video, "--out", tmp_path / "frames", "--every", "auto"
    fails(run_gsba(*chosen), "its frames are black")
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    fails(run_gsba(*chosen[:3], ".", *chosen[4:]), "its frames are black")
    fails(run_gsba(*chosen, "--width", 512), f"--width 512: {video} has only {WIDTH} pixels")
    fails(run_gsba(*chosen, "--sharpest"), "--every auto keeps sharp frames already")


def test_headers_of_a_video_are_read_once(
    film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Checked, then extracted; anew when it is another file."""
    read, video = list[object](), tmp_path / "film.mp4"
    video.write_bytes(film.read_bytes())
    given = recording.read_timeline
    monkeypatch.setattr(recording, "read_timeline", lambda track: read.append(0) or given(track))
    extraction.check_video(video, VideoSettings())
    extract(video, tmp_path / "frames", VideoSettings())
    assert len(read) == 1
    video.write_bytes(film.read_bytes() + b"\0")
    extraction.check_video(video, VideoSettings())
    assert len(read) == 2


def test_times_for_a_video_are_refused(film: Path, tmp_path: Path) -> None:
    """They would have no effect, but for a trajectory that has none of its own."""
    times = tmp_path / "times.csv"
    times.write_text("name,timestamp\n000000,0.0\n")
    done = run_gsba("refine", film, "--timestamps", times, "--out", tmp_path / "run")
    fails(done, "a video holds the times of its frames: leave out --timestamps")
    write_tum(tmp_path / "a.tum", Trajectory(np.arange(2.0), np.tile(np.eye(4), (2, 1, 1))))
    given = "--timestamps", times, "--out", tmp_path / "run"
    done = run_gsba("refine", film, tmp_path / "a.tum", *given)
    fails(done, "its frames, and its trajectory its own: leave out --timestamps")
    rows = "1 0 0 0 0 1 0 0 0 0 1 0\n" * 2
    (tmp_path / "kitti.txt").write_text(rows)
    times.write_text("0.0\n0.5\n")
    origin = {"frames": film, "trajectory": tmp_path / "kitti.txt"}
    (found,) = inputs.read_trajectories(origin, times, Convention())
    assert isinstance(found, Trajectory) and found.timestamps.tolist() == [0.0, 0.5]


def _follow(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Odometry that finds five poses at once; gets its runs."""
    runs: list[int] = []

    def track_panoramas(video: object) -> Any:
        runs.append(len(runs))
        poses = np.tile(np.eye(4), (5, 1, 1))
        return SimpleNamespace(timestamps=np.arange(5) / 4, world_T_rigs=poses, usable=lambda: True)

    monkeypatch.setattr("gsba.odometry.of_video", lambda *_, **__: None)
    monkeypatch.setattr("gsba.odometry.without_carrier", lambda _: None)
    monkeypatch.setattr("gsba.odometry.track_panoramas", track_panoramas)
    monkeypatch.setattr(
        "gsba.odometry.choose_frames", lambda _, settings: np.arange(settings.max_frames or 5)
    )
    return runs


def test_another_number_of_frames_is_another_extraction(
    film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More, fewer, or all: not those that an earlier call chose."""
    runs, out = _follow(monkeypatch), tmp_path / "frames"
    auto = "extract", film, "--out", out, "--every", "auto"
    for _ in range(2):
        assert "4 of 90 frames kept" in succeed(*auto, "--frames", 4).output
    for other in (("--frames", 3), ("--frames", 5), ()):
        fails(run_gsba(*auto, *other), "frames holds frames that were chosen otherwise")
    assert len(runs) == 1
    assert "5 of 90 frames kept" in succeed(*auto, "--fresh").output
    fails(run_gsba(*auto[:4], "--fps", 1), "holds another extraction")
    succeed(*auto[:4], "--fps", 1, "--fresh")
    fails(run_gsba(*auto), "frames holds frames that were chosen otherwise")
    assert len(runs) == 2


def test_poses_of_chosen_frames_replace_no_file_of_ones_own(
    film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As `gsba track walk.mp4 --out walk.tum` writes beside a folder `walk`."""
    runs, out, own = _follow(monkeypatch), tmp_path / "walk", tmp_path / "walk.tum"
    own.write_text("0 0 0 0 0 0 0 1\n")
    auto = "extract", film, "--out", out, "--every", "auto"
    for more in ((), ("--fresh",)):
        fails(run_gsba(*auto, *more), "walk.tum: poses of the chosen frames would replace it")
    assert own.read_text() == "0 0 0 0 0 0 0 1\n" and not out.exists()
    own.unlink()
    (out / "notes.txt").parent.mkdir()
    (out / "notes.txt").touch()
    fails(run_gsba(*auto), "walk is not empty and not an extraction")
    assert not runs


@pytest.mark.parametrize(
    ("more", "told"),
    [((), "frames that were chosen otherwise"), (["--fresh"], "walk.tum: poses of the chosen")],
)
def test_chosen_frames_do_not_replace_a_trajectory(
    film: Path, tmp_path: Path, more: tuple[str, ...], told: str
) -> None:
    """Of the name of the folder, as documented for recordings and their trajectories."""
    own, out = tmp_path / "walk.tum", tmp_path / "walk"
    write_tum(own, Trajectory(np.arange(5) / 4, np.tile(np.eye(4), (5, 1, 1))))
    before = own.read_bytes()
    succeed("extract", film, "--out", out, "--at", own)
    fails(run_gsba("extract", film, "--out", out, "--every", "auto", *more), told)
    assert own.read_bytes() == before


def test_missing_library_is_one_line(
    film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    result = run_gsba("extract", film, "--out", tmp_path / "f")
    fails(result, "reading video needs PyAV: pip install 'gsba[video]'")


@pytest.mark.parametrize("kind", ["yuv420p", "yuvj420p", "nv12", "yuv420p10le"])
@pytest.mark.parametrize("matrix", [1, 2, 5])  # BT.709, untagged, BT.601
@pytest.mark.parametrize("extent", [0, 1, 2])  # untagged, limited, full range
def test_luma_is_the_luma_plane_in_full_range(kind: str, matrix: int, extent: int) -> None:
    rng = np.random.default_rng(0)
    frame = av.VideoFrame(64, 32, kind)
    frame.colorspace, frame.color_range = matrix, extent
    kinds = np.uint16 if kind.endswith("10le") else np.uint8
    scale = 4 if kinds == np.uint16 else 1
    for plane in frame.planes:
        shape = plane.height, plane.line_size // np.dtype(kinds).itemsize
        plane.update(rng.integers(100 * scale, 156 * scale, shape, dtype=kinds).tobytes())
    levels = rng.integers(16, 236, (32, frame.planes[0].line_size // np.dtype(kinds).itemsize))
    frame.planes[0].update((scale * levels).astype(kinds).tobytes())
    levels = levels[:, :64]
    stretched = np.rint((levels - 16) * 255 / 219)
    wanted = levels if extent == 2 or kind == "yuvj420p" else stretched
    found = luma(frame)
    assert np.abs(found - wanted).max() <= (scale > 1)  # 10 bits are rounded once more
    if matrix == 2:
        assert np.array_equal(found, frame.reformat(format="gray").to_ndarray())
