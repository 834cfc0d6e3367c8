"""A video of a walk through the gallery, dense enough for odometry, with exact truth."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from gsba.compilation import compile_ahead
from gsba.demo.two_lenses import TwoLenses
from gsba.demo.walk import (
    Camera,
    Heading,
    WalkPath,
    check_choices,
    check_walk,
    exposed,
    render_walk,
    replaced_folder,
    walk_poses,
)
from gsba.disk import disk_errors
from gsba.log import GsbaError
from gsba.trajectory.files import write_tum
from gsba.types import Trajectory

FPS = 8  # frames per second
WHOLE_WALK = 240  # frames of a whole path: steps of about 0.11 units in a room of 14 by 10 units
_CODECS = (("libx264", {"crf": "14", "preset": "veryfast", "threads": "1"}), ("mpeg4", {"q": "2"}))

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class DemoFilm:
    """Files of a filmed walk."""

    video_path: Path  # MP4, 2:1 panoramas
    truth_path: Path  # TUM, exact poses of its frames, world of the gallery
    lenses: TwoLenses | None  # true camera; None = one centre and a global shutter


def make_film(
    out: Path,
    path: WalkPath = "rectangle",
    heading: Heading = "locked",
    num_frames: int = WHOLE_WALK,
    width: int = 720,
    seed: int = 0,
    camera: Camera = "ideal",
) -> DemoFilm:
    """Film a walk into `out`/walk.mp4; an earlier walk in `out` is replaced.

    Args:
        out: folder to write.
        num_frames: at least 3; with fewer than WHOLE_WALK the walk covers a part of the path.
        path, heading, width, seed, camera: see `gsba.demo.make_walk`.

    Returns:
        The files of the video and of its truth, with times from 0 in steps of 1 / FPS seconds.

    Raises:
        GsbaError: an argument is out of range, `out` is not a walk's folder, or PyAV is missing.
    """
    from gsba.demo.gallery import build_gallery

    check_choices(path, heading, camera)
    check_walk(out, num_frames, width, seed)
    av = _pyav()
    lenses = TwoLenses() if camera == "two-lens" else None
    whole = walk_poses(path, heading, max(num_frames, WHOLE_WALK), seed, FPS)
    truth = Trajectory(whole.timestamps[:num_frames], whole.world_T_rigs[:num_frames])
    scene = build_gallery()
    logger.info("gallery of %d faces, %d frames of %d px", len(scene.corners), num_frames, width)
    compile_ahead("demo", "odometry", "refine")  # films are made to be refined
    with replaced_folder(out) as partial:
        pictures = render_walk(scene, truth, width, seed, lenses)
        _encode(av, partial / "walk.mp4", exposed(truth, pictures, seed), width)
        write_tum(partial / "groundtruth.tum", truth)
    return DemoFilm(out / "walk.mp4", out / "groundtruth.tum", lenses)


def _pyav() -> Any:
    try:
        import av
    except ImportError:
        raise GsbaError("--video needs PyAV to write a video: pip install 'gsba[video]'") from None
    return av


def _encode(av: Any, path: Path, pictures: Iterator[np.ndarray], width: int) -> None:
    """Write images (width / 2, width, 3) uint8 BGR as a video, H.264 if PyAV can encode it."""
    codec, options = next(c for c in _CODECS if c[0] in av.codecs_available)
    with disk_errors(path), av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(FPS), options=options)
        stream.width, stream.height, stream.pix_fmt = width, width // 2, "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode())
