"""Track of a video file: its codec, its presentation times, and its decoded frames.

PyAV decodes all formats of FFmpeg. The presentation times of all frames are read from the packets
before a frame is decoded, so that frames are chosen on the exact timeline and only groups of
pictures with a chosen frame are decoded.
"""

import struct
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain, islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from gsba.frames.files import turned
from gsba.log import GsbaError
from gsba.video.colours import bgr, hdr_name

_STEREO = {
    1: "side by side",
    2: "over-under",
    3: "frame by frame",
    4: "checkerboard",
    5: "side by side",
    6: "line by line",
    7: "column by column",
}  # AVStereo3DType
_PROJECTIONS = {
    0: "",
    1: "cube map",
    2: "",
    3: "half equirectangular",
    4: "rectilinear",
    5: "fisheye",
}  # AVSphericalProjection; 2: equirectangular with bounds
_ORIENTATIONS = {  # EXIF's, of the signs of a, b, c, d of a display matrix
    (1, 0, 0, 1): 1,
    (-1, 0, 0, 1): 2,
    (-1, 0, 0, -1): 3,
    (1, 0, 0, -1): 4,
    (0, 1, 1, 0): 5,
    (0, 1, -1, 0): 6,
    (0, -1, -1, 0): 7,
    (0, -1, 1, 0): 8,
}


@dataclass(frozen=True, slots=True)
class PictureClaims:
    """Claims about the pictures of a video track, which FFmpeg reads from MP4 (`tkhd`, `pasp`,
    `st3d`, `sv3d`), Matroska and the bitstream: records AVStereo3D and AVSphericalMapping of
    libavutil."""

    orientation: int = 1  # of EXIF, 1 to 8, in which stored pictures are shown
    pixel_aspect: Fraction = Fraction(1)  # width over height of a pixel
    stereo: str = ""  # arrangement of two eyes; "" = one eye, or not stated
    projection: str = ""  # other than equirectangular; "" = equirectangular, or not stated
    spherical: bool = False  # True if a projection is stated
    bounds: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # parts of the sphere that
    # are missing at the left, top, right and bottom
    pose_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)  # yaw, pitch, roll by which pictures
    # are to be turned for display
    hdr: str = ""  # transfer function, "PQ" or "HLG"; "" = no HDR

    def shown_size(self, size: tuple[int, int]) -> tuple[int, int]:
        """Width and height as shown of pictures stored with a width and height: pixels are square,
        and no row becomes longer."""
        width, height = size
        if self.orientation > 4:
            return height, round(width * self.pixel_aspect)
        return width, round(height / self.pixel_aspect)

    @property
    def whole(self) -> bool:
        """True if the file states that pictures are whole panoramas for one eye."""
        return self.spherical and not (self.stereo or self.projection or any(self.bounds))


def claims_of(frame: Any, pixel_aspect: Fraction | None) -> PictureClaims:
    """Claims that come with a decoded av.VideoFrame; pixel_aspect: of its stream, None = not
    stated."""
    records = {part.type.name: bytes(part) for part in frame.side_data}
    orientation = 1
    if len(matrix := records.get("DISPLAYMATRIX", b"")) >= 36:
        a, b, _, c, d = struct.unpack("=5i", matrix[:20])
        most = max(abs(value) for value in (a, b, c, d))
        signs = tuple(round(value / most) if most else 0 for value in (a, b, c, d))
        orientation = _ORIENTATIONS.get(signs, 1)  # type: ignore[arg-type]
    stereo, spherical = records.get("STEREO3D", b""), records.get("SPHERICAL", b"")
    eyes = _STEREO.get(struct.unpack("=i", stereo[:4])[0], "") if len(stereo) >= 4 else ""
    aspect = pixel_aspect if pixel_aspect else Fraction(1)
    hdr = hdr_name(frame.color_trc)
    if len(spherical) < 32:
        return PictureClaims(orientation, aspect, eyes, hdr=hdr)
    kind, *turns = struct.unpack("=4i", spherical[:16])
    bounds = [part / 2**32 for part in struct.unpack("=4I", spherical[16:32])]
    return PictureClaims(
        orientation,
        aspect,
        eyes,
        _PROJECTIONS.get(kind, "unknown"),
        True,
        tuple(bounds) if kind == 2 else (0.0,) * 4,  # type: ignore[arg-type]
        tuple(turn / 2**16 for turn in turns),  # type: ignore[arg-type]
        hdr,
    )


