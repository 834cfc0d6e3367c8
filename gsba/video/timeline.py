"""A video file: is it usable, when is each frame shown, and its frames in order.

PyAV decodes what FFmpeg does. The presentation times of all frames are read from the packets
before a picture is decoded, so that frames are chosen on the exact timeline and only those groups
of pictures are decoded in which one was chosen.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from gsba.log import GsbaError

_SUFFIXES = {".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", ".ts", ".insv", ".360", ".lrv"}
_STITCH = "stitch it in the camera's app and export an equirectangular (2:1) video"
_DARK, _LIT = 32, 40  # grey levels: around the image circles of two fisheyes, and inside
_UNSPECIFIED = 2  # AVCOL_SPC_UNSPECIFIED
_SLACK_S = 1.0  # a container may claim to be this much longer than its pictures


@dataclass(frozen=True, slots=True)
class Timeline:
    """When the frames of a video are shown."""

    ticks: np.ndarray  # (N,) int64, ascending presentation times in units of `tick_s`
    tick_s: Fraction  # seconds
    width: int  # pixels
    height: int  # pixels
    keyframes: np.ndarray  # (G,) int64, ascending ticks at which decoding can begin
    seek_to: np.ndarray  # (G,) int64, where to seek for each of them, ticks of decoding time
    claimed_s: float  # seconds from the first frame to the end that the container claims

    @property
    def times(self) -> np.ndarray:
        """Seconds (N,) float64 since the first frame."""
        since = (int(tick) - int(self.ticks[0]) for tick in self.ticks)
        return np.array([float(ticks * self.tick_s) for ticks in since])

    @property
    def is_cut_short(self) -> bool:
        """Whether the pictures end clearly before the container claims: a truncated copy."""
        last = float((self.ticks[-1] - self.ticks[0]) * self.tick_s)
        return self.claimed_s - last > max(_SLACK_S, 3 * last / len(self.ticks))


def is_video(path: Path) -> bool:
    """Whether a path is a file with a video's suffix."""
    return path.suffix.lower() in _SUFFIXES and path.is_file()


def read_timeline(video: Path) -> Timeline:
    """Presentation times of all frames of an equirectangular video, from its packets alone.

    Raises:
        GsbaError: no video, no decoder for it, not 2:1 (raw dual-fisheye has its own message).
    """
    with _opened(video) as (container, stream):
        _check_shape(video, container, stream)
        packets = [
            (p.pts if p.pts is not None else p.dts, p.dts, p.is_keyframe)
            for p in container.demux(stream)
            if p.size and not p.is_discard and not p.is_corrupt
        ]
        packets = [(pts, dts, key) for pts, dts, key in packets if pts is not None]
        if not packets:
            raise GsbaError(f"{video}: holds no pictures; copy or export it again")
        ticks = np.unique([pts for pts, _, _ in packets])
        starts = sorted((pts, pts if dts is None else dts) for pts, dts, key in packets if key)
        last = float((ticks[-1] - ticks[0]) * stream.time_base)
        timeline = Timeline(
            ticks,
            stream.time_base,
            stream.width,
            stream.height,
            *np.array(starts or [(ticks[0], ticks[0])], np.int64).T,
            claimed_s=max(last, _claimed_end(container, stream) or 0.0),
        )
    _refuse_fisheyes(video, timeline)
    return timeline


def decode(video: Path, timeline: Timeline, chosen: Sequence[int]) -> Iterator[tuple[int, Any]]:
    """Yield (index, av.VideoFrame) of chosen frames in order; damaged ones are left out.

    Args:
        chosen: ascending indices into `timeline.ticks`.
    """
    av = _pyav()
    wanted = {int(timeline.ticks[i]): i for i in chosen}
    begins = np.searchsorted(timeline.keyframes, timeline.ticks[list(chosen)], side="right") - 1
    stops = np.flatnonzero(np.diff(begins) > 1) + 1  # a whole group lies between: seek
    with _opened(video) as (container, stream):
        stream.thread_type = "AUTO"
        for part in np.split(np.arange(len(chosen)), stops):
            if not len(part):
                continue
            last = int(timeline.ticks[chosen[part[-1]]])
            container.seek(int(timeline.seek_to[max(begins[part[0]], 0)]), stream=stream)
            for packet in container.demux(stream):
                try:
                    pictures = packet.decode()
                except av.error.InvalidDataError:
                    continue  # damaged: shows as a frame that never comes
                for frame in pictures:
                    if frame.pts in wanted and not frame.is_corrupt:
                        yield wanted.pop(frame.pts), frame
                if pictures and pictures[-1].pts is not None and pictures[-1].pts >= last:
                    break


