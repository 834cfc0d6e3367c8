"""Videos made here, whose pictures are shown at exactly the ticks that are given."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from gsba.video import extraction

TICK = Fraction(1, 90_000)  # seconds
Track = tuple[Sequence[np.ndarray], Sequence[int]]  # RGB pictures, ticks at which they are shown


def encode(
    path: Path,
    *tracks: Track,
    codec: str = "libx264",
    container_format: str | None = None,
    trailer: bytes = b"",
) -> Path:
    """A video of these tracks, and what is appended to it."""
    import av

    with av.open(str(path), "w", format=container_format) as container:
        streams = []
        for pictures, _ in tracks:
            options = {"crf": "12", "x265-params": "log-level=none"}
            stream = container.add_stream(codec, rate=30, options=options)
            stream.height, stream.width = pictures[0].shape[:2]
            stream.pix_fmt, stream.gop_size = "yuv420p", 12
            stream.time_base = stream.codec_context.time_base = TICK
            streams.append(stream)
        for stream, (pictures, ticks) in zip(streams, tracks, strict=True):
            for picture, tick in zip(pictures, ticks, strict=True):
                frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
                frame.pts, frame.time_base = int(tick), TICK
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
    path.write_bytes(path.read_bytes() + trailer)
    return path


def interrupt(patch: pytest.MonkeyPatch, name: str, at: int) -> list[object]:
    """Have a function of the extraction interrupted at a call; returns the calls to come."""
    real, calls = getattr(extraction, name), []

    def call(*arguments: object) -> object:
        calls.append(arguments)
        if len(calls) == at:
            raise KeyboardInterrupt
        return real(*arguments)

    patch.setattr(extraction, name, call)
    return calls


def steady(num: int, ticks: int = 3000) -> list[int]:
    """Ticks of frames at 30 per second."""
    return [ticks * i for i in range(num)]


def times_of(folder: Path) -> dict[str, float]:
    """Times of extracted frames by name."""
    rows = (folder / "timestamps.csv").read_text().splitlines()
    assert rows[0] == "name,timestamp"
    return {name: float(time) for name, time in (row.split(",") for row in rows[1:])}