VIDEO_SUFFIXES = frozenset(
    (".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", ".ts", ".insv", ".360", ".lrv", ".osv")
)
_MAX_CLAIM_PACKETS = 60  # of a track until the first picture, which may be damaged


@dataclass(frozen=True, slots=True)
class Track:
    """Video track of a file."""

    path: Path
    number: int = 0  # index in `track_sizes`


@dataclass(frozen=True, slots=True)
class Timeline:
    """Presentation times of a track's frames."""

    ticks: np.ndarray  # (N,) int64, ascending presentation times in units of `tick_s`
    tick_s: Fraction  # seconds
    width: int  # pixels
    height: int  # pixels
    keyframes: np.ndarray  # (G,) int64, ascending ticks at which decoding can begin
    seek_to: np.ndarray  # (G,) int64, seek position of each keyframe, ticks of decoding time
    claimed_s: float  # seconds from the first frame to the end that the container claims

    @property
    def times(self) -> np.ndarray:
        """Seconds (N,) float64 since the first frame."""
        since = (int(tick) - int(self.ticks[0]) for tick in self.ticks)
        return np.array([float(ticks * self.tick_s) for ticks in since])

    @property
    def interval_s(self) -> float:
        """Median seconds between frames; 1 for a single frame."""
        return float(np.median(np.diff(self.times))) if len(self.ticks) > 1 else 1.0

    @property
    def is_cut_short(self) -> bool:
        """True if the frames end clearly before the duration that the container claims."""
        last = float((self.ticks[-1] - self.ticks[0]) * self.tick_s)
        return self.claimed_s - last > max(1.0, 3 * last / len(self.ticks))


def is_video(path: Path) -> bool:
    """True if a path is a file with a video's suffix."""
    return path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()


def track_sizes(video: Path) -> list[tuple[int, int]]:
    """Width and height, pixels, of the video tracks of a file that can be decoded. GsbaError: the
    file is no video, or there is no decoder for it."""
    with _opened(video) as (_, streams):
        return [(stream.width, stream.height) for stream in streams]


def claimed_duration_s(video: Path) -> float | None:
    """Duration that the first track of a video claims, seconds; None = not stated. GsbaError: the
    file is no video, or there is no decoder for it."""
    with _opened(video) as (container, streams):
        return _claimed_end(container, streams[0])


def container_tags(video: Path) -> dict[str, str]:
    """Tags of a video's container by the last word of their names in lower case: QuickTime's
    "com.apple.quicktime.model" is "model". GsbaError: the file is no video."""
    with _opened(video) as (container, _):
        return {key.lower().rpartition(".")[2]: text for key, text in container.metadata.items()}


def read_timeline(track: Track) -> Timeline:
    """Presentation times of all frames of a track, from its packets alone. GsbaError: the file is
    no video, there is no decoder for it, it holds no frames, or states times in another order."""
    video = track.path
    with _opened(video) as (container, streams):
        stream = streams[track.number]
        packets = [
            (p.pts if p.pts is not None else p.dts, p.dts, p.is_keyframe)
            for p in container.demux(stream)
            if p.size and not p.is_discard and not p.is_corrupt
        ]
        packets = [(pts, dts, key) for pts, dts, key in packets if pts is not None]
        if not packets:
            raise GsbaError(f"{video} holds no frames: copy or export it again")
        lags = {pts - dts for pts, dts, _ in packets if dts is not None}
        if len(lags) < 2 and stream.codec_context.has_b_frames:
            _refuse_another_order(video, container, stream, packets[0][1] or 0)
        ticks = np.unique([pts for pts, _, _ in packets])
        starts = sorted((pts, pts if dts is None else dts) for pts, dts, key in packets if key)
        last = float((ticks[-1] - ticks[0]) * stream.time_base)
        return Timeline(
            ticks,
            stream.time_base,
            stream.width,
            stream.height,
            *np.array(starts or [(ticks[0], ticks[0])], np.int64).T,
            claimed_s=max(last, _claimed_end(container, stream) or 0.0),
        )


def _refuse_another_order(video: Path, container: Any, stream: Any, begin: int) -> None:
    """Refuse stated times that do not ascend as pictures are shown: AVI has none, and H.264 in it
    gets those of the order in which pictures are stored."""
    container.seek(begin, stream=stream)
    packets = islice(container.demux(stream), _MAX_CLAIM_PACKETS)
    shown = [picture.pts for picture in chain.from_iterable(_decoded(packets))]
    if any(after < before for before, after in pairwise(pts for pts in shown if pts is not None)):
        raise GsbaError(
            f"{video}: it states times in the order in which its pictures are stored, not shown "
            "(H.264 with B-frames in AVI): export it as MP4, or convert it (ffmpeg -i "
            f"{video.name} ONE.mp4)"
        )


