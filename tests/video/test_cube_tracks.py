"""GoPro's `.360` made here: two tracks of a cube map among others; what is refused."""

import re
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
from cube_map_tracks import picture_tracks
from refusals import refused
from scipy.spatial.transform import Rotation
from two_fisheyes import colours
from video_files import steady

from gsba.config import VideoSettings
from gsba.frames import load_erp, scan
from gsba.log import GsbaError
from gsba.odometry.panoramas import of_video
from gsba.video import extract, is_video
from gsba.video.recording import read_recording

av = pytest.importorskip("av", reason="PyAV is not installed")

SIZE, OVERLAP = 64, 4
WIDTH = 3 * SIZE + 2 * OVERLAP
TICK = Fraction(1, 90_000)
EVERY = VideoSettings(every=1, standing_deg=0)


def _tracks(index: int) -> tuple[np.ndarray, np.ndarray]:
    """Both tracks at an instant, of a camera that turns 8 degrees from one to the next."""
    turn = Rotation.from_rotvec([0, np.deg2rad(8) * index, 0]).as_matrix()
    return picture_tracks(SIZE, OVERLAP, lambda directions: colours(directions @ turn.T))


def _encode(
    path: Path, tracks: Sequence[tuple[list[np.ndarray], list[int]]], sound_after: int | None = 0
) -> Path:
    """A file of video tracks, RGB pictures at their ticks; sound and a small picture's track lie
    behind the one of a number, as in a camera's files."""
    with av.open(str(path), "w", format="mp4") as container:
        streams = []
        for n, (pictures, _) in enumerate(tracks):
            codec = "libx264" if pictures[0].shape[1] > 160 else "mjpeg"
            stream = container.add_stream(codec, rate=30)
            stream.height, stream.width = pictures[0].shape[:2]
            stream.pix_fmt = "yuv444p" if codec == "libx264" else "yuvj420p"
            if codec == "libx264":
                stream.options, stream.gop_size = {"crf": "6"}, 6
            stream.time_base = stream.codec_context.time_base = TICK
            streams.append(stream)
            if n == sound_after:
                sound = container.add_stream("aac", rate=48_000)
                sound.layout = "stereo"
        for stream, (pictures, ticks) in zip(streams, tracks, strict=True):
            for picture, tick in zip(pictures, ticks, strict=True):
                frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
                frame.pts, frame.time_base = tick, TICK
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        if sound_after is not None:
            silence = np.zeros((2, 1024), np.float32)
            frame = av.AudioFrame.from_ndarray(silence, format="fltp", layout="stereo")
            frame.sample_rate, frame.pts = 48_000, 0
            container.mux(sound.encode(frame))
            container.mux(sound.encode())
    return path


def _recording(path: Path, num: int, missing: Sequence[int] = ()) -> Path:
    """A `.360` file of instants; the second track lacks some."""
    both = [_tracks(i) for i in range(num)]
    second = [i for i in range(num) if i not in missing]
    ticks, small = steady(num), np.full((90, 160, 3), 90, np.uint8)
    first = [pictures[0] for pictures in both], ticks
    last = [both[i][1] for i in second], [ticks[i] for i in second]
    return _encode(path, [first, ([small] * num, ticks), last])


def test_tracks_are_extracted_in_lockstep(tmp_path: Path) -> None:
    """The two tracks are told from others, and their frames pair by time."""
    video = _recording(tmp_path / "GS010001.360", 9, missing=(3, 4))
    assert is_video(video)
    recording = read_recording(video)
    assert [track.number for track in recording.tracks] == [0, 2]
    assert (recording.width, recording.lenses, recording.cube) == (WIDTH, (), True)
    counts = extract(video, tmp_path / "frames", EVERY)
    kept = [0, 1, 2, 5, 6, 7, 8]
    assert (counts.received, counts.kept) == (7, 7)
    left = {path.name for path in (tmp_path / "frames").iterdir()}
    assert left == {"track0", "track5", "timestamps.csv", "extract.json"}
    frames = scan(tmp_path / "frames")
    assert frames.format.layout == "eac" and frames.format.tracks == (WIDTH, SIZE)
    np.testing.assert_allclose(frames.timestamps, np.array(kept) / 30, atol=1e-9)
    for paths, i in zip(frames.paths, kept, strict=True):
        for path, true in zip(paths, _tracks(i), strict=True):
            shown = cv2.imread(str(path))
            assert shown is not None and shown.shape == (SIZE, WIDTH, 3)
            off = np.abs(shown[..., ::-1].astype(int) - true).mean()
            assert off < 8  # grey levels: compression; 40 and more between instants
    assert load_erp(frames, 0).shape == (2 * SIZE, 4 * SIZE, 3)


def test_odometry_reads_panoramas_of_both_tracks(tmp_path: Path) -> None:
    video, width = _recording(tmp_path / "GS010001.360", 4), 2 * SIZE
    extract(video, tmp_path / "frames", EVERY)
    frames, panoramas = scan(tmp_path / "frames"), of_video(video, width)
    read = dict(panoramas.read(range(4), True))
    assert len(panoramas) == len(frames) == len(read) == 4 and panoramas.usable is None
    for f, picture in read.items():
        expected = load_erp(frames, f, width=width).astype(float)
        assert picture.shape == expected.shape
        assert np.abs(picture - expected).mean() < 3  # decoded once, not encoded again


def test_files_that_hold_no_cube_map_are_refused(tmp_path: Path) -> None:
    def refuse(tracks: list[tuple[list[np.ndarray], list[int]]], why: str) -> None:
        video = _encode(tmp_path / "GS010001.360", tracks)
        refused(re.escape(why), extract, video, tmp_path / "f", EVERY)
        assert not (tmp_path / "f").exists() or not any((tmp_path / "f").iterdir())

    def plain(width: int, height: int, num: int = 5) -> tuple[list[np.ndarray], list[int]]:
        return [np.full((height, width, 3), 90, np.uint8)] * num, steady(num)

    refuse([plain(WIDTH, SIZE)], f"holds one video track of {WIDTH}x{SIZE}, but a .360 recording")
    refuse([plain(WIDTH, SIZE), plain(WIDTH - 8, SIZE)], "has two of one size, three squares wide")
    refuse([plain(320, 180), plain(160, 90)], "holds video tracks of 320x180 and 160x90")
    short = [plain(WIDTH, SIZE, 20), plain(WIDTH, SIZE, 10)]
    refuse(short, "pictures of track5 last 0.333 s, those of track0 0.667 s: one is truncated")
    early = [plain(WIDTH, SIZE), (plain(WIDTH, SIZE)[0], [90_000 + t for t in steady(5)])]
    refuse(early, "the tracks share no times (track0 0 to 0.133 s, track5 1.000 to 1.133 s)")


def test_pictures_keep_their_width(tmp_path: Path) -> None:
    video = _recording(tmp_path / "GS010001.360", 3)
    with pytest.raises(GsbaError, match="recording keep their size"):
        extract(video, tmp_path / "f", EVERY.model_copy(update={"width": WIDTH // 2}))