def luma(frame: Any) -> np.ndarray:
    """Brightness (H, W) uint8 of an av.VideoFrame."""
    return frame.reformat(format="gray").to_ndarray()


def bgr(frame: Any) -> np.ndarray:
    """Colours (H, W, 3) uint8 BGR of an av.VideoFrame; what names no matrix is taken for BT.709."""
    from av.video.reformatter import Colorspace

    matrix = Colorspace.ITU709 if int(frame.colorspace) == _UNSPECIFIED else None
    return frame.reformat(format="bgr24", src_colorspace=matrix).to_ndarray()


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
def _opened(video: Path) -> Iterator[tuple[Any, Any]]:
    """Container and its one video stream; every failure of FFmpeg is one line."""
    av = _pyav()
    try:
        with av.open(str(video)) as container:
            streams = [s for s in container.streams.video if not _is_cover(s)]
            if not streams:
                raise GsbaError(f"{video}: holds no video stream")
            if len(streams) > 1 and streams[1].codec_context is not None:
                width, height = streams[0].width, streams[0].height
                raise GsbaError(
                    f"{video}: holds {len(streams)} video streams of {width}x{height}: a raw "
                    f"recording, one stream a lens; {_STITCH}"
                )
            if streams[0].codec_context is None:
                raise GsbaError(
                    f"{video}: no decoder for its pictures; convert it to H.264 or H.265"
                )
            yield container, streams[0]
    except av.error.FFmpegError as error:
        if isinstance(error, OSError) and error.errno and error.errno > 0 and not video.exists():
            raise GsbaError(f"{video}: no such file") from None
        raise GsbaError(
            f"{video}: cannot be read as video ({error.strerror}); it may be truncated or damaged: "
            "copy or export it again"
        ) from error


def _is_cover(stream: Any) -> bool:
    """A still picture stored with the video."""
    return bool(stream.disposition & type(stream.disposition).attached_pic)


def _check_shape(video: Path, container: Any, stream: Any) -> None:
    width, height = stream.width, stream.height
    if width == 2 * height and height > 0:
        return
    if width == height and height > 0:
        raise GsbaError(
            f"{video}: is {width}x{height}, square: one lens of a raw dual-fisheye recording, or "
            f"a stereo pair; {_STITCH}"
        )
    raise GsbaError(
        f"{video}: is {width}x{height}; an equirectangular video is 2:1. If it is raw "
        f"dual-fisheye or a flat cut of the recording, {_STITCH}"
    )


def _claimed_end(container: Any, stream: Any) -> float | None:
    """Seconds the container claims its pictures last."""
    if stream.duration is not None:
        return float(stream.duration * stream.time_base)
    return None if container.duration is None else container.duration / 1e6


def _refuse_fisheyes(video: Path, timeline: Timeline) -> None:
    """Two image circles side by side leave their surroundings black; a panorama has none."""
    for _, frame in decode(video, timeline, [len(timeline.ticks) // 2]):
        grey = luma(frame)
        height, width = grey.shape
        v, u = np.ogrid[:height, :width]
        radius = np.hypot(np.mod(u + 0.5, height) - height / 2, v + 0.5 - height / 2)
        outside, inside = grey[radius > 0.52 * height], grey[radius < 0.4 * height]
        if np.percentile(outside, 90) < _DARK and np.median(inside) > _LIT:
            raise GsbaError(
                f"{video}: shows two round images side by side: raw dual-fisheye; {_STITCH}"
            )