def read_claims(track: Track) -> PictureClaims:
    """Claims of a track about its pictures; none if its first second cannot be decoded. GsbaError:
    the file is no video, or there is no decoder for it."""
    with _opened(track.path) as (container, streams):
        stream = streams[track.number]
        picture = _first_picture(container, stream)
        return claims_of(picture, stream.sample_aspect_ratio) if picture else PictureClaims()


def decode(track: Track, timeline: Timeline, chosen: Sequence[int]) -> Iterator[tuple[int, Any]]:
    """Yield (index, av.VideoFrame) of chosen frames, ascending indices into `timeline.ticks`;
    damaged ones are left out."""
    wanted = {int(timeline.ticks[i]): i for i in chosen}
    begins = np.searchsorted(timeline.keyframes, timeline.ticks[list(chosen)], side="right") - 1
    stops = np.flatnonzero(np.diff(begins) > 1) + 1  # a whole group lies between: seek
    with _opened(track.path) as (container, streams):
        stream = streams[track.number]
        stream.thread_type = "AUTO"
        for part in np.split(np.arange(len(chosen)), stops):
            if not len(part):
                continue
            last = int(timeline.ticks[chosen[part[-1]]])
            container.seek(int(timeline.seek_to[max(begins[part[0]], 0)]), stream=stream)
            for pictures in _decoded(container.demux(stream)):
                for frame in pictures:
                    if frame.pts in wanted and not frame.is_corrupt:
                        yield wanted.pop(frame.pts), frame
                if pictures and pictures[-1].pts is not None and pictures[-1].pts >= last:
                    break


def picture_near(video: Path, share: float) -> np.ndarray:
    """Colours (H, W, 3) uint8 BGR of the last frame of a video's first track before a place, 0..1
    of its duration, at which decoding can begin, without reading the whole file. GsbaError: the
    file is no video, or nothing can be decoded."""
    with _opened(video) as (container, streams):
        stream, end = streams[0], _claimed_end(container, streams[0])
        if share and end:
            container.seek(
                int((stream.start_time or 0) + share * end / stream.time_base), stream=stream
            )
        if picture := _first_picture(container, stream):
            return turned(bgr(picture), claims_of(picture, None).orientation)
    raise GsbaError(f"{video}: no picture can be decoded: copy or export it again")


def _first_picture(container: Any, stream: Any) -> Any:
    """The next av.VideoFrame that can be decoded; None = none of the next packets' can."""
    packets = islice(container.demux(stream), _MAX_CLAIM_PACKETS)
    return next(chain.from_iterable(_decoded(packets)), None)


def _decoded(packets: Iterable[Any]) -> Iterator[list[Any]]:
    """Pictures of each packet; those of damaged ones are missing."""
    damaged = _pyav().error.InvalidDataError
    for packet in packets:
        with suppress(damaged):
            yield packet.decode()


def _pyav() -> Any:
    try:
        import av
        import av.logging
    except ImportError:
        raise GsbaError(
            "reading video needs PyAV: pip install 'gsba[video]', or extract the frames yourself "
            "and give their folder"
        ) from None
    return av


@contextmanager
def _opened(video: Path) -> Iterator[tuple[Any, list[Any]]]:
    """Container and its video streams; errors of FFmpeg become GsbaError."""
    av = _pyav()
    try:
        with av.open(str(video), metadata_errors="replace") as container:
            every = container.streams.video  # covers are still images stored with the video
            streams = [s for s in every if not s.disposition & type(s.disposition).attached_pic]
            if not streams:
                raise GsbaError(f"{video} holds no video stream")
            if streams[0].codec_context is None:
                raise GsbaError(
                    f"{video}: there is no decoder for its codec; convert it to H.264 or H.265"
                )
            yield container, [s for s in streams if s.codec_context is not None]
    except av.error.FFmpegError as error:
        if isinstance(error, OSError) and error.errno and error.errno > 0 and not video.exists():
            raise GsbaError(f"{video}: no such file") from None
        raise GsbaError(
            f"{video}: cannot be read as video ({error.strerror}); it may be truncated or damaged: "
            "copy or export it again"
        ) from error


def _claimed_end(container: Any, stream: Any) -> float | None:
    """Duration that the container claims for its frames, seconds; None = not stated."""
    if stream.duration is not None:
        return float(stream.duration * stream.time_base)
    return None if container.duration is None else container.duration / 1e6
